//! Tests the page of POPGym.

use serde_json::{Value as Json, json};

use crate::chromium::Chromium;
use crate::server::PageServer;
use crate::{STATE, start, text, visit};

/// Whether both canvases show the engine's pictures, which have several colours.
const SHOWN: &str = "['observation', 'view'].every((id) => { const { width, height } = endless.play.spec.picture; \
    const drawn = document.getElementById(id).getContext('2d').getImageData(0, 0, width, height).data; \
    return endless.engine[id]({ width, height }).data.every((byte, i) => byte === drawn[i]) && new Set(new Uint32Array(drawn.buffer)).size > 1 })";

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_link_leads_from_one_suite_to_the_other() {
    let (server, mut browser) = (PageServer::start("web"), start("suites"));
    visit(&mut browser, &server, "");
    let shown = "[endless.specs.length, endless.specs.every(({ id }) => id.startsWith('popgym-')), \
        document.getElementById('suite').textContent, document.querySelector('#source a').textContent]";
    for (length, is_popgym, other, own) in
        [(10, false, "POPGym", "Memory Gym"), (48, true, "Memory Gym", "POPGym"), (10, false, "POPGym", "Memory Gym")]
    {
        browser.wait(&format!("globalThis.endless?.specs.length === {length} && ({})", crate::READY));
        assert_eq!(browser.value(shown), json!([length, is_popgym, other, own]));
        browser.click("#suite");
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn popgym_is_played_by_keys_and_by_touch_to_the_end() {
    let (server, mut browser) = (PageServer::popgym(), start("popgym"));
    for (family, keys) in [
        ("Autoencode", ""),
        ("Battleship", ""),
        ("PositionOnlyCartPole", "ArrowLeft"),
        ("Concentration", ""),
        ("CountRecall", ""),
        ("HigherLower", ""),
        ("LabyrinthEscape", "ArrowRight"),
        ("MineSweeper", ""),
        ("MultiarmedBandit", ""),
        ("PositionOnlyPendulum", "Space"),
        ("RepeatFirst", ""),
        ("RepeatPrevious", ""),
    ] {
        let id = format!("popgym-{family}Easy-v0");
        for phone in [false, true] {
            browser.resize(if phone { 390 } else { 1440 }, 844, phone);
            visit(&mut browser, &server, &format!("env={id}&seed=7"));
            let what = format!("{id}, phone: {phone}");
            assert_eq!(browser.value(SHOWN), true, "{what}");
            let first = picture(&mut browser);
            act(&mut browser, keys, phone);
            browser.wait(&format!("{STATE}.length > 0"));
            browser.value("endless.play.stop()");
            assert_eq!(browser.value(SHOWN), true, "{what}");
            assert_eq!(browser.value("endless.play.player"), "person", "{what}");
            browser.value("while (!endless.play.state.done) endless.play.oneStep()");
            let said = text(&mut browser, "said");
            assert!(said.contains(": return "), "{what}: {said}");
            assert_eq!(browser.value("document.getElementById('share').checkVisibility()"), true, "{what}");
            // The link opens the same episode.
            let link = browser.value("location.hash.slice(1)");
            visit(&mut browser, &server, link.as_str().unwrap());
            assert_eq!((&browser.value(STATE)["id"], &browser.value(STATE)["seed"]), (&json!(id), &json!("7")));
            assert!(picture(&mut browser) == first, "{what}: another episode");
        }
    }
    browser.load("about:blank");
    browser.load(&format!("{}#env=popgym-RepeatPreviousEasy-v0%3Fk%3D2&seed=7", server.url()));
    browser.wait("globalThis.endless && !document.getElementById('message').hidden");
    let said = text(&mut browser, "message");
    assert_eq!(said, "the page plays environments without arguments, got `popgym-RepeatPreviousEasy-v0?k=2`");
}

fn picture(browser: &mut Chromium) -> Json {
    browser.value("Array.from(endless.engine.observation(endless.play.spec.picture).data)")
}

/// Plays by that key, or else by the last button of the actions, which the keyboard or a finger presses.
fn act(browser: &mut Chromium, key: &str, phone: bool) {
    let button = if key.is_empty() { "#action button:last-child" } else { "#pad button" };
    if phone && key == "Space" {
        browser.touch("touchStart", "#observation");
        browser.touch("touchEnd", "#observation");
    } else if phone {
        browser.touch("touchStart", button);
        browser.wait(&format!("{STATE}.length > 0 || document.querySelector('#pad button') === null"));
        browser.touch("touchEnd", button);
    } else if key.is_empty() {
        browser.press("Tab");
        browser.value(&format!("document.querySelector('{button}').focus()"));
        browser.enter();
        // It keeps the focus for the next step.
        assert_eq!(browser.value(&format!("document.activeElement === document.querySelector('{button}')")), true);
    } else {
        browser.press(key);
    }
}
