//! The `endless` program as a user runs it: real processes, their output, exit status and leftovers.

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::{Process, pseudo_terminal, text, wait_until};
use crate::support::recorded::traces;
use crate::support::service::reset;
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::popgym;
use endless_gym::service::{EngineStatus, running_engines};
use rustix::process::Signal;
use serde_json::Value as Json;

#[test]
fn list_shows_environments_and_parameters() {
    let place = Place::new();
    let all = place.run(&["list"]);
    assert!(all.status.success());
    assert!(text(&all.stdout).contains("Endless-MortarMayhem-v0"));
    let one = place.run(&["list", "MortarMayhem-v0"]);
    for part in ["command_show_duration", "[3]", "integer, 2 to 6", "commands_completed"] {
        assert!(text(&one.stdout).contains(part), "{part}");
    }
    let json: Json = serde_json::from_slice(&place.run(&["list", "--json"]).stdout).unwrap();
    assert_eq!(json[0]["id"], "MortarMayhem-v0");
    assert_eq!(json[0]["parameters"][2]["name"], "arena_size");
    assert_eq!(json[0]["parameters"][2]["max"], 6);
    let unknown = place.run(&["list", "MortarMayhem-v1"]);
    assert_eq!(unknown.status.code(), Some(1));
    assert!(
        text(&unknown.stderr).starts_with("endless: no environment `MortarMayhem-v1`; did you mean MortarMayhem-v0?")
    );
    assert_eq!(text(&unknown.stderr).lines().count(), 1);
    let prefixed = place.run(&["list", "EndlessGym/MysteryPath-v0"]);
    assert!(prefixed.status.success(), "{}", text(&prefixed.stderr));
}

/// Runs a program in a terminal with this number of columns, and returns its standard output.
fn in_terminal(columns: u16, command: &mut Command) -> String {
    let (mut emulator, program_side) = pseudo_terminal(columns, 24);
    let mut process = Process::spawn(command.stdout(program_side));
    // The command holds the program's side, too; drop it, so that reading ends when the program does.
    command.stdout(Stdio::null());
    let mut output = Vec::new();
    // When the terminal's other side closes, reading fails with EIO.
    let _ = emulator.read_to_end(&mut output);
    assert!(process.wait().success());
    text(&output).to_owned()
}

#[test]
fn list_shows_pictures_in_terminals_with_colours() {
    let place = Place::new();
    let list = |arguments: &[&str]| {
        let mut command = place.endless(&[&["list", "MysteryPath-v0"], arguments].concat());
        command.env("COLORTERM", "truecolor").env_remove("NO_COLOR");
        command
    };
    let pixels = |output: &str| output.matches('▀').count();
    let piped = |arguments: &[&str]| text(&list(arguments).output().unwrap().stdout).to_owned();
    assert!(piped(&[]).starts_with("MysteryPath-v0: Find an invisible path"));
    assert!(!piped(&[]).contains('\x1b'));
    let always = piped(&["--picture", "always"]);
    assert!(always.starts_with("observation  "), "{always}");
    assert!(always.contains("\x1b[38;2;255;255;255;"), "no white of the path");
    assert_eq!(pixels(&always), 2 * 42 * 21);
    assert!(always.ends_with(&piped(&[])));

    let (narrow, wide) = (in_terminal(80, &mut list(&[])), in_terminal(90, &mut list(&[])));
    assert_eq!([pixels(&narrow), pixels(&wide)], [42 * 21, 2 * 42 * 21]);
    let table = |output: &str| output.lines().map(|line| line.matches('─').count()).max();
    assert_eq!([table(&narrow), table(&wide)], [Some(80), Some(90)]);
    assert_eq!(pixels(&in_terminal(90, list(&[]).env("NO_COLOR", "1"))), 0);
    assert_eq!(
        ["24bit", "256color", ""].map(|value| pixels(&in_terminal(90, list(&[]).env("COLORTERM", value)))),
        [2 * 42 * 21, 0, 0]
    );
    assert_eq!(pixels(&in_terminal(90, &mut list(&["--picture", "never"]))), 0);
    assert_eq!(pixels(&in_terminal(90, &mut list(&["--json"]))), 0);
}

