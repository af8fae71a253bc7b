//! Plays as a visitor does, with mouse, keys and fingers.

use endless_gym_memory_gym::memory_gym;
use serde_json::{Value as Json, json};

use crate::server::PageServer;
use crate::{STATE, start, text, visit};

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
    for (act, seed) in [
        ("#choices > :first-child", "3"),
        ("#choices > :last-child", "4"),
        ("KeyR", "4"),
        ("Enter", "5"),
        ("#pause", "6"),
    ] {
        assert_eq!((browser.value(shown), browser.value(offers)), (json!(false), json!(2)));
        browser.value(end);
        assert_eq!((browser.value(shown), browser.value(offers)), (json!(true), json!(2)));
        let largest =
            browser.value("[document.getElementById('pause').textContent, document.getElementById('pause').disabled]");
        assert_eq!(largest, json!(["New episode", false]), "there is nothing to continue");
        if act.starts_with('#') {
            browser.click(act);
        } else {
            browser.press(act);
        }
        assert_eq!(state(&mut browser), (json!(seed), json!(0)), "{act}");
    }
    browser.resize(390, 844, true);
    for (button, seed) in [("#choices > :first-child", "6"), ("#choices > :last-child", "7")] {
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
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn experts_of_a_wall_do_not_hold_up_the_page() {
    let (server, mut browser) = (PageServer::start("web"), start("worker"));
    visit(&mut browser, &server, "wall=Endless-SearingSpotlights-v0&count=250&by=expert");
    browser.value(
        "endless.wall.setPace(10000); document.getElementById('wall-pace').value = 10000; endless.wall.rate = null",
    );
    browser.wait("endless.wall.rate !== null");
    let rates = browser.value(&frames_per_second(3000));
    // Where the page itself steps, there is at least one step in every frame.
    assert!(rates[0].as_f64() > rates[1].as_f64(), "{rates}");
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_hidden_page_pauses_and_misses_no_step() {
    let (server, mut browser) = (PageServer::start("web"), start("hidden"));
    visit(&mut browser, &server, "env=MortarMayhem-v0&seed=3");
    browser.press("Space");
    browser.wait(&format!("{LENGTH} > 0"));
    browser.value(
        "Object.defineProperty(document, 'hidden', { value: true, configurable: true }); document.dispatchEvent(new Event('visibilitychange')); 0",
    );
    assert_eq!(browser.value("endless.play.pace.running"), false);
    // A frame that comes ten seconds after the last one.
    let late = "(async () => { const { Pace } = await import('./pace.js'); const frames = []; const real = globalThis.requestAnimationFrame; \
                globalThis.requestAnimationFrame = (frame) => frames.push(frame); let steps = 0; const pace = new Pace(25, (count) => (steps += count)); \
                pace.start(); for (const now of [0, 20, 10000, 10020]) frames.shift()(now); globalThis.requestAnimationFrame = real; return steps })()";
    assert!(browser.value(late).as_u64() <= Some(4), "{}", browser.value(late));
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_control_that_the_keyboard_has_reached_keeps_the_arrows() {
    let (server, mut browser) = (PageServer::start("web"), start("arrows"));
    visit(&mut browser, &server, "env=MortarMayhem-v0&seed=3");
    browser.value("document.querySelectorAll('details').forEach((details) => (details.open = true))");
    for control in ["environment", "pace"] {
        // The keyboard has been used last, so that the focus is visible.
        browser.press("Tab");
        browser.value(&format!("document.getElementById('{control}').focus()"));
        let change = format!(
            "(() => {{ const control = document.getElementById('{control}'); if (control.options) control.selectedIndex += 1; \
             else control.value = 30; for (const kind of ['input', 'change']) control.dispatchEvent(new Event(kind, {{ bubbles: true }})); \
             return document.activeElement.id }})()"
        );
        assert_eq!(browser.value(&change), control);
    }
    assert_eq!(
        browser.value("[endless.play.state.id, endless.play.pace.running]"),
        json!(["MortarMayhem-Grid-v0", false])
    );
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_environment_of_the_wall_is_named_and_played_by_the_keyboard() {
    let (server, mut browser) = (PageServer::start("web"), start("wall-keys"));
    visit(&mut browser, &server, "wall=all&count=40&by=random");
    browser.wait("endless.wall.state");
    let ids: Vec<&str> = memory_gym().specs().map(|spec| spec.id).collect();
    let names =
        |selector: &str| format!("[...document.querySelectorAll('{selector}')].map((name) => name.textContent)");
    assert_eq!(browser.value(&names("#wall-names span")), json!(ids));
    assert_eq!(browser.value(&names("#wall-table th[scope=row]")), json!(ids));
    // The hint is in view, and the pointer says that there is something to press.
    let hint = "document.getElementById('wall-hint').getBoundingClientRect().bottom <= innerHeight";
    assert_eq!(browser.value(hint), true);
    assert_eq!(browser.value("getComputedStyle(document.getElementById('picture')).cursor"), "pointer");
    browser.press("Tab");
    browser.value("document.getElementById('picture').focus()");
    for key in ["ArrowDown", "ArrowRight", "ArrowRight"] {
        browser.press(key);
    }
    // Row 1, column 2 of rows of ten, with four environments of each id.
    assert_eq!(
        browser.value("document.getElementById('picture').ariaLabel"),
        format!("Many environments; chosen: {}, 1 of 4", ids[3])
    );
    let chosen = "['#chosen', '#picture'].map((id) => document.querySelector(id).getBoundingClientRect())";
    let offset = format!(
        "(([tile, all]) => [tile.left - all.left, tile.top - all.top].map((place, i) => Math.round(place / [all.width, all.height][i] * 40)))({chosen})"
    );
    assert_eq!(browser.value(&offset), json!([8, 10]));
    browser.enter();
    browser.wait("endless.play.active && endless.play.state");
    assert_eq!(browser.value(STATE)["id"], ids[3]);
    // The first figure of steps per second is not that of the steps that wait for the start.
    visit(&mut browser, &server, "wall=MortarMayhem-v0&count=100&by=expert");
    browser.wait("endless.wall.rate !== null");
    assert!(browser.value("endless.wall.rate").as_f64() > Some(15.0));
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_file_that_is_too_large_is_named_so() {
    let (server, mut browser) = (PageServer::start("web"), start("large"));
    visit(&mut browser, &server, "env=MortarMayhem-v0&seed=3");
    // It takes no space on the disk.
    let path = std::env::temp_dir().join(format!("endless-large-{}.gz", std::process::id()));
    std::fs::File::create(&path).unwrap().set_len(3_000_000_000).unwrap();
    browser.choose("#file", &path);
    browser.wait("!document.getElementById('message').hidden");
    std::fs::remove_file(path).unwrap();
    let said = text(&mut browser, "message");
    assert!(said.ends_with(": the file has 3.0 GB; recordings and agents have at most 1 GB"), "{said}");
}

/// The page's frames and the wall's steps per second, over some milliseconds.
fn frames_per_second(milliseconds: u32) -> String {
    format!(
        "new Promise((done) => {{ const start = performance.now(); let frames = 0; const count = () => {{ frames += 1; \
         const time = performance.now() - start; if (time < {milliseconds}) requestAnimationFrame(count); \
         else done([frames / time * 1000, endless.wall.rate]) }}; requestAnimationFrame(count) }})"
    )
}
