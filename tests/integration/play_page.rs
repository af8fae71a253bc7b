//! `endless play`: the local page that plays the environments.

#[cfg(not(debug_assertions))]
use crate::support::page::{BROWSER, Server, given};
use crate::support::place::Place;
use crate::support::process::text;

const EPISODE: [&str; 7] = ["play", "SearingSpotlights-v0", "--seed", "9", "--option", "num_coins=[3]", "--open"];

#[test]
#[cfg(debug_assertions)]
fn a_program_without_the_page_says_how_to_play() {
    let place = Place::new();
    let output = place.endless(&EPISODE).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let stderr = text(&output.stderr);
    assert!(stderr.contains("`--terminal`") && stderr.contains("run `cargo xtask play`"), "{stderr}");
}

/// Only release builds contain the page, once it is built; `cargo xtask test --only packages` runs this.
#[test]
#[cfg(not(debug_assertions))]
fn the_page_opens_at_an_episode() {
    let place = Place::new();
    let browser = place.script("browser", BROWSER);
    let mut command = place.endless(&EPISODE);
    command.env("BROWSER", &browser);
    let mut server = Server::start(command);
    assert_eq!(given(&browser), server.url);
    let link = "/#env=SearingSpotlights-v0&seed=9&num_coins=%5B3%5D";
    assert_eq!(server.url, format!("http://{}{link}", server.address()));
    assert_eq!(server.status("/", &[]), 200);
    assert_eq!(server.status("/", &[("Host", "example.org")]), 403);
    assert_eq!(server.status("/", &[("Origin", "http://example.org")]), 403);
    server.process.interrupt();
}

#[test]
fn invalid_arguments_are_reported_before_the_page_is_served() {
    let place = Place::new();
    for (arguments, message) in [
        (&["play", "Pong-v0"][..], "no environment `Pong-v0`"),
        (&["play", "MysteryPath-v0", "--option", "speed"], "--option speed: expected NAME=VALUE"),
        (&["play", "MysteryPath-v0", "--option", "speed=1"], "no reset parameter `speed`"),
        // POPGym is not on the page.
        (
            &["play", "popgym-RepeatFirstEasy-v0"],
            "or write the page of your own crate with `endless page --out FOLDER`",
        ),
    ] {
        let output = place.run(arguments);
        assert_eq!(output.status.code(), Some(1));
        assert!(text(&output.stderr).contains(message), "{}", text(&output.stderr));
    }
}
