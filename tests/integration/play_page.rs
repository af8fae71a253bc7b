//! `endless play`: the local page that plays the environments.

use crate::support::page::{BROWSER, Server, given};
use crate::support::place::Place;
use crate::support::process::text;

#[test]
fn the_page_opens_at_an_episode() {
    let place = Place::new();
    let arguments = ["play", "SearingSpotlights-v0", "--seed", "9", "--option", "num_coins=[3]", "--open"];
    let browser = place.script("browser", BROWSER);
    let mut command = place.endless(&arguments);
    command.env("BROWSER", &browser);
    if endless_gym_page::engine().is_none() {
        // Only release builds contain the page; `cargo xtask test --only packages` tests them.
        let output = command.output().unwrap();
        assert!(!output.status.success());
        let stderr = text(&output.stderr);
        assert!(stderr.contains("`--terminal`") && stderr.contains("run `cargo xtask play`"), "{stderr}");
        return;
    }
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
