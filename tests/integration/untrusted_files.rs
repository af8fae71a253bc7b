//! Files that are no regular files, claim too much, or have text that a terminal would obey.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::{Value as Json, json};

use crate::support::place::Place;
use crate::support::process::{Process, text};

/// Escape sequences of 7 and of 8 bits, a bell, a line break, and a direction of text.
const HOSTILE: &str = "\x1b]0;title\x07\u{9b}2J\nverified 1 traces\r\u{202e}";
const ESCAPED: &str = r"\u{1b}]0;title\u{7}\u{9b}2J\nverified 1 traces\r\u{202e}";

fn trace(path: &Path, env: &str, info: &str) {
    let steps = json!([[0, 0.0, false, 0, {info: 3}]]);
    let episode = json!({"seed": 1, "reset_crc": 0, "reset_info": {info: 7}, "steps": steps});
    let trace = json!({"env": env, "options": {}, "max_steps": 1, "episodes": [episode]});
    let mut file = GzEncoder::new(std::fs::File::create(path).unwrap(), Compression::fast());
    file.write_all(trace.to_string().as_bytes()).unwrap();
    file.finish().unwrap();
}

#[test]
fn text_of_a_trace_does_not_command_the_terminal() {
    let place = Place::new();
    let named = place.root().join(format!("{}.gz", HOSTILE.replace('/', "")));
    for (env, info) in [(HOSTILE, "a"), ("MysteryPath-v0", HOSTILE)] {
        trace(&named, env, info);
        for options in [&[][..], &["--json"]] {
            let output = place.run(&[&["verify", named.to_str().unwrap()], options].concat());
            let printed = text(&output.stdout);
            assert!(!printed.chars().any(|c| c != '\n' && (c.is_control() || c == '\u{202e}')), "{printed:?}");
            if options.is_empty() {
                assert_eq!(printed.lines().next().unwrap().matches(ESCAPED).count(), if info == "a" { 2 } else { 1 });
            } else {
                let json: Json = serde_json::from_str(printed).unwrap();
                assert_eq!(json["traces"][0]["file"], named.to_str().unwrap());
            }
        }
    }
    let output = place.run(&["list", HOSTILE]);
    assert!(text(&output.stderr).starts_with(&format!("endless: no environment `{ESCAPED}`")), "{output:?}");
    assert_eq!(text(&output.stderr).lines().count(), 1);
}

#[test]
fn what_is_not_a_regular_file_is_refused_at_once() {
    let place = Place::new();
    let [fifo, run, new] = ["fifo", "run", "new"].map(|name| place.root().join(name));
    std::fs::create_dir(&run).unwrap();
    for path in [&fifo, &run.join("settings.json")] {
        assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
    }
    for path in [fifo.to_str().unwrap(), "/dev/zero"] {
        let commands: [&[&str]; 5] = [
            &["verify", path],
            &["serve", "--config", path],
            &["serve", "--num-envs=1", "--checkpoint", path, "--resume"],
            &["learn", "--init-from", path, "--run", new.to_str().unwrap()],
            &["learn", "--resume", run.to_str().unwrap()],
        ];
        for arguments in commands {
            let mut process = Process::spawn(place.endless(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()));
            assert_eq!(process.wait().code(), Some(1), "{arguments:?}");
            let said = process.output() + &process.errors();
            let is_refused = said.contains("not a regular file") || path == "/dev/zero" && said.contains("/dev/zero");
            assert!(is_refused, "{arguments:?}: {said}");
        }
    }
}

/// A file of many tensors without elements: a header of 60 MB, which took seconds to read.
#[test]
fn a_million_empty_tensors_are_refused_at_once() {
    let place = Place::new();
    let file = place.root().join("many.safetensors");
    let tensor = |number| format!(r#""{number}":{{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}"#);
    let header = format!("{{{}}}", (0..1_000_000).map(tensor).collect::<Vec<_>>().join(","));
    let content = [&(header.len() as u64).to_le_bytes()[..], header.as_bytes()].concat();
    std::fs::write(&file, content).unwrap();
    let run = place.root().join("run");
    let Output { status, stderr, .. } =
        place.run(&["learn", "--init-from", file.to_str().unwrap(), "--run", run.to_str().unwrap()]);
    assert_eq!(status.code(), Some(1));
    assert!(text(&stderr).contains("far more tensors than a network"), "{}", text(&stderr));
}
