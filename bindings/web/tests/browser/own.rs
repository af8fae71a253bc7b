//! Tests the page with environments of one's own and of POPGym, those of `tests/own/lib.rs`, which `endless page` writes.

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
fn environments_of_ones_own_are_played() {
    let (server, mut browser) = (PageServer::start("own/site"), start("own"));
    let action = "document.querySelectorAll('#numbers dd')[1].innerText";
    let text = |id: &str| format!("document.getElementById('{id}').innerText");
    // The first environment is shown, without trained agents, which are of other environments.
    visit(&mut browser, &server, "");
    assert_eq!(browser.value(STATE)["id"], "popgym-AutoencodeEasy-v0");
    visit(&mut browser, &server, "env=Small-v0&seed=1");
    let shown = browser.value("['agent', 'action', 'features'].map((id) => !document.getElementById(id).hidden)");
    assert_eq!(shown, json!([false, true, false]));
    browser.click("#action :nth-child(4)");
    assert_eq!(browser.value(STATE)["action"], json!([3]));
    // The square has moved to column 3.
    let pixels = "['observation', 'view'].map((id) => { const canvas = document.getElementById(id); \
                  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height); \
                  return [canvas.width, canvas.height, data.indexOf(200)] })";
    assert_eq!(browser.value(pixels), json!([[12, 12, 12], [12, 12, 12]]));

    visit(&mut browser, &server, "env=Numbers-v0&seed=1");
    browser.value("document.querySelector('#action select').value = '4'");
    browser.key("rawKeyDown", "ArrowRight");
    browser.wait(&format!("{STATE}.done"));
    browser.key("keyUp", "ArrowRight");
    assert_eq!(browser.value(STATE)["action"], json!([2, 4]));
    assert_eq!(browser.value(&text("features")), "move\n2\nlamp\n4");
    assert_eq!(browser.value(action), "→ white");
    assert!(browser.value(&text("said")).as_str().unwrap().starts_with("Episode over: return 5 in 5 steps"));

    visit(&mut browser, &server, "env=Slider-v0&seed=1");
    let kinds = "[...document.querySelectorAll('#action input')].map((input) => [input.type, input.min, input.max])";
    assert_eq!(browser.value(kinds), json!([["range", "-1", "2"], ["number", "", ""]]));
    browser
        .value("[...document.querySelectorAll('#action input')].forEach((input, i) => (input.value = [0.5, -700][i]))");
    browser.press("KeyN");
    assert_eq!(browser.value(action), "0.500, -700");
    assert_eq!(browser.value(pixels), json!([[20, 8, (2 * 20 + 5) * 4], [20, 8, (2 * 20 + 5) * 4]]));
    let sides =
        "['width', 'height'].map((side) => document.querySelector('#play > .screen').getBoundingClientRect()[side])";
    let sides = browser.value(sides);
    assert_eq!(sides[0].as_f64().unwrap() / sides[1].as_f64().unwrap(), 20.0 / 8.0);

    visit(&mut browser, &server, "wall=all&count=10");
    assert_eq!(
        browser.value("endless.wall.state.groups.slice(-2).map(({ id }) => id)"),
        json!(["Small-v0", "Slider-v0"])
    );
    browser.wait("endless.wall.state.groups.slice(-2).every(({ episodes }) => episodes > 0)");
    // An environment without frames cannot be on a wall, so it is played alone.
    visit(&mut browser, &server, "wall=Numbers-v0");
    browser.wait("!document.getElementById('message').hidden");
    assert_eq!(browser.value(STATE)["id"], "Numbers-v0");
    assert_eq!(browser.complaints, Vec::<String>::new());
    // The page works offline.
    assert_eq!(browser.value("navigator.serviceWorker.ready.then(() => true)"), true);
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn popgym_is_played_by_keys_and_by_touch_to_the_end() {
    let (server, mut browser) = (PageServer::start("own/site"), start("popgym"));
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
    assert_eq!(browser.complaints, Vec::<String>::new());
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

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_disabled_control_says_why() {
    let (server, mut browser) = (PageServer::start("own/site"), start("disabled"));
    for (link, button, reason) in [
        ("env=Small-v0&seed=1", "expert", "Small-v0 has no scripted expert."),
        ("env=Small-v0&seed=1", "step", "Episode over: return 5 in 5 steps."),
    ] {
        visit(&mut browser, &server, link);
        browser.value("document.querySelectorAll('details').forEach((details) => (details.open = true)); while (!endless.play.state.done) endless.play.oneStep()");
        let tree = browser.call("Accessibility.getFullAXTree", &json!({}));
        let node = tree["nodes"].as_array().unwrap().iter().find(|node| {
            let property = |name: &str| node["properties"].as_array()?.iter().find(|property| property["name"] == name);
            let is_disabled = property("disabled").is_some_and(|disabled| disabled["value"]["value"] == true);
            is_disabled && node["description"]["value"] == reason
        });
        assert!(node.is_some(), "{button}");
        // It is visible, and the keyboard reaches the button.
        let visible = format!(
            "[...document.getElementById('{button}').ariaDescribedByElements].every((element) => element.checkVisibility() && element.textContent === '{reason}') \
             && (document.getElementById('{button}').focus(), document.activeElement.id === '{button}')"
        );
        assert_eq!(browser.value(&visible), true, "{button}");
    }
    // A press says why, too, and nobody else plays.
    browser.click("#expert");
    assert_eq!(
        browser.value("[document.getElementById('message').textContent, endless.play.player]"),
        json!(["Small-v0 has no scripted expert.", "person"])
    );
    // What the page has nothing for is not offered.
    visit(&mut browser, &server, "wall=Small-v0");
    browser.wait("endless.wall.state");
    assert_eq!(browser.value("document.getElementById('wall-by').checkVisibility()"), false);
    assert_eq!(browser.value("document.querySelectorAll(':disabled').length"), 0);
    assert_eq!(browser.complaints, Vec::<String>::new());
}