#[test]
fn verify_counts_differences_and_exits_with_1_if_there_are_any() {
    let place = Place::new();
    let files = traces("MortarMayhem-Grid-v0");
    let verify = |files: &[&Path]| {
        let files: Vec<&str> = files.iter().map(|file| file.to_str().unwrap()).collect();
        place.run(&[&["verify"], &files[..]].concat())
    };
    let same = verify(&[&files[0], &files[1]]);
    assert_eq!(same.status.code(), Some(0));
    let lines: Vec<&str> = text(&same.stdout).lines().collect();
    assert_eq!(lines.len(), 3);
    assert!(lines[0].ends_with("6 episodes, 276 steps, no difference"), "{}", lines[0]);
    assert_eq!(lines[2], "verified 2 traces: 12 episodes, 552 steps, 0 differences");

    let recorded = flate2::read::GzDecoder::new(File::open(&files[0]).unwrap());
    let mut trace: Json = serde_json::from_reader(recorded).unwrap();
    let write = |name: &str, trace: &Json| {
        let path = place.root().join(name);
        let file = flate2::write::GzEncoder::new(File::create(&path).unwrap(), Default::default());
        serde_json::to_writer(file, trace).unwrap();
        path
    };
    let mut truncated = trace.clone();
    trace["episodes"][2]["steps"][4][1] = 0.5.into();
    let other = verify(&[&write("other.json.gz", &trace)]);
    assert_eq!(other.status.code(), Some(1));
    assert!(
        text(&other.stdout).contains("1 differences, the first in episode 2, step 5: reward expected 0.5, found 0.0"),
        "{}",
        text(&other.stdout)
    );
    truncated["episodes"][5]["steps"].as_array_mut().unwrap().pop();
    let truncated = verify(&[&write("truncated.json.gz", &truncated)]);
    assert_eq!(truncated.status.code(), Some(1));
    assert!(text(&truncated.stdout).contains("not replayed: the trace is truncated: episode 5 must end with `done`"));
    trace["env"] = "Chess-v0".into();
    let unknown = verify(&[&files[0], &write("unknown.json.gz", &trace)]);
    assert_eq!(unknown.status.code(), Some(1));
    assert!(text(&unknown.stdout).contains("not replayed: no environment `Chess-v0`"));
    assert!(text(&unknown.stdout).ends_with("verified 1 traces: 6 episodes, 276 steps, 0 differences\n"));
    assert_eq!(verify(&[Path::new("/nowhere.json.gz")]).status.code(), Some(1));
}

#[test]
fn the_demo_plays_through_shared_memory_and_leaves_nothing() {
    let place = Place::new();
    let demo = place.run(&["demo", "--env", "MortarMayhem-Grid-v0", "--num-envs", "8", "--seconds", "2", "--json"]);
    assert!(demo.status.success(), "{}", text(&demo.stderr));
    let json: Json = serde_json::from_slice(&demo.stdout).unwrap();
    assert!(json["episodes"].as_u64().unwrap() >= 16, "{json}");
    assert_eq!(json["mean_length"], 118.0);
    assert_eq!(json["mean_info"]["commands_completed"], 1.0);
    let random = place.run(&["demo", "--policy", "random", "--num-envs", "8", "--seconds", "0.5"]);
    assert!(text(&random.stdout).contains("steps per second"), "{}", text(&random.stderr));
    place.assert_nothing_left();
}

#[test]
fn ctrl_c_ends_the_demo_with_its_summary() {
    let place = Place::new();
    let mut demo = place.endless(&["demo", "--num-envs", "8", "--seconds", "60"]);
    let mut demo = Process::spawn(demo.stdout(Stdio::piped()));
    place.wait_for_engine();
    let engine = &running_engines(place.namespace()).unwrap()[0];
    // Before the first step, there is nothing to sum up.
    let status = || EngineStatus::of(place.namespace(), engine);
    wait_until("the demo plays", || status().is_some_and(|status| status.groups[0].step > 0));
    demo.interrupt();
    assert!(demo.output().contains("steps per second"));
    place.assert_nothing_left();
}

