//! Tests the page of a running engine in a real browser. `cargo xtask test --only browser` runs these tests.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::support::chromium::{Chromium, REBOUND};
use crate::support::page::Server;
use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::Process;
use endless_gym::pool::{PoolConfig, ResetRequest};
use serde_json::Value as Json;

const ID: &str = "MortarMayhem-Grid-v0";
const NUM_ENVS: usize = 20;
const FRAME: usize = 84 * 84 * 3;

/// Whether the page is live and has received a batch.
const SHOWN: &str = "globalThis.endless?.newest && document.getElementById('state').dataset.state === 'live'";

/// The RGBA pixels of a canvas, in rows.
const PIXELS: &str = "((canvas) => Array.from(canvas.getContext('2d').getImageData(0, 0, 84, 84).data))";

fn start(name: &str) -> Chromium {
    Chromium::start(&PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("browser").join(name), (1400, 900))
}

fn serve(place: &Place) -> Process {
    place.serve(&["--env", ID, "--num-envs", &NUM_ENVS.to_string(), "--seed", "1"])
}

/// A trainer that steps until it is stopped, or until the engine ends.
struct Training {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<(u64, Vec<u8>)>,
}

impl Training {
    fn start(place: &Place) -> Self {
        let (stop, mut trainer) = (Arc::new(AtomicBool::new(false)), place.trainer("endless").unwrap());
        let flag = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            let timeout = Duration::from_secs(60);
            trainer.reset(0, ResetRequest::Seed(1)).unwrap();
            let mut last = (0, Vec::new());
            for step in 0.. {
                let Ok(lease) = trainer.receive(0, timeout) else { return last };
                last = (lease.step(), lease.batch().observation().to_vec());
                drop(lease);
                let action = |(env, action): (usize, &mut i32)| *action = (step + env as i32) % 4;
                if flag.load(Ordering::Relaxed)
                    || trainer.send_with(0, |all| all.iter_mut().enumerate().for_each(action)).is_err()
                {
                    return last;
                }
                std::thread::sleep(Duration::from_millis(5));
            }
            last
        });
        Training { stop, thread }
    }

    /// The number of the last batch, and its observations.
    fn end(self) -> (u64, Vec<u8>) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap()
    }
}

/// Asserts that a canvas shows that environment's observation.
fn assert_shown(browser: &mut Chromium, canvas: &str, observations: &[u8], env: usize) {
    let shown = browser.value(&format!("{PIXELS}({canvas})"));
    let observation = &observations[env * FRAME..][..FRAME];
    let expected = (0..84 * 84).flat_map(|place| {
        let at = (place % 84 * 84 + place / 84) * 3;
        [observation[at], observation[at + 1], observation[at + 2], 255]
    });
    assert!(shown == expected.collect::<Json>(), "{canvas} does not show environment {env}");
}

fn grid(place: usize) -> String {
    format!("document.querySelectorAll('#grid canvas')[{place}]")
}

