//! Tests the page in a real browser. `cargo xtask test --only browser` builds the page and runs these tests.

mod accessibility;
mod agents;
#[path = "../../../../tests/integration/support/chromium.rs"]
mod chromium;
mod hands;
mod landing;
mod layout;
mod own;
mod popgym;
mod server;
mod speed;

use std::path::{Path, PathBuf};

use chromium::Chromium;
use endless_gym_core::trace::{Trace, replay};
use endless_gym_memory_gym::memory_gym;
use serde_json::{Value as Json, json};
use server::PageServer;

const WIDE: (u32, u32) = (1440, 900);

/// The engine is loaded, and an episode or a wall is shown.
const READY: &str = "globalThis.endless && (endless.play.state || endless.wall.state)";

/// The episode's state in the page.
const STATE: &str = "endless.play.state";

fn start(name: &str) -> Chromium {
    Chromium::start(&PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("browser").join(name), WIDE)
}

/// Loads the page anew, with `link` after the `#` of its address.
fn visit(browser: &mut Chromium, server: &PageServer, link: &str) {
    browser.load("about:blank");
    browser.load(&format!("{}#{link}", server.url()));
    browser.wait(READY);
}

/// The text of the element with that id.
fn text(browser: &mut Chromium, id: &str) -> String {
    browser.value(&format!("document.getElementById('{id}').textContent")).as_str().unwrap().to_owned()
}