#[test]
fn an_engine_does_not_outlive_a_killed_demo() {
    let place = Place::new();
    let mut demo = Process::spawn(place.endless(&["demo", "--num-envs", "8"]).stdout(Stdio::null()));
    place.wait_for_engine();
    demo.kill();
    let start = Instant::now();
    // The engine ends on its own and removes its segments; the next process cleans up after the killed trainer.
    while start.elapsed() < Duration::from_secs(10) && !place.segments().is_empty() {
        std::thread::sleep(Duration::from_millis(500));
        place.run(&["demo", "--num-envs", "1", "--seconds", "0.1"]);
    }
    place.assert_nothing_left();
}

#[test]
fn serve_serves_until_a_signal_and_leaves_nothing() {
    let place = Place::new();
    for end in [Signal::INT, Signal::TERM] {
        let arguments = ["serve", "--num-envs", "4", "--groups", "2", "--service", "one", "--option", "arena_size=6"];
        let mut engine = Process::spawn(place.endless(&arguments).stdout(Stdio::piped()));
        let mut trainer = place.trainer("one").unwrap();
        assert_eq!(trainer.specification().groups, 2);
        assert_eq!(trainer.specification().options[0]["arena_size"], 6);
        reset(&mut trainer, 1);
        drop(trainer);
        engine.signal(end);
        assert!(engine.wait().success());
        assert!(engine.output().starts_with("serving MortarMayhem-v0 as `one`"));
        place.assert_nothing_left();
    }
}

#[test]
fn serve_writes_the_markov_state_if_asked() {
    let id = "popgym-RepeatPreviousEasy-v0";
    let mut twin = Player::in_registry(popgym(), &PoolConfig::new(id, 3).state(true), 1);
    twin.reset(ResetRequest::Seed(3));
    for (arguments, expected) in [(&["--state"][..], twin.batch().state()), (&[], &[])] {
        let place = Place::new();
        let _engine = place.serve(&[&["--env", id, "--num-envs", "3"], arguments].concat());
        let mut trainer = place.trainer("endless").unwrap();
        assert_eq!(reset(&mut trainer, 0).batch().state(), expected);
        assert_eq!(arguments.is_empty(), expected.is_empty());
    }
}

#[test]
fn serve_reads_its_configuration_as_json_from_a_file_or_standard_input() {
    let place = Place::new();
    let config =
        r#"{"service": "one", "pool": {"id": "MysteryPath-Grid-v0", "num_envs": 3}, "groups": 2, "threads": 1}"#;
    let file = place.root().join("config.json");
    std::fs::write(&file, config).unwrap();
    let path = file.to_str().unwrap();
    for arguments in [vec!["serve", "--child", "--config", path], vec!["serve", "--child", "--config=-"]] {
        let mut engine = Process::spawn(place.endless(&arguments).stdin(Stdio::piped()));
        if arguments.contains(&"--config=-") {
            engine.0.stdin.as_mut().unwrap().write_all(config.as_bytes()).unwrap();
        }
        let trainer = place.trainer("one").unwrap();
        let served = trainer.specification();
        assert_eq!((&*served.id, served.num_envs, served.groups), ("MysteryPath-Grid-v0", 3, 2));
        drop(trainer);
        engine.end();
    }
    std::fs::write(&file, config.replace("threads", "thread")).unwrap();
    let error = text(&place.run(&["serve", "--config", path]).stderr).to_owned();
    assert!(error.starts_with(&format!("endless: --config {path}: unknown field `thread`")), "{error}");
    for option in ["--num-envs=3", "--seed=1", "--no-frames"] {
        assert_eq!(place.run(&["serve", "--config", path, option]).status.code(), Some(2), "{option}");
    }
}