#[test]
#[ignore = "needs Chromium"]
fn a_running_engine_is_shown_lost_and_found() {
    let place = Place::new();
    let mut engine = serve(&place);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut browser = start("view");
    let training = Training::start(&place);
    browser.load(&server.url);
    browser.wait(SHOWN);
    assert_eq!(browser.value("document.querySelectorAll('#grid canvas').length"), 16);
    // The frames change.
    browser.value(&format!("globalThis.before = {PIXELS}({}).join(); 0", grid(0)));
    browser.wait(&format!("{PIXELS}({}).join() !== before", grid(0)));
    // One environment is enlarged next to the grid.
    browser.value("document.querySelectorAll('#grid button')[3].click()");
    browser.wait("document.getElementById('caption').textContent.startsWith('Environment 3: step ')");
    assert_eq!(browser.value("document.getElementById('enlarged').checkVisibility()"), true);
    // Each curve has a line and shows its last value.
    browser
        .wait("[...document.querySelectorAll('#curves path')].every((path) => path.getAttribute('d').includes('L'))");
    let values = browser.value("[...document.querySelectorAll('#curves b')].map((value) => value.textContent)");
    assert!(values.as_array().unwrap().len() == 5 && !values.to_string().contains('–'), "{values}");
    let numbers = browser.value("document.getElementById('numbers').textContent");
    assert!(numbers.as_str().unwrap().contains(ID), "{numbers}");

    // The last batch stays available, even for environments that were not shown.
    let (step, observations) = training.end();
    browser.wait(&format!("endless.about.batch.step === {step}"));
    (0..16).for_each(|env| assert_shown(&mut browser, &grid(env), &observations, env));
    assert_shown(&mut browser, "document.getElementById('enlarged')", &observations, 3);
    browser.value("document.getElementById('after').click()");
    browser.wait("document.querySelectorAll('#grid canvas').length === 4");
    (0..4).for_each(|place| assert_shown(&mut browser, &grid(place), &observations, 16 + place));
    // The range says why a button is disabled, and the keyboard still reaches it.
    let buttons = "['before', 'after'].map((id) => document.getElementById(id)).map((button) => [button.ariaDisabled, button.disabled, \
                   button.ariaDescribedByElements[0].textContent])";
    let range = "16 to 19 of 20";
    assert_eq!(browser.value(buttons), serde_json::json!([["false", false, range], ["true", false, range]]));
    browser.value("document.getElementById('smaller').click()");
    assert_eq!(browser.value("document.getElementById('enlarged').checkVisibility()"), false);

    // A killed engine cannot announce its end.
    engine.kill();
    browser.wait("document.getElementById('state').dataset.state === 'lost'");
    assert_eq!(browser.value("document.getElementById('state').textContent"), "lost: waiting for the engine");
    // The times since its start and since its last request go on.
    let times = "[...document.querySelectorAll('#numbers dd')].slice(-2).map((time) => time.textContent)";
    browser.value(&format!("globalThis.times = {times}; 0"));
    browser.wait(&format!("{times}.every((time, place) => time.endsWith(' s ago') && time !== times[place])"));
    let _engine = serve(&place);
    browser.wait("document.getElementById('state').textContent === 'no trainer'");
    let training = Training::start(&place);
    browser.value("globalThis.shown = endless.frames; 0");
    browser.wait("endless.frames > shown + 3");
    training.end();
}