fn traces(folder: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/reference").join(folder);
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

fn open(browser: &mut Chromium, file: &[u8]) -> Json {
    browser.value(&format!("endless.engine.open(new Uint8Array({}))", json!(file)))
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn recorded_episodes_replay_without_a_difference() {
    let (server, mut browser) = (PageServer::start("web"), start("traces"));
    visit(&mut browser, &server, "");
    for (folder, least) in [("traces", 100), ("views", 40)] {
        let files = traces(folder);
        assert!(files.len() >= least, "{} files in {folder}", files.len());
        for spec in memory_gym().specs() {
            let of_id =
                |path: &&PathBuf| path.file_name().unwrap().to_string_lossy().starts_with(&format!("{}.", spec.id));
            let files: Vec<&PathBuf> = files.iter().filter(of_id).collect();
            assert!(files.len() >= 4, "{} in {folder}", spec.id);
            for path in files {
                let expected = Trace::open(path).unwrap();
                let steps: usize = expected.episodes.iter().map(|episode| episode.steps.len()).sum();
                let found = open(&mut browser, &std::fs::read(path).unwrap());
                assert_eq!(found["differences"], 0, "{}: {}", path.display(), found["first"]);
                assert_eq!(found["steps"], steps, "{}", path.display());
                assert_eq!(found["views"], if folder == "views" { steps } else { 0 }, "{}", path.display());
            }
        }
    }
    // A wrong checksum is found.
    let mut wrong = Trace::open(&traces("traces")[0]).unwrap();
    wrong.episodes[0].steps[3].crc ^= 1;
    let mut file = Vec::new();
    wrong.write(&mut file).unwrap();
    let found = open(&mut browser, &file);
    assert_eq!(found["differences"], 1);
    assert!(found["first"].as_str().unwrap().starts_with("episode 0, step 4: observation checksum"), "{found}");
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn every_environment_is_played_with_the_keyboard() {
    let (server, mut browser) = (PageServer::start("web"), start("keyboard"));
    visit(&mut browser, &server, "");
    for spec in memory_gym().specs() {
        browser.value(&format!("endless.start({{ id: '{}', options: {{}}, seed: '3' }})", spec.id));
        assert_eq!(browser.value(STATE)["id"], spec.id);
        assert_eq!(browser.value(STATE)["length"], 0, "nothing moves before a key");
        // Two held directions act in one single step.
        for code in ["ArrowRight", "KeyW"] {
            browser.key("rawKeyDown", code);
        }
        browser.wait(&format!("{STATE}.length > 0"));
        browser.press("Space");
        assert_eq!(text(&mut browser, "pause"), "Continue", "{}", spec.id);
        let before = browser.value(STATE)["length"].as_u64().unwrap();
        browser.press("KeyN");
        let state = browser.value(STATE);
        assert_eq!(state["length"], before + 1, "{}", spec.id);
        let expected = match spec.action_space.width() {
            2 => json!([2, 1]),
            _ if spec.id == "Endless-MysteryPath-v0" => json!([2]),
            _ => json!([3]),
        };
        assert_eq!(state["action"], expected, "{}", spec.id);
        for code in ["ArrowRight", "KeyW"] {
            browser.key("keyUp", code);
        }
        browser.press("KeyN");
        assert!(browser.value(STATE)["action"].as_array().unwrap().iter().all(|number| *number == 0), "{}", spec.id);
        // Both canvases show the engine's pixels.
        let same = |canvas: &str, picture: &str| {
            format!(
                "(() => {{ const a = document.getElementById('{canvas}').getContext('2d').getImageData(0, 0, 84, 84).data; \
                 const b = endless.engine.{picture}(endless.play.spec.frame).data; return a.every((byte, i) => byte === b[i]) }})()"
            )
        };
        assert_eq!(browser.value(&same("observation", "observation")), true, "{}", spec.id);
        assert_eq!(browser.value(&same("view", "view")), true, "{}", spec.id);
        browser.press("KeyR");
        assert_eq!(browser.value(STATE)["length"], 0);
        browser.press("PageDown");
        assert_eq!(browser.value(STATE)["seed"], "4");
        browser.press("PageUp");
        assert_eq!(browser.value("location.hash"), format!("#env={}&seed=3", spec.id));
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn an_address_names_an_episode() {
    let (server, mut browser) = (PageServer::start("web"), start("address"));
    let link = "env=SearingSpotlights-v0&seed=18446744073709551615&num_coins=%5B3%5D&agent_visible=true";
    let mut pictures = Vec::new();
    for _ in 0..2 {
        visit(&mut browser, &server, link);
        browser.value("for (let step = 0; step < 20; step += 1) endless.play.oneStep()");
        pictures.push(browser.value("Array.from(endless.engine.observation(endless.play.spec.frame).data)"));
        let state = browser.value(STATE);
        assert_eq!(state["options"], json!({"num_coins": "[3]", "agent_visible": "true"}));
        assert_eq!(state["seed"], "18446744073709551615");
        assert_eq!(browser.value("document.getElementById('parameter-num_coins').value"), "[3]");
        assert_eq!(browser.value("document.getElementById('parameter-agent_visible').checked"), true);
        assert_eq!(browser.value("new URLSearchParams(location.hash.slice(1)).get('num_coins')"), "[3]");
    }
    assert_eq!(pictures[0], pictures[1]);
    // Faults of an address give the engine's message, and the default episode is shown.
    for (link, message) in [
        ("env=Pong-v0&seed=1", "no environment `Pong-v0`; there are MortarMayhem-v0"),
        ("env=MysteryPath-v0&seed=one", "seed must be an integer, 0 to 18446744073709551615, got `one`"),
        ("env=MysteryPath-v0&seed=1&speed=9", "MysteryPath-v0 has no reset parameter `speed`; it has max_steps"),
        (
            "env=MysteryPath-v0&seed=1&agent_speed=900",
            "reset parameter `agent_speed` must be a number, 0 to 84, got 900",
        ),
        ("wall=Pong-v0", "no environment `Pong-v0`"),
    ] {
        browser.load("about:blank");
        browser.load(&format!("{}#{link}", server.url()));
        browser.wait("globalThis.endless && !document.getElementById('message').hidden");
        let said = text(&mut browser, "message");
        assert!(said.starts_with(message), "{link}: {said}");
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn the_form_shows_the_engines_parameter_table() {
    let (server, mut browser) = (PageServer::start("web"), start("form"));
    visit(&mut browser, &server, "");
    for spec in memory_gym().specs() {
        browser.value(&format!("endless.start({{ id: '{}', options: {{}}, seed: '1' }})", spec.id));
        let names = browser.value("[...document.querySelectorAll('#fields input')].map((input) => input.name).sort()");
        let mut expected: Vec<&str> = spec.parameters.iter().map(|parameter| parameter.name).collect();
        expected.sort_unstable();
        assert_eq!(names, json!(expected));
        // In groups, of which none is long.
        let groups = browser
            .value("[...document.querySelectorAll('fieldset')].map((group) => group.querySelectorAll('input').length)");
        assert!(groups.as_array().unwrap().iter().all(|count| (1..=10).contains(&count.as_u64().unwrap())), "{groups}");
        for parameter in spec.parameters {
            let hint =
                browser.value(&format!("document.getElementById('parameter-{}-hint').textContent", parameter.name));
            let hint = hint.as_str().unwrap();
            assert!(hint.contains(parameter.description) && hint.contains(&parameter.allowed()), "{hint}");
        }
    }
    visit(&mut browser, &server, "env=MortarMayhem-v0&seed=1");
    let fill = |name: &str, text: &str| {
        format!(
            "(() => {{ const field = document.getElementById('parameter-{name}'); field.value = '{text}'; \
             field.dispatchEvent(new Event('input')); document.getElementById('form').requestSubmit() }})()"
        )
    };
    let message = "reset parameter `arena_size` must be an integer, 2 to 6, got 99";
    browser.value(&fill("arena_size", "99"));
    assert_eq!(
        browser.value("document.getElementById('parameter-arena_size-error').textContent"),
        format!("✕ {message}")
    );
    assert_eq!(browser.value("document.getElementById('parameter-arena_size').ariaInvalid"), "true");
    assert_eq!(text(&mut browser, "message"), message);
    assert_eq!(browser.value(STATE)["options"], json!({}), "the episode before goes on");
    browser.value(&fill("arena_size", "3"));
    assert_eq!(browser.value(STATE)["options"], json!({"arena_size": "3"}));
    assert_eq!(browser.value("document.getElementById('message').hidden"), true);
    assert_eq!(browser.value("location.hash"), "#env=MortarMayhem-v0&seed=1&arena_size=3");
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_played_episode_is_saved_verified_and_opened() {
    let (server, mut browser) = (PageServer::start("web"), start("recording"));
    visit(&mut browser, &server, "env=MysteryPath-v0&seed=5&show_goal=true");
    browser.value("document.getElementById('pace').value = 100; endless.play.setPace(100)");
    for (code, steps) in [("ArrowRight", 15), ("KeyS", 30)] {
        browser.key("rawKeyDown", code);
        browser.wait(&format!("{STATE}.length > {steps}"));
        browser.key("keyUp", code);
    }
    browser.press("Space");
    let played = browser.value(STATE);
    browser.value("document.getElementById('save').click()");
    let file = browser.download();
    // `endless verify` calls the same function.
    let replayed = replay(memory_gym(), &Trace::open(&file).unwrap()).unwrap();
    assert_eq!((replayed.differences, json!(replayed.steps)), (0, played["length"].clone()));

    browser.value("endless.play.start({id: 'MortarMayhem-v0', options: {}, seed: '1'})");
    browser.choose("#file", &file);
    browser.wait(&format!("{STATE}.recording"));
    let said = text(&mut browser, "message");
    assert!(said.ends_with("replayed without a difference."), "{said}");
    browser.press("Space");
    browser.wait(&format!("{STATE}.recording.over"));
    let shown = browser.value(STATE);
    for same in ["id", "options", "seed", "return", "length", "progress"] {
        assert_eq!(shown[same], played[same], "{same}");
    }

    let broken = file.with_file_name("broken.json.gz");
    std::fs::write(&broken, b"no trace").unwrap();
    browser.choose("#file", &broken);
    browser
        .wait("document.getElementById('message').textContent.startsWith('broken.json.gz: the file must be a trace')");
    assert_eq!(browser.value(STATE)["id"], "MysteryPath-v0", "the episode before is still there");
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn experts_and_walls_play_by_themselves() {
    let (server, mut browser) = (PageServer::start("web"), start("experts"));
    visit(&mut browser, &server, "");
    for spec in memory_gym().specs() {
        browser.value(&format!("endless.start({{ id: '{}', options: {{}}, seed: '2' }})", spec.id));
        browser.value("endless.play.setPace(10000)");
        browser.press("KeyE");
        let limit = if spec.id.starts_with("Endless") { 150 } else { 10_000 };
        browser.wait(&format!("{STATE}.done || {STATE}.length >= {limit}"));
        browser.value("endless.play.stop()");
        let state = browser.value(STATE);
        assert!(state["return"].as_f64() > Some(0.0), "{}: {state}", spec.id);
    }
    visit(&mut browser, &server, "wall=all&count=100&by=expert");
    assert_eq!(browser.value("endless.wall.state.groups.map((group) => group.num_envs)"), json!(vec![10; 10]));
    browser.value("endless.wall.setPace(10000)");
    browser.wait("endless.wall.state.groups.some((group) => group.episodes > 0)");
    // The worker's canvas appears on the page.
    let opaque = "(() => { const { width, height } = document.getElementById('picture'); const canvas = new OffscreenCanvas(width, height); \
                  const context = canvas.getContext('2d'); context.drawImage(document.getElementById('picture'), 0, 0); \
                  return context.getImageData(0, 0, width, height).data.filter((byte, i) => i % 4 === 3 && byte === 255).length })()";
    assert_eq!(browser.value(opaque), 100 * 84 * 84);
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn a_phone_plays_by_touch() {
    let (server, mut browser) = (PageServer::start("web"), start("phone"));
    browser.resize(390, 844, true);
    visit(&mut browser, &server, "env=Endless-SearingSpotlights-v0&seed=1");
    browser.touch("touchStart", "#pad [data-directions='right up']");
    browser.wait(&format!("{STATE}.length > 1"));
    assert_eq!(browser.value(STATE)["action"], json!([2, 1]));
    browser.touch("touchEnd", "#pad");
    browser.wait(&format!("{STATE}.action.every((number) => number === 0)"));
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn the_page_works_offline_once_loaded() {
    let (server, mut browser) = (PageServer::start("web"), start("offline"));
    visit(&mut browser, &server, "env=MysteryPath-v0&seed=1");
    browser.value("navigator.serviceWorker.ready.then(() => true)");
    browser.wait("navigator.serviceWorker.controller");
    let url = server.url();
    drop(server);
    browser.load("about:blank");
    browser.load(&format!("{url}#env=SearingSpotlights-v0&seed=4"));
    browser.wait(READY);
    browser.press("KeyN");
    assert_eq!(browser.value(STATE)["length"], 1);
    assert_eq!(browser.value(STATE)["id"], "SearingSpotlights-v0");
}
