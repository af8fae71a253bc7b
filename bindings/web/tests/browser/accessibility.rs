//! What screen readers, slow connections and browsers without JavaScript get.

use std::path::PathBuf;

use serde_json::{Value as Json, json};

use crate::chromium::Chromium;
use crate::server::PageServer;
use crate::{start, visit};

/// Serious and critical violations that axe-core finds, in both themes.
fn assert_accessible(browser: &mut Chromium, what: &str) {
    for theme in ["light", "dark"] {
        browser.value(&format!("document.documentElement.dataset.theme = '{theme}'"));
        let found = browser.value(
            "axe.run({ resultTypes: ['violations'] }).then(({ violations }) => violations.filter(({ impact }) => ['serious', 'critical'].includes(impact)) \
             .map(({ id, nodes }) => [id, nodes.map((node) => node.html.slice(0, 120))]))",
        );
        assert_eq!(found, json!([]), "{what}, {theme}");
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn axe_finds_nothing_serious() {
    // `cargo xtask test --only browser` installs it.
    let axe = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).with_file_name("npm/node_modules/axe-core/axe.min.js");
    let axe = std::fs::read_to_string(&axe).unwrap_or_else(|error| panic!("{}: {error}", axe.display()));
    let (server, mut browser) = (PageServer::start("web"), start("axe"));
    // Colours change without a transition.
    let reduced = json!({"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]});
    browser.call("Emulation.setEmulatedMedia", &reduced);
    visit(&mut browser, &server, "");
    browser.wait("endless.play.isDemo && endless.play.player === 'agent'");
    browser.value(&format!("{axe}; 0"));
    assert_accessible(&mut browser, "the landing");
    for id in ["MortarMayhem-Grid-v0", "MysteryPath-v0"] {
        browser.value(&format!("endless.start({{ id: '{id}', options: {{}}, seed: '3' }}); while (!endless.play.state.done) endless.play.oneStep()"));
        assert_accessible(&mut browser, "the answer");
    }
    visit(&mut browser, &server, "env=SearingSpotlights-v0&seed=1");
    browser.value(&format!("{axe}; 0"));
    browser.value("document.querySelectorAll('details').forEach((details) => (details.open = true))");
    assert_accessible(&mut browser, "SearingSpotlights-v0");
    // axe-core has no rule for the names of native progress bars.
    assert_eq!(browser.value("document.querySelectorAll('progress:not([aria-label])').length"), 0);
    let unreachable = "[...document.querySelectorAll('button, input, select, summary')] \
                       .filter((control) => control.checkVisibility() && control.tabIndex < 0).length";
    assert_eq!(browser.value(unreachable), 0, "the keyboard reaches every control");
    browser
        .value("endless.start({ id: 'MortarMayhem-Grid-v0', options: {}, seed: '1' }); endless.play.choose('agent')");
    browser.wait("endless.play.player === 'agent'");
    browser.value("endless.play.stop(); while (!endless.play.state.done) endless.play.oneStep(); document.getElementById('copy').click()");
    browser.wait("!document.getElementById('message').hidden");
    assert_accessible(&mut browser, "the end of an agent's episode");
    browser.value("document.getElementById('to-wall').click()");
    browser.wait("endless.wall.state");
    assert_accessible(&mut browser, "the wall");
    // The border of each control, 3:1 against what is around it.
    let contrast = "(() => { const luminance = (color) => { const [r, g, b] = color.match(/[\\d.]+/g).slice(0, 3).map((c) => c / 255) \
                    .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)); return 0.2126 * r + 0.7152 * g + 0.0722 * b }; \
                    const behind = (e) => { for (; e; e = e.parentElement) { const c = getComputedStyle(e).backgroundColor; \
                    if (!c.endsWith(', 0)')) return c } return getComputedStyle(document.documentElement).backgroundColor }; \
                    return [...document.querySelectorAll('button, select, input:not([type=checkbox])')].filter((e) => e.checkVisibility() && !e.disabled \
                    && e.ariaDisabled !== 'true').map((e) => { const [a, b] = [luminance(getComputedStyle(e).borderTopColor), luminance(behind(e.parentElement))] \
                    .sort((a, b) => b - a); return [e.id, (a + 0.05) / (b + 0.05)] }).filter(([, ratio]) => ratio < 3) })()";
    for theme in ["light", "dark"] {
        browser.value(&format!("document.documentElement.dataset.theme = '{theme}'"));
        assert_eq!(browser.value(contrast), json!([]), "{theme}");
    }
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn live_regions_change_at_most_once_a_second() {
    let (server, mut browser) = (PageServer::start("web"), start("live"));
    let count = "new Promise((done) => { const times = new Map(); const observer = new MutationObserver((records) => records.forEach(({ target }) => { \
                 const region = (target.nodeType === 1 ? target : target.parentElement)?.closest('[role=status], [role=alert], [aria-live]'); \
                 if (region) times.set(region.id, [...(times.get(region.id) ?? []), performance.now()]) })); \
                 observer.observe(document.body, { subtree: true, childList: true, characterData: true }); \
                 setTimeout(() => { observer.disconnect(); done([...times].map(([id, all]) => [id, all.filter((time, i) => i > 0 && time - all[i - 1] < 990).length])) }, 2500) })";
    let quiet = |found: Json| found.as_array().unwrap().iter().all(|region| region[1] == 0);
    visit(&mut browser, &server, "env=SearingSpotlights-v0&seed=1&by=expert");
    browser.value("endless.play.setPace(60)");
    let found = browser.value(count);
    assert!(quiet(found.clone()), "{found}");
    visit(&mut browser, &server, "wall=MortarMayhem-v0&count=10");
    let found = browser.value(count);
    assert!(!found.as_array().unwrap().is_empty() && quiet(found.clone()), "{found}");
}

#[test]
#[ignore = "needs the built page and Chromium"]
fn the_page_tells_what_it_waits_for_and_what_it_lacks() {
    let (server, mut browser) = (PageServer::start("web"), start("loading"));
    let text = |id: &str| format!("document.getElementById('{id}').innerText.trim()");
    browser.call("Fetch.enable", &json!({"patterns": [{"urlPattern": "*engine.wasm"}]}));
    browser.load(&server.url());
    browser.wait("document.readyState === 'complete'");
    assert_eq!(browser.value(&text("said")), "Loading");
    assert_eq!(browser.value("document.getElementById('play').ariaBusy"), "true");
    browser.call("Fetch.disable", &json!({}));
    browser.wait("globalThis.endless?.play.state");
    assert_eq!(browser.value("document.getElementById('play').ariaBusy"), "false");
    // Without the engine.
    browser.call("Network.enable", &json!({}));
    browser.call("Network.setCacheDisabled", &json!({"cacheDisabled": true}));
    browser.call("Network.setBypassServiceWorker", &json!({"bypass": true}));
    browser.call("Network.setBlockedURLs", &json!({"urls": ["*engine.wasm"]}));
    browser.load("about:blank");
    browser.load(&server.url());
    browser.wait("!document.getElementById('message').hidden");
    assert_eq!(browser.value("document.getElementById('overlay').hidden"), true);
    let said = crate::text(&mut browser, "message");
    assert!(said.starts_with("The engine cannot be loaded ("), "{said}");
    browser.call("Network.setBlockedURLs", &json!({"urls": []}));
    // Without parts of the browser.
    for (lack, link, message) in [
        ("delete globalThis.WebAssembly", "", "This page needs WebAssembly"),
        (
            "delete HTMLCanvasElement.prototype.transferControlToOffscreen",
            "#wall=all",
            "The wall needs OffscreenCanvas",
        ),
    ] {
        let script = browser.call("Page.addScriptToEvaluateOnNewDocument", &json!({"source": lack}));
        browser.load("about:blank");
        browser.load(&format!("{}{link}", server.url()));
        browser.wait(&format!("document.getElementById('message')?.textContent.startsWith('{message}')"));
        browser.call("Page.removeScriptToEvaluateOnNewDocument", &script);
    }
    // Without JavaScript.
    browser.call("Emulation.setScriptExecutionDisabled", &json!({"value": true}));
    browser.load("about:blank");
    browser.load(&server.url());
    browser.wait("document.readyState === 'complete'");
    let bottom = browser.value("document.querySelector('noscript').getBoundingClientRect().bottom");
    assert!((1.0..900.0).contains(&bottom.as_f64().unwrap()), "{bottom}");
    assert_eq!(browser.value("document.getElementById('play').checkVisibility()"), false);
}