#[test]
fn errors_of_arguments_are_one_clear_line() {
    let place = Place::new();
    for (arguments, part) in [
        (vec!["serve", "--env", "Chess-v0"], "no environment `Chess-v0`"),
        (vec!["serve", "--option", "arena_sise=3"], "no reset parameter `arena_sise`"),
        (vec!["serve", "--option", "max_steps"], "expected NAME=VALUE"),
        (vec!["serve", "--option", "agent_speed=fast"], "`agent_speed` must be a number, 0 to 84, got \"fast\""),
        (vec!["serve", "--env-options", "3"], "expected a JSON object"),
        (vec!["serve", "--num-envs", "2", "--env-options", "{}"], "1 "),
        (vec!["serve", "--num-envs", "0"], "num_envs must be 1 to 1048576, got 0"),
        (vec!["serve", "--groups", "0"], "groups must be 1 to 64, got 0"),
        (vec!["serve", "--num-envs", "9223372036854775808", "--groups", "4"], "9223372036854775808"),
        (vec!["serve", "--batches-held", "20"], "batches_held must be 1 to 16, got 20"),
        (vec!["serve", "--service", "a/b"], "engine name must be 1 to 64 letters, digits, `.`, `_` or `-`, got `a/b`"),
        (vec!["watch", "gym"], "`endless status NAME --watch` follows an engine"),
        (vec!["demo", "--env", "Chess-v0"], "no environment `Chess-v0`"),
        (vec!["demo", "--num-envs", "0"], "num_envs must be 1 to 1048576, got 0"),
        (vec!["demo", "--option", "arena_size=7"], "`arena_size` must be an integer, 2 to 6, got 7"),
        (vec!["demo", "--seconds=-1"], "--seconds must be finite and positive, got -1"),
        (vec!["demo", "--seconds", "nan"], "--seconds must be finite and positive, got NaN"),
        (vec!["bench", "--seconds", "inf"], "--seconds must be finite and positive, got inf"),
        (vec!["bench", "--seconds", "0"], "--seconds must be finite and positive, got 0"),
        (vec!["bench", "--env", "Chess-v0"], "no environment `Chess-v0`"),
        (
            vec!["bench", "--original", "/no/python,/other", "--seconds", "0.01", "--rounds", "1"],
            "; cannot run /other: ",
        ),
        (vec!["bench", "--original", "/no/python", "--seconds", "0.01", "--rounds", "1"], "cannot run /no/python: "),
        (vec!["play", "Pong-v0"], "no environment `Pong-v0`"),
        (vec!["play", "MysteryPath-v0", "--option", "speed"], "--option speed: expected NAME=VALUE"),
        (vec!["play", "MysteryPath-v0", "--option", "speed=1"], "no reset parameter `speed`"),
        // POPGym is not on the page.
        (
            vec!["play", "popgym-RepeatFirstEasy-v0"],
            "or write the page of your own crate with `endless page --out FOLDER`",
        ),
        (vec!["play", "--terminal"], "--terminal needs a terminal, and standard input is none"),
        (vec!["view", "--terminal"], "--terminal needs a terminal, and standard input is none"),
        (vec!["play", "Chess-v0", "--terminal"], "no environment `Chess-v0`"),
        (vec!["play", "--terminal", "--option", "arena_size=9"], "arena_size"),
        (vec!["play", "--terminal", "--hold=-1"], "--hold must be finite and 0 or more, got -1"),
        (vec!["record", "MysteryPath-v0", "--film", "a.GIF"], "a film's name must end in .webp or .mp4, got `a.GIF`"),
        (
            vec!["record", "MysteryPath-v1", "--film", "a.webp"],
            "no environment `MysteryPath-v1`; did you mean MysteryPath-v0?",
        ),
        (vec!["record", "MysteryPath-v0", "--film", "no/a.webp"], "cannot write no/a.webp: "),
        (vec!["record", "MysteryPath-v0", "--film", "a.webp", "--option", "x"], "--option x: expected NAME=VALUE"),
        (vec!["record", "MortarMayhem-v0", "--film=a.webp", "--option", "arena_size=9"], "arena_size"),
        (vec!["record", "MysteryPath-v0", "--error-rate", "0", "0.1"], "Python package's program"),
    ] {
        let output = place.endless(&arguments).current_dir(place.root()).output().unwrap();
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {stderr}");
        assert!(stderr.starts_with("endless: ") && stderr.contains(part), "{arguments:?}: {stderr}");
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
    }
    for (arguments, part) in [
        (vec!["record", "MysteryPath-v0", "--film", "a.webp", "--fps", "0"], "0 is not in 1..=100"),
        (vec!["record", "--film", "a.webp"], "<ID>"),
        (vec!["serve", "--every=5m"], "--checkpoint <FILE>"),
        (vec!["serve", "--resume"], "--checkpoint <FILE>"),
        (vec!["serve", "--checkpoint=state", "--every=soon"], "invalid value 'soon'"),
    ] {
        let output = place.endless(&arguments).current_dir(place.root()).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(text(&output.stderr).contains(part), "{arguments:?}: {}", text(&output.stderr));
    }
    assert!(text(&place.run(&["record", "--help"]).stdout).contains("[default: 4]"));
    place.assert_nothing_left();
}

