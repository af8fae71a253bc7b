//! Measures the page that `cargo xtask web` has built:
//! `cargo test --locked -p endless-gym-web --test browser measure -- --ignored --nocapture`.

use endless_gym_memory_gym::memory_gym;
use serde_json::json;

use crate::chromium::Chromium;
use crate::server::PageServer;
use crate::{start, visit};

/// Loads of the landing, and reports of a wall, two a second.
const LOADS: usize = 20;
const REPORTS: usize = 6;

/// Sets `shown` to the milliseconds from the start of navigation to the frame after the one that shows the first picture.
const FIRST_PICTURE: &str = "const { prototype } = CanvasRenderingContext2D; const put = prototype.putImageData; \
    prototype.putImageData = function (...given) { prototype.putImageData = put; put.apply(this, given); \
    requestAnimationFrame(() => requestAnimationFrame((now) => (globalThis.shown = now))) }";

#[test]
#[ignore = "measures"]
fn measure_the_first_picture_and_the_pictures_of_walls() {
    let (server, mut browser) = (PageServer::start("web"), start("speed"));
    visit(&mut browser, &server, "");
    browser.value("navigator.serviceWorker.ready.then(() => true)");
    browser.wait("navigator.serviceWorker.controller");
    browser.call("Page.addScriptToEvaluateOnNewDocument", &json!({"source": FIRST_PICTURE}));
    let load = |_| {
        browser.load("about:blank");
        browser.load(&server.url());
        browser.wait("globalThis.shown");
        browser.value("shown").as_f64().unwrap()
    };
    print("milliseconds to the first picture", (0..LOADS).map(load).collect());
    for id in ["all"].into_iter().chain(memory_gym().specs().map(|spec| spec.id)) {
        visit(&mut browser, &server, &format!("wall={id}&count=100&by=expert"));
        browser.value("endless.wall.setPace(60)");
        // The first report is of the pace before.
        report(&mut browser);
        print(&format!("pictures a second of {id}"), (0..REPORTS).map(|_| report(&mut browser)).collect());
    }
}

/// The pictures a second of the wall's next report.
fn report(browser: &mut Chromium) -> f64 {
    browser.value("endless.wall.pictures = null");
    browser.wait("endless.wall.pictures");
    browser.value("endless.wall.pictures").as_f64().unwrap()
}

fn print(what: &str, mut all: Vec<f64>) {
    all.sort_by(f64::total_cmp);
    println!("{what}: median {:.1}, {:.1} to {:.1}", all[all.len() / 2], all[0], all[all.len() - 1]);
}