#[test]
#[ignore = "needs Chromium"]
fn the_address_keeps_the_engine_and_episodes_count_that_nobody_watched() {
    let place = Place::new();
    let _engine = place.serve(&["--env", "Endless-MortarMayhem-v0", "--num-envs", "4", "--seed", "1"]);
    let mut trainer = place.trainer("endless").unwrap();
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    let (mut returns, mut episodes) = (0.0, 0.0);
    // Standing still ends each episode at a command.
    while episodes < 4.0 {
        let lease = trainer.receive(0, Duration::from_secs(60)).unwrap();
        let batch = lease.batch();
        for env in (0..4).filter(|env| batch.has_ended(*env)) {
            (returns, episodes) = (returns + batch.episode_return()[env], episodes + 1.0);
        }
        drop(lease);
        if episodes < 4.0 {
            trainer.send_with(0, |actions| actions.fill(0)).unwrap();
        }
    }
    let server = Server::start(place.endless(&["view"]));
    let mut browser = start("view-address");
    browser.load(&server.url);
    browser.wait("document.querySelector('#engines button')");
    browser.click("#engines button");
    browser.wait("endless.service === 'endless' && location.hash === '#engine=endless'");
    // All episodes ended before the page was opened.
    let mean = |what: &str| {
        format!(
            "[...document.querySelectorAll('#curves figure')].find((figure) => figure.innerText.startsWith('{what}')).querySelector('b').textContent"
        )
    };
    browser.wait(&format!("{} !== '–'", mean("Mean return")));
    assert_eq!(browser.value(&mean("Mean return")), format!("{:.3}", returns / episodes));
    let connect = browser.value("document.getElementById('connect').textContent");
    assert_eq!(connect, r#"A trainer connects with endless_gym.connect("endless")."#);
    // The trainer goes on, and one environment is enlarged, with its ground truth.
    trainer.send_with(0, |actions| actions.fill(0)).unwrap();
    trainer.receive(0, Duration::from_secs(60)).unwrap();
    browser.wait(SHOWN);
    browser.value("document.querySelectorAll('#grid button')[1].click()");
    browser.wait("/, target_x [.0-9]+, target_y [.0-9]+$/.test(document.getElementById('caption').textContent)");
    browser.reload();
    browser.wait("globalThis.endless?.service === 'endless' && document.getElementById('live').checkVisibility()");
    browser.value("history.back()");
    browser.wait("endless.service === '' && document.getElementById('list').checkVisibility()");
}

#[test]
#[ignore = "needs Chromium"]
fn an_engine_without_frames_draws_for_the_page() {
    let place = Place::new();
    let _engine = place.serve(&["--env", ID, "--num-envs", "3", "--features", "--no-frames"]);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut browser = start("view-features");
    browser.load(&server.url);
    browser.wait("document.getElementById('state')?.textContent === 'no trainer'");
    let mut trainer = place.trainer("endless").unwrap();
    let mut twin = Player::new(&PoolConfig::new(ID, 3));
    crate::support::service::reset(&mut trainer, 0);
    twin.reset(ResetRequest::Seed(3));
    browser.wait(SHOWN);
    (0..3).for_each(|env| assert_shown(&mut browser, &grid(env), twin.batch().observation(), env));
    for hidden in ["no-frames", "nothing"] {
        assert_eq!(browser.value(&format!("document.getElementById('{hidden}').checkVisibility()")), false, "{hidden}");
    }
    // The numbers are below the pictures.
    let numbers = "document.querySelectorAll('#values tr').length";
    assert_eq!(
        (browser.value(numbers), browser.value("document.getElementById('rows').checkVisibility()")),
        (3.into(), true.into())
    );
    browser.value("document.querySelectorAll('#grid button')[2].click()");
    assert_shown(&mut browser, "document.getElementById('enlarged')", twin.batch().observation(), 2);
}

#[test]
#[ignore = "needs Chromium"]
fn an_empty_list_a_missing_engine_and_a_missing_trainer_are_named() {
    let place = Place::new();
    let (list, server) = (Server::start(place.endless(&["view"])), Server::start(place.endless(&["view", "endless"])));
    let mut browser = start("missing");
    let shown =
        |browser: &mut Chromium, text: &str| browser.wait(&format!("document.body.innerText.includes('{text}')"));
    browser.load(&list.url);
    shown(&mut browser, &format!("No engine is running in {}.", place.namespace().root().display()));
    assert_eq!(browser.value("document.querySelector('table').checkVisibility()"), false);
    browser.load(&server.url);
    shown(&mut browser, "The engine endless does not run.");
    let _engine = serve(&place);
    shown(&mut browser, "No trainer is connected to this engine.");
    assert_eq!(browser.value("document.getElementById('state').textContent"), "no trainer");
    let mut trainer = place.trainer("endless").unwrap();
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    trainer.receive(0, Duration::from_secs(60)).unwrap();
    browser.wait(SHOWN);
    assert_eq!(browser.value("document.getElementById('nothing').checkVisibility()"), false);
    // The trainer pauses, and another page opens.
    browser.load("about:blank");
    browser.load(&server.url);
    browser.wait("document.getElementById('state')?.textContent === 'live'");
    browser.load(&list.url);
    browser.wait("document.querySelectorAll('#engines tr').length === 1");
}

#[test]
#[ignore = "needs Chromium"]
fn a_page_in_the_background_gets_no_frames() {
    let place = Place::new();
    let _engine = serve(&place);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut browser = start("background");
    let training = Training::start(&place);
    browser.load(&server.url);
    browser.wait(SHOWN);
    let hide = |hidden| {
        format!(
            "Object.defineProperty(document, 'hidden', {{ value: {hidden}, configurable: true }}); \
             document.dispatchEvent(new Event('visibilitychange')); 0"
        )
    };
    browser.value(&hide(true));
    // The curves continue, and the last frame stays visible.
    browser.wait("endless.about.batch.envs.length === 0");
    browser.value("globalThis.points = endless.curves.points.length; globalThis.shown = endless.frames; 0");
    browser.wait("endless.curves.points.length > points");
    assert_eq!(browser.value("endless.frames - shown"), 0);
    assert_eq!(browser.value("document.querySelectorAll('#grid canvas').length"), 16);
    browser.value(&hide(false));
    browser.wait("endless.frames > shown + 3");
    training.end();
}

#[test]
#[ignore = "needs Chromium"]
fn other_sites_and_addresses_without_the_token_are_refused() {
    let place = Place::new();
    let _engine = serve(&place);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut browser = start("refused");
    let (port, token) = (server.address().port(), server.token().to_owned());
    for address in [format!("http://127.0.0.1:{port}/"), format!("http://127.0.0.1:{port}/?token={}", "0".repeat(32))] {
        browser.load(&address);
        browser.wait("document.body.innerText.startsWith('the address must have the token')");
    }
    // The outcome of a WebSocket connection to the engine: `open` or `refused`.
    let open = format!(
        "new Promise((done) => {{ const socket = new WebSocket('ws://127.0.0.1:{port}/{token}/socket?service=endless'); \
         socket.onopen = () => done('open'); socket.onerror = () => done('refused') }})"
    );
    browser.load(&server.url);
    browser.wait("document.getElementById('state')?.dataset.state === 'idle'");
    assert_eq!(browser.value(&open), "open", "the page's own");
    // DNS rebinding: another site's name resolves to this machine, and its page knows the token.
    browser.load(&format!("http://{REBOUND}:{port}/?token={token}"));
    browser.wait("document.body.innerText.startsWith('the Host header must name this server')");
    assert_eq!(browser.value(&open), "refused", "with the Origin of another site");
    let read = format!(
        "fetch('http://127.0.0.1:{port}/{token}/engines').then((answer) => answer.text()).catch(() => 'refused')"
    );
    assert_eq!(browser.value(&read), "refused");
    browser.load("about:blank");
    assert_eq!(browser.value(&open), "refused", "without an Origin of its own");
    browser.complaints.clear();
}

#[test]
#[ignore = "needs Chromium"]
fn nothing_jumps_and_nothing_is_cut_off() {
    let place = Place::new();
    let _engine = place.serve(&["--env", ID, "--num-envs", "20", "--groups", "2", "--seed", "1"]);
    let list = Server::start(place.endless(&["view"]));
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut browser = start("view-layout");
    let training = Training::start(&place);
    // It is negative if space is reserved for a scroll bar.
    let cut = "Math.max(0, document.documentElement.scrollWidth - document.documentElement.clientWidth)";
    // The sum of layout shifts, as browsers measure them.
    let shifts = "new Promise((done) => { let sum = 0; const moved = []; const observer = new PerformanceObserver((list) => { \
                  for (const entry of list.getEntries()) { sum += entry.value; moved.push(...entry.sources.map(({ node, \
                  previousRect, currentRect }) => [node?.id || node?.nodeName, node?.textContent, previousRect.toJSON(), currentRect.toJSON()])) } }); \
                  observer.observe({ type: 'layout-shift', buffered: true }); setTimeout(() => done({ sum, moved }), 300) })";
    for (width, height, phone) in [(1400, 900, false), (1024, 700, false), (390, 844, true), (320, 640, true)] {
        browser.resize(width, height, phone);
        browser.load("about:blank");
        browser.load(&server.url);
        browser.wait(SHOWN);
        browser.wait("document.querySelector('#curves path').getAttribute('d').includes('L')");
        let shifted = browser.value(shifts);
        assert!(shifted["sum"].as_f64() < Some(0.02), "{width}x{height}: {shifted}");
        assert_eq!(browser.value(cut), 0, "{width}x{height}");
        browser.value("document.querySelectorAll('#grid button')[3].click()");
        assert_eq!(browser.value(cut), 0, "enlarged, {width}x{height}");
        browser.load("about:blank");
        browser.load(&list.url);
        browser.wait("document.querySelectorAll('#engines tr').length === 1");
        assert_eq!(browser.value(cut), 0, "the list, {width}x{height}");
    }
    training.end();
}