/// Only release builds contain the page, once it is built; `xtask/packages/check.py` plays on that of the wheel.
#[test]
#[cfg(debug_assertions)]
fn a_program_without_the_page_says_how_to_play() {
    let output =
        Place::new().run(&["play", "SearingSpotlights-v0", "--seed", "9", "--option", "num_coins=[3]", "--open"]);
    assert_eq!(output.status.code(), Some(1));
    let stderr = text(&output.stderr);
    assert!(stderr.contains("`--terminal`") && stderr.contains("run `cargo xtask play`"), "{stderr}");
}

#[test]
fn new_writes_a_crate_with_the_given_names_and_changes_nothing_that_exists() {
    let place = Place::new();
    let folder = place.root().join("count_down");
    let new =
        |arguments: &[&str]| place.endless(&[&["new"], arguments].concat()).current_dir(place.root()).output().unwrap();
    let written = new(&["count_down", "--path", env!("CARGO_MANIFEST_DIR")]);
    assert!(written.status.success(), "{}", text(&written.stderr));
    assert!(text(&written.stdout).contains("play CountDown-v0"));
    for (file, part) in [
        ("Cargo.toml", concat!("[patch.crates-io]\nendless-gym = { path = \"", env!("CARGO_MANIFEST_DIR"), "\" }")),
        ("Cargo.toml", concat!("endless-gym = \"=", env!("CARGO_PKG_VERSION"), "\"")),
        ("pyproject.toml", concat!("endless-gym==", env!("CARGO_PKG_VERSION"))),
        ("python/count_down/__init__.py", "from count_down import _native"),
        ("src/task.rs", "EnvSpec::new(\"CountDown-v0\""),
        ("src/main.rs", "count_down::registry()"),
        ("example.py", "count_down:CountDown-v0"),
        ("src/lib.rs", "endless_gym_web::module!(registry())"),
        ("README.md", "endless-train --env count_down:CountDown-v0"),
    ] {
        let text = std::fs::read_to_string(folder.join(file)).unwrap();
        assert!(text.contains(part), "{file}: {text}");
        assert!(!["t_maze", "TMaze", "VERSION"].iter().any(|left| text.contains(left)), "{file}: {text}");
    }
    let manifest = std::fs::read(folder.join("Cargo.toml")).unwrap();
    for (arguments, part) in [
        (&["count_down"] as &[_], "`count_down` exists already"),
        (&["mystery_path"], "MysteryPath-v0"),
        (&["../maze"], "got `../maze`"),
        (&["maze", "--path", "/"], "--path must be a checkout of Endless Gym, got `/`"),
    ] {
        let refused = new(arguments);
        assert_eq!(refused.status.code(), Some(1), "{arguments:?}");
        assert!(text(&refused.stderr).contains(part), "{}", text(&refused.stderr));
    }
    assert_eq!(std::fs::read(folder.join("Cargo.toml")).unwrap(), manifest);
    assert!(!place.root().join("maze").exists() && !place.root().join("mystery_path").exists());
}

