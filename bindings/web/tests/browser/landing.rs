//! What a visitor without a link sees, and the answer at the end of an episode of the visitor's own.

use endless_gym_memory_gym::memory_gym;
use serde_json::{Value as Json, json};

use crate::server::PageServer;
use crate::{STATE, start, text, visit};

const DEMO: &str = "endless.play.isDemo && endless.play.player === 'agent'";
const TO_THE_END: &str = "endless.play.stop(); while (!endless.play.state.done) endless.play.oneStep()";

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_agent_plays_until_the_visitor_starts() {
    let (server, mut browser) = (PageServer::start("web"), start("landing"));
    for start in ["Space", "ArrowUp", "#pause", "#person", "#observation"] {
        visit(&mut browser, &server, "");
        browser.wait(&format!("{DEMO} && {STATE}.length > 2"));
        assert_eq!(browser.value("location.hash"), "");
        assert_eq!(text(&mut browser, "question"), "How many can you remember?");
        assert_eq!(text(&mut browser, "pause"), "Play");
        if start.starts_with('#') {
            browser.click(start);
        } else {
            browser.press(start);
        }
        browser.wait(&format!("!endless.play.isDemo && {STATE}.length > 0"));
        assert_eq!(browser.value("endless.play.player"), "person", "{start}");
        let link = "Object.fromEntries(new URLSearchParams(location.hash.slice(1)))";
        let (link, state) = (browser.value(link), browser.value(STATE));
        assert_eq!((&link["env"], &link["seed"]), (&state["id"], &state["seed"]), "{start}");
    }
    // A person who asked for no motion sees a picture that stands still.
    let reduced = json!({"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]});
    browser.call("Emulation.setEmulatedMedia", &reduced);
    visit(&mut browser, &server, "");
    browser.wait(&format!("{DEMO} && !endless.play.pace.running"));
    let still = format!(
        "(async () => {{ const before = {STATE}.length; await new Promise((done) => setTimeout(done, 300)); return {STATE}.length - before }})()"
    );
    assert_eq!(browser.value(&still), 0);
    browser.press("Space");
    browser.wait("!endless.play.isDemo && endless.play.pace.running");
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn the_answer_is_what_the_agents_reach_in_the_same_episode() {
    let (server, mut browser) = (PageServer::start("web"), start("answer"));
    for (id, unit) in
        [("MortarMayhem-Grid-v0", "commands"), ("MysteryPath-Grid-v0", "tiles"), ("SearingSpotlights-v0", "coins")]
    {
        visit(&mut browser, &server, &format!("env={id}&seed=7&by=agent"));
        browser.wait("endless.play.player === 'agent'");
        browser.value(TO_THE_END);
        let (agent, options) = (browser.value(STATE)["progress"][0].clone(), browser.value(STATE)["options"].clone());
        assert_eq!(agent["name"], unit);
        assert_eq!(
            browser.value("document.getElementById('answer').checkVisibility()"),
            false,
            "the visitor did not play"
        );
        browser.value(&format!("endless.start({{ id: '{id}', options: {options}, seed: '7' }})"));
        browser.press("KeyN");
        assert_eq!(browser.value("document.querySelectorAll('#compared > *').length"), 0, "nothing is given away");
        browser.value(TO_THE_END);
        browser.wait("document.querySelectorAll('#scores span').length === 2");
        let score = |row: &Json| format!("{} of {}", row["value"], row["of"]).replace(".0", "");
        let you = browser.value(STATE)["progress"][0].clone();
        let expected = json!([format!("You {}", score(&you)), format!("GRU {}", score(&agent))]);
        assert_eq!(
            browser.value("[...document.querySelectorAll('#scores span')].map((row) => row.textContent)"),
            expected,
            "{id}"
        );
        assert_eq!(browser.value("document.querySelectorAll('#compared > *').length"), 1, "{id}");
        // The next episode has no answer yet.
        browser.press("KeyR");
        assert_eq!(browser.value("document.getElementById('answer').hidden"), true);
    }
    // The first command that was not carried out, beside what was done: nothing.
    browser.value("endless.start({ id: 'MortarMayhem-Grid-v0', options: {}, seed: '3' })");
    browser.value(TO_THE_END);
    let clues = browser.value(STATE)["clues"].clone();
    assert_eq!(clues["carried_out"][0], "stay");
    let forgotten =
        "[...document.querySelector('#compared .failed').querySelectorAll('span')].map((span) => span.textContent)";
    let place = clues["carried_out"].as_array().unwrap().len() - 1;
    assert_eq!(browser.value(forgotten), json!([clues["commands"][place], "stay"]));
    // The link that opens the same episode is offered.
    assert_eq!(browser.value("document.getElementById('share').checkVisibility()"), true);
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_answer_for_other_reset_parameters_is_not_shown() {
    let (server, mut browser) = (PageServer::start("web"), start("late-answer"));
    visit(&mut browser, &server, "");
    // Holds back what the agents reach.
    browser.value(
        "globalThis.held = []; Worker.prototype.addEventListener = function (kind, listener) { \
         EventTarget.prototype.addEventListener.call(this, kind, (event) => held.push(() => listener(event))) }; 0",
    );
    for commands in 1..=2 {
        let options = format!("{{ command_count: '[{commands}]' }}");
        browser.value(&format!("endless.start({{ id: 'MortarMayhem-Grid-v0', options: {options}, seed: '3' }})"));
        browser.value(TO_THE_END);
        browser.wait(&format!("held.length === {commands}"));
    }
    browser.value("held.forEach((say) => say())");
    let counts = "[...document.querySelectorAll('#scores b')].map((score) => score.textContent.slice(1))";
    assert_eq!(browser.value(counts), json!([" of 2", " of 2"]));
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn every_family_shows_what_to_remember() {
    let (server, mut browser) = (PageServer::start("web"), start("remember"));
    visit(&mut browser, &server, "");
    for id in memory_gym().specs().map(|spec| spec.id).filter(|id| !id.starts_with("MortarMayhemB")) {
        browser.value(&format!("endless.start({{ id: '{id}', options: {{}}, seed: '3' }}); endless.play.oneStep()"));
        let shown =
            "[document.querySelectorAll('#clues > *').length, document.getElementById('no-clues').checkVisibility()]";
        assert_eq!(browser.value(shown), json!([0, true]), "{id}: a person remembers");
        browser.value("endless.play.choose('expert'); endless.play.stop(); for (let i = 0; i < 30 && !endless.play.state.done; i += 1) endless.play.oneStep()");
        assert_eq!(browser.value(shown), json!([1, false]), "{id}");
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_agent_without_memory_plays_the_same_episode_beside_it() {
    let (server, mut browser) = (PageServer::start("web"), start("rival"));
    visit(&mut browser, &server, "env=MortarMayhem-Grid-v0&seed=7");
    // Another agent of the environment stands for one without memory.
    let other = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/agents/retnet.safetensors")).unwrap();
    browser.value(&format!(
        "globalThis.other = new Uint8Array({}); const {{ agents }} = endless.play; agents.names = (id) => [id, `${{id}}-none`]; \
         const own = agents.file.bind(agents); agents.file = async (name) => (name.endsWith('-none') ? other : own(name)); 0",
        json!(other)
    ));
    browser.press("KeyG");
    browser.wait("endless.play.player === 'agent' && document.getElementById('rival-score').textContent !== ''");
    let shown = "document.getElementById('rival').checkVisibility()";
    assert_eq!(browser.value(shown), true);
    browser.value(TO_THE_END);
    let options = browser.value(STATE)["options"].clone();
    let alone = format!(
        "(async () => {{ const {{ Engine }} = await import('./engine.js'); const engine = await Engine.of(endless.engine.module); engine.loadAgent(other); \
         let state = engine.request({{ start: {{ id: 'MortarMayhem-Grid-v0', options: {options}, seed: '7' }} }}); \
         while (!state.done && state.length < {STATE}.length) state = engine.request('step_of_agent'); \
         const drawn = document.getElementById('rival-picture').getContext('2d').getImageData(0, 0, 84, 84).data; \
         return [state.progress[0].value, engine.observation({{ width: 84, height: 84 }}).data.every((byte, i) => byte === drawn[i])] }})()"
    );
    let alone = browser.value(&alone);
    assert_eq!(alone[1], true, "the same picture");
    let score = text(&mut browser, "rival-score");
    assert_eq!(score.split(' ').next().unwrap(), alone[0].to_string().trim_end_matches(".0"));
    browser.press("KeyG");
    assert_eq!(browser.value(shown), false);
}
