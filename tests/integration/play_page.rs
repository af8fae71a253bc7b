//! `endless play`: the page on which the environments are played, served on this machine.

use crate::support::page::{BROWSER, Server, given};
use crate::support::program::{Room, signal, text, wait};
use rustix::process::Signal;

#[test]
fn the_page_opens_at_an_episode() {
    let room = Room::new("play");
    let arguments = ["play", "SearingSpotlights-v0", "--seed", "9", "--option", "num_coins=[3]", "--open"];
    let browser = room.program("browser", BROWSER);
    let mut command = room.endless(&arguments);
    command.env("BROWSER", &browser);
    if !endless_gym_page::is_built() {
        // Only release builds have it; `cargo xtask test --only packages` tests them.
        let output = command.output().unwrap();
        assert!(!output.status.success());
        assert!(text(&output.stderr).contains("run `cargo xtask web`"), "{}", text(&output.stderr));
        return;
    }
    let mut server = Server::start(command);
    assert_eq!(given(&browser), server.url);
    let link = "/#env=SearingSpotlights-v0&seed=9&num_coins=%5B3%5D";
    assert_eq!(server.url, format!("http://{}{link}", server.address()));
    for (path, kind) in [
        ("/", "text/html; charset=utf-8"),
        ("/engine.wasm", "application/wasm"),
        ("/app.js", "text/javascript; charset=utf-8"),
        ("/style.css", "text/css; charset=utf-8"),
    ] {
        let (status, headers, body) = server.get(path, &[]);
        assert_eq!(status, 200, "{path}");
        assert!(headers.to_lowercase().contains(&format!("content-type: {kind}")), "{path}: {headers}");
        let name = if path == "/" { "index.html" } else { &path[1..] };
        assert_eq!(body, endless_gym_page::file(name).unwrap(), "{path}");
    }
    for path in ["/../Cargo.toml", "/%2e%2e/Cargo.toml", "/src/lib.rs", "/missing.js"] {
        assert_eq!(server.status(path, &[]), 404, "{path}");
    }
    assert_eq!(server.status("/", &[("Host", "example.org")]), 403);
    assert_eq!(server.status("/", &[("Origin", "http://example.org")]), 403);
    signal(&server.child, Signal::INT);
    assert!(wait(&mut server.child).success());
}

#[test]
fn what_cannot_be_played_is_said_before_the_page_is_served() {
    let room = Room::new("errors");
    for (arguments, message) in [
        (&["play", "Pong-v0"][..], "no environment `Pong-v0`"),
        (&["play", "MysteryPath-v0", "--option", "speed"], "--option speed: expected NAME=VALUE"),
        (&["play", "MysteryPath-v0", "--option", "speed=1"], "no reset parameter `speed`"),
    ] {
        let output = room.run(arguments);
        assert_eq!(output.status.code(), Some(1));
        assert!(text(&output.stderr).contains(message), "{}", text(&output.stderr));
    }
}
