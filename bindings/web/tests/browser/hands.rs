//! Plays as a visitor does, with mouse, keys and fingers.

use endless_gym_memory_gym::memory_gym;
use serde_json::{Value as Json, json};

use crate::server::PageServer;
use crate::{STATE, start, visit};

const LENGTH: &str = "endless.play.state.length";

#[test]
#[ignore = "needs the built page and Chromium"]
fn the_game_has_the_keys_after_every_click() {
    let (server, mut browser) = (PageServer::start("web"), start("keys"));
    visit(&mut browser, &server, "env=MortarMayhem-Grid-v0&seed=3");
    browser.value("document.querySelectorAll('details').forEach((details) => (details.open = true))");
    for control in ["#next", "#restart", "#sound", "#flash", "#show-truth", "#original-pace", "#copy", "#help summary"]
    {
        browser.press("KeyR");
        browser.click(control);
        browser.value("endless.play.restart()");
        browser.press("ArrowLeft");
        browser.wait(&format!("{LENGTH} > 0"));
        assert_eq!(browser.value("endless.play.pace.running"), true, "{control}");
        let seed = browser.value(STATE)["seed"].clone();
        browser.press("Space");
        assert_eq!(browser.value("endless.play.pace.running"), false, "{control}: Space pauses");
        assert_eq!(browser.value(STATE)["seed"], seed, "{control}");
    }
    // A field has the keys while its text is edited.
    browser.click("#seed");
    browser.value("document.getElementById('seed').select()");
    for key in ["1", "7", "a"] {
        browser.call("Input.insertText", &json!({"text": key}));
    }
    browser.value("document.getElementById('seed').value = '17'");
    browser.press("ArrowLeft");
    browser.press("Space");
    assert_eq!(browser.value("[endless.play.pace.running, document.activeElement.id]"), json!([false, "seed"]));
    browser.enter();
    assert_eq!(browser.value(STATE)["seed"], "17");
    browser.press("ArrowLeft");
    browser.wait(&format!("{LENGTH} > 0"));
    // Only a control that the keyboard has reached has Space.
    browser.press("Space");
    browser.value("document.getElementById('sound').focus()");
    browser.press("Space");
    assert_eq!(browser.value("endless.play.pace.running"), false);
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_episode_that_ends_offers_the_next_one_on_the_picture() {
    let (server, mut browser) = (PageServer::start("web"), start("end"));
    let end = "while (!endless.play.state.done) endless.play.oneStep()";
    let shown = "document.getElementById('choices').checkVisibility()";
    // Each is offered in one place: beside the picture during an episode, and on it afterwards.
    let offers = "[...document.querySelectorAll('button')].filter((button) => /Again|Next seed/.test(button.textContent) \
                  && button.checkVisibility({ visibilityProperty: true })).length";
    visit(&mut browser, &server, "env=MortarMayhem-Grid-v0&seed=3");
    let state = |browser: &mut crate::chromium::Chromium| {
        let state = browser.value(STATE);
        (state["seed"].clone(), state["length"].clone())
    };
    for (act, seed) in
        [("#choices > :first-child", "3"), ("#choices > :last-child", "4"), ("KeyR", "4"), ("Enter", "5")]
    {
        assert_eq!((browser.value(shown), browser.value(offers)), (json!(false), json!(2)));
        browser.value(end);
        assert_eq!((browser.value(shown), browser.value(offers)), (json!(true), json!(2)));
        if act.starts_with('#') {
            browser.click(act);
        } else {
            browser.press(act);
        }
        assert_eq!(state(&mut browser), (json!(seed), json!(0)), "{act}");
    }
    browser.resize(390, 844, true);
    for (button, seed) in [("#choices > :first-child", "5"), ("#choices > :last-child", "6")] {
        browser.value(end);
        let inside = "(() => { const [button, screen] = [document.querySelector('BUTTON'), document.querySelector('#play > .screen')] \
                      .map((e) => e.getBoundingClientRect()); return button.height >= 44 && button.top >= screen.top && button.bottom <= \
                      Math.min(screen.bottom, innerHeight) })()";
        assert_eq!(browser.value(&inside.replace("BUTTON", button)), true, "{button} is on the picture, in view");
        browser.touch("touchStart", button);
        browser.touch("touchEnd", button);
        browser.wait(&format!("{LENGTH} === 0"));
        assert_eq!(state(&mut browser), (json!(seed), json!(0)), "{button}");
    }
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn the_ground_truth_is_shown_at_the_end_with_its_colours() {
    let (server, mut browser) = (PageServer::start("web"), start("truth"));
    visit(&mut browser, &server, "");
    let visible = "getComputedStyle(document.getElementById('view')).visibility";
    for spec in memory_gym().specs() {
        browser.value(&format!(
            "endless.start({{ id: '{}', options: {{}}, seed: '3' }}); endless.play.oneStep()",
            spec.id
        ));
        assert_eq!(browser.value(visible), "hidden", "{}: a person plays", spec.id);
        // Each colour of the legend, apart from those of later events, is in the view.
        let colors = browser.value(
            "[...document.querySelectorAll('#legend li')].map((item) => item.style.getPropertyValue('--color'))",
        );
        assert!(colors.as_array().unwrap().len() >= 2, "{}: {colors}", spec.id);
        let seen = format!(
            "(() => {{ const seen = new Set(); const add = () => {{ const data = endless.engine.view(endless.play.spec.frame).data; \
             for (let i = 0; i < data.length; i += 4) seen.add('#' + [...data.slice(i, i + 3)].map((byte) => byte.toString(16) \
             .padStart(2, '0')).join('')) }}; endless.play.choose('expert'); endless.play.stop(); add(); \
             for (let step = 0; step < 150 && !endless.play.state.done; step += 1) {{ endless.play.oneStep(); add() }} \
             return {colors}.filter((color) => !seen.has(color)) }})()"
        );
        let missing = browser.value(&seen);
        let rare = ["#ff0000", "#701824", "#308d46", "#373737"];
        assert!(
            missing.as_array().unwrap().iter().all(|color| rare.iter().any(|rare| color == rare)),
            "{}: {missing}",
            spec.id
        );
        assert_eq!(browser.value(visible), "visible", "{}: the expert plays", spec.id);
    }
    browser.value("endless.start({ id: 'MortarMayhem-Grid-v0', options: {}, seed: '3' })");
    browser.value("while (!endless.play.state.done) endless.play.oneStep()");
    assert_eq!(browser.value(visible), "visible", "at the end");
    browser.press("KeyR");
    assert_eq!(browser.value(visible), "hidden");
    browser.click("#show-truth");
    assert_eq!(browser.value(visible), "visible", "if asked for");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn back_leads_to_the_wall_and_a_tile_is_its_own_episode() {
    let (server, mut browser) = (PageServer::start("web"), start("history"));
    visit(&mut browser, &server, "wall=MysteryPath-Grid-v0&count=10&by=random&show_goal=true");
    browser.wait("endless.wall.state");
    browser.click("#wall-pause");
    let wall = browser.value("location.hash");
    browser.value("globalThis.shown = endless.wall.link; 0");
    browser.click("#picture");
    browser.wait("endless.play.active && endless.play.state");
    let state = browser.value(STATE);
    assert_eq!((&state["id"], &state["options"]), (&json!("MysteryPath-Grid-v0"), &json!({"show_goal": "true"})));
    assert_ne!(state["seed"], Json::Null);
    let link = browser.value("location.hash");
    browser.press("PageDown");
    assert_ne!(browser.value("location.hash"), link);
    browser.value("history.back()");
    browser.wait("document.getElementById('wall').checkVisibility()");
    assert_eq!(browser.value("location.hash"), wall);
    assert_eq!(browser.value("endless.wall.link === shown"), true, "the same wall goes on");

    // The agent plays with the reset parameters of its training; then those from before are back.
    browser.value("endless.start({ id: 'MortarMayhem-Grid-v0', options: { arena_size: '4' }, seed: '200000' })");
    let own = json!({"arena_size": "4"});
    browser.click("#agent");
    browser.wait("endless.play.player === 'agent'");
    assert_ne!(browser.value(STATE)["options"], own);
    browser.click("#person");
    assert_eq!(browser.value(STATE)["options"], own, "by the button");
    browser.press("KeyG");
    browser.wait("endless.play.player === 'agent'");
    browser.press("ArrowLeft");
    browser.wait("endless.play.player === 'person'");
    browser.press("KeyR");
    assert_eq!(browser.value(STATE)["options"], own, "by a direction");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn experts_of_a_wall_do_not_hold_up_the_page() {
    let (server, mut browser) = (PageServer::start("web"), start("worker"));
    visit(&mut browser, &server, "wall=SearingSpotlights-v0&count=250&by=expert");
    browser.value(
        "endless.wall.setPace(10000); document.getElementById('wall-pace').value = 10000; endless.wall.rate = null",
    );
    browser.wait("endless.wall.rate !== null");
    let rates = browser.value(&frames_per_second(3000));
    // Where the page itself steps, there is at least one step in every frame.
    assert!(rates[0].as_f64() > rates[1].as_f64().map(|steps| 2.0 * steps), "{rates}");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

/// The page's frames and the wall's steps per second, over some milliseconds.
fn frames_per_second(milliseconds: u32) -> String {
    format!(
        "new Promise((done) => {{ const start = performance.now(); let frames = 0; const count = () => {{ frames += 1; \
         const time = performance.now() - start; if (time < {milliseconds}) requestAnimationFrame(count); \
         else done([frames / time * 1000, endless.wall.rate]) }}; requestAnimationFrame(count) }})"
    )
}
