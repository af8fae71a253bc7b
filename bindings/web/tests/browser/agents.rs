//! Tests trained agents on the page, and the flash.

use std::path::Path;

use endless_gym_kernels::file::{self, File};
use endless_gym_memory_gym::memory_gym;
use serde_json::{Value as Json, json};

use crate::chromium::Chromium;
use crate::server::PageServer;
use crate::{STATE, start, text, visit};

const ID: &str = "MortarMayhem-Grid-v0";

/// The environments with a trained agent, those of the page's files.
fn with_agent() -> Vec<String> {
    let files = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../engine/page/files")).unwrap();
    let names = files.map(|file| file.unwrap().file_name().into_string().unwrap());
    let mut ids: Vec<String> = names.filter_map(|name| Some(name.strip_suffix(".safetensors")?.to_owned())).collect();
    ids.retain(|id| !id.ends_with("-none"));
    ids.sort();
    ids
}

fn clues(browser: &mut Chromium) -> Vec<String> {
    let items = browser.value("[...document.querySelectorAll('#clues li')].map((item) => item.className)");
    items.as_array().unwrap().iter().map(|kind| kind.as_str().unwrap().to_owned()).collect()
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_agent_plays_from_memory() {
    let (server, mut browser) = (PageServer::start("web"), start("agents"));
    visit(&mut browser, &server, &format!("env={ID}&seed=200000"));
    assert!(clues(&mut browser).is_empty());
    browser.press("KeyG");
    browser.wait("endless.play.player === 'agent'");
    browser.value("endless.play.stop()");
    // It starts with its training's reset parameters, which also appear in the address.
    assert_eq!(browser.value(STATE)["options"], json!({"command_count": "[3]"}));
    assert_eq!(
        browser.value("Object.fromEntries(new URLSearchParams(location.hash.slice(1)))"),
        json!({"env": ID, "seed": "200000", "by": "agent", "command_count": "[3]"})
    );
    assert!(text(&mut browser, "trained").contains("% with command count 3"), "{}", text(&mut browser, "trained"));
    // Each episode shows its commands, and the count includes its outcome.
    let mut successes = 0;
    for episode in 0..5 {
        browser.value("while (!endless.play.state.done) endless.play.oneStep()");
        let state = browser.value(STATE);
        let (of, done) =
            (state["progress"][0]["of"].as_u64().unwrap(), state["progress"][0]["value"].as_u64().unwrap());
        assert_eq!(state["clues"]["commands"].as_array().unwrap().len() as u64, of, "every command was shown");
        let kinds = clues(&mut browser);
        assert_eq!(kinds.iter().filter(|kind| *kind == "done").count() as u64, done);
        assert_eq!(kinds.iter().any(|kind| kind == "failed"), done < of);
        successes += u64::from(done == of);
        let expected = if done == of { "Done" } else { "Failed" };
        assert!(text(&mut browser, "said").starts_with(expected), "{}", text(&mut browser, "said"));
        let count = format!("Successes: {successes} of {}.", episode + 1);
        assert_eq!(text(&mut browser, "successes"), count);
        browser.press("PageDown");
        browser.value("endless.play.stop()");
        assert_eq!(browser.value("endless.play.player"), "agent");
    }
    // The agents nearly always succeed with the reset parameters of their training; endless environments have no success.
    for id in with_agent().iter().filter(|id| !id.starts_with("Endless-")) {
        visit(&mut browser, &server, &format!("env={id}&seed=200000&by=agent"));
        browser.wait("endless.play.player === 'agent'");
        let played = "for (let episode = 0; episode < 20; episode += 1) { endless.play.stop(); \
                      while (!endless.play.state.done) endless.play.oneStep(); endless.play.otherSeed(1) } endless.play.stop()";
        browser.value(played);
        let counted = browser.value("endless.play.agents.counted(endless.play.state)");
        assert_eq!(counted["episodes"], 20, "{id}");
        assert!(counted["successes"].as_u64() >= Some(16), "{id}: {counted}");
    }
    visit(&mut browser, &server, &format!("env={ID}&seed=200000&by=agent"));
    browser.wait("endless.play.player === 'agent'");
    // The same seed gives the same episode.
    let play = "while (!endless.play.state.done) endless.play.oneStep()";
    let outcome = |browser: &mut Chromium| {
        browser.value("endless.play.restart(); endless.play.stop()");
        browser.value(play);
        let state = browser.value(STATE);
        (state["return"].clone(), state["length"].clone())
    };
    assert_eq!(outcome(&mut browser), outcome(&mut browser));
    // Once started, the agent continues with the next seed.
    let seed = browser.value(STATE)["seed"].clone();
    browser.value("endless.play.setPace(10000); endless.play.restart()");
    browser.wait(&format!("{STATE}.seed !== '{}'", seed.as_str().unwrap()));
    browser.value("endless.play.stop()");
    // After a person takes over, the agent cannot continue the episode.
    browser.value("endless.play.setPace(25); endless.play.restart()");
    browser.press("ArrowUp");
    browser.wait("endless.play.player === 'person'");
    // The steps so far may be the agent's; this one is the person's.
    browser.value("endless.play.stop(); if (!endless.play.state.done) endless.play.oneStep()");
    assert_eq!(browser.value("location.hash.includes('by=')"), false);
    let late = browser
        .value("(() => { try { endless.engine.request('step_of_agent') } catch (error) { return error.message } })()");
    if browser.value(STATE)["done"] == false {
        assert!(late.as_str().unwrap().starts_with("the agent must play an episode from its first step"), "{late}");
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn only_environments_with_an_agent_offer_it() {
    let (server, mut browser) = (PageServer::start("web"), start("no-agents"));
    visit(&mut browser, &server, "");
    let with_agent = with_agent();
    assert!(with_agent.len() >= 3, "{with_agent:?}");
    for spec in memory_gym().specs() {
        let has_agent = with_agent.iter().any(|id| id == spec.id);
        browser.value(&format!("endless.start({{ id: '{}', options: {{}}, seed: '1' }})", spec.id));
        let disabled = browser.value("document.getElementById('agent').ariaDisabled");
        assert_eq!(disabled, (!has_agent).to_string(), "{}", spec.id);
        let reason = text(&mut browser, "agent-reason");
        assert_eq!(reason.is_empty(), has_agent, "{reason}");
        if !reason.is_empty() {
            let expected = format!("No agent was trained in {}; there is one for {}", spec.id, with_agent.join(", "));
            assert!(reason.starts_with(&expected), "{reason}");
            assert!(browser.value("document.getElementById('agent-reason').offsetWidth").as_u64() > Some(100));
            browser.value("document.getElementById('agent').click()");
            assert_eq!(browser.value("endless.play.player"), "person");
        }
    }
    // A link selects the player, and its reset parameters override those of the training.
    visit(&mut browser, &server, &format!("env={ID}&seed=5&by=agent&command_count=%5B2%5D"));
    browser.wait("endless.play.player === 'agent'");
    assert_eq!(browser.value(STATE)["options"], json!({"command_count": "[2]"}));
    visit(&mut browser, &server, "env=MysteryPath-v0&seed=5&by=expert");
    browser.wait("endless.play.player === 'expert'");
    for (link, message) in [
        ("env=MysteryPath-v0&seed=5&by=agent", "No agent was trained in MysteryPath-v0"),
        ("env=MysteryPath-v0&seed=5&by=magic", "by must be agent or expert, got `magic`"),
    ] {
        visit(&mut browser, &server, link);
        browser.wait("!document.getElementById('message').hidden");
        assert!(text(&mut browser, "message").starts_with(message), "{}", text(&mut browser, "message"));
    }
    // A broken or missing file is reported, and the person keeps playing.
    let failing = "globalThis.fetch = async () => new Response(new Uint8Array([80, 75]), { status: STATUS })";
    for (status, message) in [
        ("200", "the file of the agent is damaged: it must be in the format safetensors"),
        ("404", "cannot be loaded: 404"),
    ] {
        visit(&mut browser, &server, &format!("env={ID}&seed=1"));
        browser.value(&format!("{}; 0", failing.replace("STATUS", status)));
        browser.press("KeyG");
        browser.wait("!document.getElementById('message').hidden");
        assert!(text(&mut browser, "message").contains(message), "{}", text(&mut browser, "message"));
        assert_eq!(browser.value("endless.play.player"), "person");
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_agent_of_a_file_plays() {
    let (server, mut browser) = (PageServer::start("web"), start("opened-agents"));
    visit(&mut browser, &server, "env=MysteryPath-v0&seed=7");
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/agents");
    for (name, kind) in [("gated-deltanet", "A Gated DeltaNet"), ("mamba2", "A Mamba-2"), ("retnet", "A RetNet")] {
        browser.choose("#file", &folder.join(format!("{name}.safetensors")));
        browser.wait(&format!("document.getElementById('trained').textContent.startsWith('{kind}')"));
        let state = browser.value(STATE);
        assert_eq!((&state["id"], &state["seed"]), (&json!(ID), &json!("7")));
        assert_eq!(state["options"], json!({"command_count": "[1,2]"}));
        assert_eq!(browser.value("endless.play.player"), "agent");
        // Who follows a link does not have the file.
        assert_eq!(browser.value("location.hash.includes('by=')"), false);
        assert!(!text(&mut browser, "trained").contains("0.0 million"), "{}", text(&mut browser, "trained"));
        browser.value("endless.play.stop(); while (!endless.play.state.done) endless.play.oneStep()");
        assert!(text(&mut browser, "successes").ends_with(" of 1."), "{}", text(&mut browser, "successes"));
    }
    // A file whose evaluation measured no success, as in endless environments, and one of an environment that is not on the page.
    let whole = std::fs::read(folder.join("retnet.safetensors")).unwrap();
    let File { tensors, header } = file::read(&whole).unwrap();
    let header = header.unwrap();
    let file = std::env::temp_dir().join(format!("endless-page-{}.safetensors", std::process::id()));
    let open = |browser: &mut Chromium, from: &str, to: &str| {
        let changed = file::write(header.replace(from, to), tensors.tensors()).unwrap();
        std::fs::write(&file, changed).unwrap();
        browser.choose("#file", &file);
    };
    open(&mut browser, "success", "other");
    browser.wait("document.getElementById('trained').textContent.endsWith('steps; its mean return is 0.02 with command count 1; its mean return is 0.02 with command count 2.')");
    open(&mut browser, ID, "MortarMayhem-Grid-v9");
    browser.wait(
        "document.getElementById('message').textContent.endsWith('MortarMayhem-Grid-v9, which is not on this page')",
    );
    std::fs::remove_file(file).unwrap();
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_flash_shows_a_sign_besides_its_colour() {
    let (server, mut browser) = (PageServer::start("web"), start("flash"));
    visit(&mut browser, &server, &format!("env={ID}&seed=200000"));
    // Record what each flash shows.
    browser.value(
        "globalThis.flashes = []; const screen = document.querySelector('#play > .screen'); new MutationObserver(() => { \
         if (screen.dataset.flash) flashes.push([screen.dataset.flash, screen.querySelector('.sign').textContent, \
         getComputedStyle(screen.querySelector('.sign')).animationName]) }).observe(screen, { attributes: true }); 0",
    );
    let play = "(async () => { endless.play.start({ ID_AND_OPTIONS, seed: 'SEED' }, 'PLAYER'); endless.play.stop(); \
                while (!endless.play.state.done) { endless.play.oneStep(); await new Promise((done) => setTimeout(done)) } \
                return endless.play.state.return })()";
    let play = |browser: &mut Chromium, what: &str, seed: u32, player: &str| {
        let given = play.replace("ID_AND_OPTIONS", what).replace("SEED", &seed.to_string()).replace("PLAYER", player);
        browser.value("flashes.length = 0; 0");
        browser.value(&given);
        browser.value("flashes")
    };
    let mortar = format!("id: '{ID}', options: {{ command_count: '[2]' }}");
    assert_eq!(play(&mut browser, &mortar, 1, "expert"), json!([]), "off by default");
    browser.value("document.getElementById('flash').click()");
    assert_eq!(
        play(&mut browser, &mortar, 1, "expert"),
        json!([["reward", "+", "flash"], ["success", "✓", "flash"]]),
        "one command, then the last one"
    );
    assert_eq!(play(&mut browser, &mortar, 1, "person"), json!([["failure", "✕", "flash"]]));
    let spotlights = "id: 'SearingSpotlights-v0', options: { reward_inside_spotlight: '-0.1', max_steps: '60' }";
    let found = (0..8).map(|seed| play(&mut browser, spotlights, seed, "person")).find(|found| found[0][0] == "damage");
    assert_eq!(found.expect("a spotlight finds the agent")[0], json!(["damage", "−", "flash"]));
    // The flash disappears.
    browser.wait("!document.querySelector('[data-flash]')");
    // With reduced motion, the sign is shown without an animation.
    let reduced = json!({"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]});
    browser.call("Emulation.setEmulatedMedia", &reduced);
    let found: Json = play(&mut browser, &mortar, 1, "expert");
    assert_eq!(found, json!([["reward", "+", "none"], ["success", "✓", "none"]]));
}
