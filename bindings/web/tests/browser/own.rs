//! Tests the page with environments of one's own, those of `tests/own/lib.rs`, which `endless page` writes.

use serde_json::json;

use crate::server::PageServer;
use crate::{STATE, start, visit};

#[test]
#[ignore = "needs the built page and Chromium"]
fn environments_of_ones_own_are_played() {
    let (server, mut browser) = (PageServer::start("own/site"), start("own"));
    let action = "document.querySelectorAll('#numbers dd')[1].innerText";
    let text = |id: &str| format!("document.getElementById('{id}').innerText");
    // The first environment is shown, without trained agents, which are of other environments.
    visit(&mut browser, &server, "");
    assert_eq!(browser.value(STATE)["id"], "Small-v0");
    visit(&mut browser, &server, "env=Small-v0&seed=1");
    let shown = browser.value("['agent', 'action', 'features'].map((id) => !document.getElementById(id).hidden)");
    assert_eq!(shown, json!([false, true, false]));
    assert_eq!(browser.value("document.getElementById('suite').hidden"), true, "there is no other engine");
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
    // The page works offline.
    assert_eq!(browser.value("navigator.serviceWorker.ready.then(() => true)"), true);
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
}
