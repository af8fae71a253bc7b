//! Full disks and used-up quotas, which a preloaded library simulates from any call on.

use std::fs;
use std::process::{Command, Stdio};

use crate::support::place::Place;
use crate::support::process::{Process, wait_until};
use crate::support::service::{ID, play};
use endless_gym::service::running_engines;
use rustix::io::Errno;

#[test]
fn a_film_or_a_checkpoint_without_space_is_one_error_and_keeps_the_former_file() {
    let place = Place::new();
    let (library, folder) = (place.root().join("kill_at.so"), place.root().join("files"));
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/kill_at.c");
    let status = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).args([source, "-ldl"]).status();
    assert!(status.unwrap().success());
    fs::create_dir(&folder).unwrap();
    let state = folder.join("state");
    let serve = ["--env", ID, "--num-envs", "2", "--service", "gym", "--checkpoint", state.to_str().unwrap()];
    let mut engine = place.serve(&serve);
    play(&mut place.trainer("gym").unwrap(), 0, 1);
    engine.interrupt();
    let saved = fs::read(&state).unwrap();
    fs::remove_file(&state).unwrap();
    let serve = [&["serve", "--resume"], &serve[..]].concat();
    for error in [Errno::NOSPC, Errno::DQUOT].map(Errno::raw_os_error) {
        for name in ["film.webp", "state"] {
            let file = folder.join(name);
            let path = file.to_str().unwrap();
            let record = ["record", "MortarMayhem-Grid-v0", "--max-steps", "3", "--film", path];
            let arguments = if name == "state" { &serve[..] } else { &record };
            for call in 1.. {
                fs::write(&file, &saved).unwrap();
                let mut command = place.endless(arguments);
                command.env("LD_PRELOAD", &library).env("KILL_FOLDER", &folder).env("KILL_AT", call.to_string());
                command.env("KILL_ERROR", error.to_string()).stdout(Stdio::null()).stderr(Stdio::piped());
                let mut process = Process::spawn(&mut command);
                let mut has_ended = false;
                wait_until("the process ends or serves", || {
                    has_ended = process.0.try_wait().unwrap().is_some();
                    has_ended || !running_engines(place.namespace()).unwrap().is_empty()
                });
                if !has_ended {
                    play(&mut place.trainer("gym").unwrap(), 0, 1);
                    process.signal(rustix::process::Signal::INT);
                }
                let (status, text) = (process.wait(), process.errors());
                assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "{name} after call {call}");
                if status.success() {
                    assert!(call > 3, "{name}: only {call} calls");
                    break;
                }
                assert_eq!(status.code(), Some(1), "{text}");
                assert!(text.contains(path) && text.lines().count() == 1, "{text}");
                assert!(text.ends_with(&format!("(os error {error})\n")), "{text}");
                assert!(fs::read(&file).unwrap() == saved, "{name} after call {call}");
            }
            fs::remove_file(&file).unwrap();
        }
    }
}