/// `cargo xtask test --only browser` writes and plays a page. Here, scripts stand for cargo.
#[test]
fn page_says_what_a_crate_or_cargo_lacks() {
    let place = Place::new();
    let library = place.root().join("own.wasm");
    let message = format!(r#"{{"reason":"compiler-artifact","filenames":["{}"]}}"#, library.display());
    let page = |script: &str| {
        let cargo = place.script("cargo", script);
        place
            .endless(&["page", "--manifest-path", "Cargo.toml"])
            .env("CARGO", cargo)
            .current_dir(place.root())
            .output()
            .unwrap()
    };
    let builds = format!("echo '{message}'");
    for (script, engine, part) in [
        ("exit 101", &b""[..], "run `rustup target add wasm32-unknown-unknown`"),
        ("true", b"", "must have the type `cdylib`"),
        (&builds, b"\0asm", "must call `endless_gym_web::module!(registry())`"),
    ] {
        std::fs::write(&library, engine).unwrap();
        let refused = page(script);
        assert_eq!(refused.status.code(), Some(1));
        assert!(text(&refused.stderr).contains(part), "{}", text(&refused.stderr));
        assert!(!place.root().join("site").exists());
    }
    // Cargo, which started this test, names its crate.
    let elsewhere =
        place.endless(&["page"]).env_remove("CARGO_MANIFEST_DIR").current_dir(place.root()).output().unwrap();
    assert_eq!(elsewhere.status.code(), Some(1));
    assert!(text(&elsewhere.stderr).contains("there is none in "), "{}", text(&elsewhere.stderr));
}

#[test]
fn bench_measures_every_method() {
    let place = Place::new();
    let output = place.run(&["bench", "--num-envs", "16", "--seconds", "0.05", "--rounds", "1", "--json"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let json: Json = serde_json::from_slice(&output.stdout).unwrap();
    let measurements = json[0]["measurements"].as_array().unwrap();
    let methods: Vec<&str> = measurements.iter().map(|m| m["method"].as_str().unwrap()).collect();
    for method in ["in process, 1 thread", "service, only receives", "service, reads every byte"] {
        assert!(methods.contains(&method), "{methods:?}");
    }
    assert!(measurements.iter().all(|m| m["steps_per_second"].as_f64().unwrap() > 0.0));
    assert!(measurements.iter().all(|m| m["batch_bytes"].as_u64().unwrap() > 16 * 84 * 84 * 3));
    // In process, a batch of 16 environments is too small for huge pages.
    assert!(measurements.iter().all(|m| m["huge_page_bytes"].as_u64().unwrap() <= m["batch_bytes"].as_u64().unwrap()));
}

#[test]
fn bench_says_where_the_time_of_a_step_goes() {
    let place = Place::new();
    let run = |arguments: &[&str]| {
        let bench = ["bench", "--num-envs", "256", "--seconds", "0.05", "--rounds", "1", "--threads", "2,3"];
        let output = place.run(&[&bench, arguments].concat());
        assert!(output.status.success(), "{}", text(&output.stderr));
        text(&output.stdout).to_owned()
    };
    let json: Json = serde_json::from_str(&run(&["--json"])).unwrap();
    let rows = json[0]["threads"].as_array().unwrap();
    assert_eq!(rows.iter().map(|row| row["threads"].as_u64().unwrap()).collect::<Vec<_>>(), [1, 2, 3]);
    let number = |value: &Json| value.as_f64().unwrap();
    assert!((number(&rows[0]["efficiency"]) - 1.0).abs() < 1e-9);
    for row in rows {
        let ratio = number(&row["service_steps_per_second"]) / number(&row["steps_per_second"]);
        assert!((number(&row["service_ratio"]) - ratio).abs() < 1e-9);
        let step = number(&row["step"]);
        assert!((step * number(&row["steps_per_second"]) - 256e6).abs() < 1.0);
        let parts = &row["parts"];
        assert_eq!(parts.is_null(), row["threads"] == 1);
        if !parts.is_null() {
            let [opening, joining, last_join, work, waiting] =
                ["opening", "joining", "last_join", "work", "waiting"].map(|part| number(&parts[part]));
            assert!((opening + joining + work + waiting - step).abs() < 1e-3 * step);
            assert!(opening > 0.0 && joining >= 0.0 && last_join >= joining && work > 0.0 && waiting >= 0.0, "{parts}");
        }
    }
    let table = run(&[]);
    assert!(table.contains("efficiency") && table.contains("last join") && table.contains("trainer"), "{table}");
}

#[test]
fn output_that_cannot_be_written_is_a_failure() {
    let place = Place::new();
    let trace = &traces("MortarMayhem-Grid-v0")[0];
    let trace = trace.to_str().unwrap();
    let full = || File::options().write(true).open("/dev/full").unwrap();
    for arguments in [
        vec!["--help"],
        vec!["--version"],
        vec!["serve", "--help"],
        vec!["list"],
        vec!["list", "--json"],
        vec!["list", "MortarMayhem-v0"],
        vec!["list", "MortarMayhem-v0", "--json"],
        vec!["serve", "--num-envs", "1"],
        vec!["demo", "--num-envs", "1", "--seconds", "0.1"],
        vec!["demo", "--num-envs", "1", "--seconds", "0.1", "--json"],
        vec!["bench", "--num-envs", "1", "--seconds", "0.01", "--rounds", "1"],
        vec!["bench", "--num-envs", "1", "--seconds", "0.01", "--rounds", "1", "--json"],
        vec!["verify", trace],
        vec!["verify", "--json", trace],
    ] {
        let output = place.endless(&arguments).stdout(full()).output().unwrap();
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {stderr}");
        assert!(
            stderr.starts_with("endless: cannot write to standard output: No space left"),
            "{arguments:?}: {stderr}"
        );
        assert_eq!(stderr.lines().count(), 1, "{arguments:?}: {stderr}");
    }
    for (arguments, code) in [(["list", "Chess-v0"], 1), (["list", "--chess"], 2)] {
        assert_eq!(place.endless(&arguments).stderr(full()).output().unwrap().status.code(), Some(code));
    }
    place.assert_nothing_left();
}

#[test]
fn a_closed_pipe_is_not_a_failure() {
    let place = Place::new();
    let trace = &traces("MortarMayhem-Grid-v0")[0];
    let trace = trace.to_str().unwrap();
    let closed = || std::io::pipe().unwrap().1;
    for (arguments, code) in [
        (vec!["--help"], 0),
        (vec!["list"], 0),
        (vec!["list", "--json"], 0),
        (vec!["demo", "--num-envs", "1", "--seconds", "0.1"], 0),
        (vec!["bench", "--num-envs", "1", "--seconds", "0.01", "--rounds", "1"], 0),
        (vec!["verify", trace], 0),
        (vec!["verify", trace, "/nowhere.json.gz"], 1),
    ] {
        let output = place.endless(&arguments).stdout(closed()).output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}");
        assert_eq!(text(&output.stderr), "", "{arguments:?}");
    }
    let mut engine = Process::spawn(place.endless(&["serve", "--num-envs", "1"]).stdout(closed()));
    place.wait_for_engine();
    engine.interrupt();
    place.assert_nothing_left();
}

#[test]
fn bench_measures_an_original_with_the_python_that_has_it() {
    let place = Place::new();
    let lacks = place.script("lacks", "echo \"ModuleNotFoundError: No module named 'popgym'\" >&2; exit 1");
    let has = place.script("has", "echo pygame 2.4.0; echo 1250.5");
    let bench = "bench --env popgym-RepeatFirstEasy-v0 --num-envs 1_0 --seconds 0.01 --rounds 1 --json --original";
    let measure = |pythons: &[&PathBuf]| {
        let pythons = pythons.iter().map(|python| python.display().to_string()).collect::<Vec<_>>().join(",");
        place.run(&bench.split(' ').chain([&*pythons]).collect::<Vec<_>>())
    };
    let rows: Json = serde_json::from_str(text(&measure(&[&lacks, &has]).stdout)).unwrap();
    assert_eq!(rows[0]["num_envs"], 10);
    let last = rows[0]["measurements"].as_array().unwrap().last().unwrap();
    assert_eq!((&last["method"], &last["steps_per_second"]), (&"original".into(), &1250.5.into()));
    let failed = measure(&[&lacks]);
    assert!(
        text(&failed.stderr)
            .contains("lacks cannot measure the original: ModuleNotFoundError: No module named 'popgym'")
    );
}
