//! Whole runs, in this process and with an engine.

use std::collections::HashSet;
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::Command as Process;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use clap::{Args, Command, FromArgMatches};
use endless_gym_core::random::Generator;
use endless_gym_kernels::file as agent_file;
use endless_gym_kernels::network::{Network, Pass};
use endless_gym_kernels::sequences::Sequences;
use endless_gym_memory_gym::memory_gym;
use endless_gym_service::{ConnectConfig, Engine, EngineConfig, Namespace, Trainer};
use endless_gym_trainer::environments::{Environments, pool_config};
use endless_gym_trainer::error::Error;
use endless_gym_trainer::learn;
use endless_gym_trainer::network;
use endless_gym_trainer::settings::{Settings, with_defaults, with_negations};
use rustix::io::Errno;
use safetensors::SafeTensors;
use safetensors::tensor::TensorView;
use serde_json::Value as Json;

/// A short run with small networks, on two layers and sequences shorter than a segment.
const SMALL: &str = "MortarMayhem-Grid-v0 --environment.option command_count=[1] --environment.num-envs 8 --ppo.steps 24 \
                     --recurrence.sequence-length 8 --recurrence.hidden-size 16 --recurrence.layers 2 --model.head-width 8 \
                     --ppo.minibatches 2 --no-stop-when-learnt --ppo.updates 4";

fn parse(text: &str) -> Result<Settings, String> {
    let arguments: Vec<_> = std::iter::once("learn").chain(text.split_whitespace()).map(Into::into).collect();
    let arguments = with_negations(&arguments);
    let command = with_defaults(Settings::augment_args(Command::new("learn")), &arguments);
    let matches = command.map_err(|error| error.to_string())?.try_get_matches_from(arguments);
    Settings::from_arg_matches(&matches.map_err(|error| error.to_string())?).map_err(|error| error.to_string())
}

fn settings(text: &str) -> Settings {
    parse(text).unwrap()
}

/// A folder that is removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("endless-learn-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        fs::create_dir(&path).unwrap();
        Folder(path)
    }

    fn run(&self, name: &str, arguments: &str) -> PathBuf {
        try_run(&format!("{SMALL} --run {}/{name} {arguments}", self.0.display())).unwrap()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn try_run(arguments: &str) -> Result<PathBuf, Error> {
    let environments = |settings: &Settings| Environments::in_process(memory_gym(), settings);
    learn(&settings(arguments), environments, &AtomicBool::new(false))
}

/// The tensors of a run's last checkpoint by name, as bytes.
fn tensors(run: &Path) -> Vec<(String, Vec<u8>)> {
    let content = fs::read(run.join("checkpoints/last.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&content).unwrap();
    let mut found: Vec<_> =
        tensors.tensors().into_iter().map(|(name, tensor)| (name, tensor.data().to_vec())).collect();
    found.sort();
    assert!(found.len() > 15);
    found
}

/// The rows of a run's `progress.jsonl`, without what depends on the time.
fn progress(run: &Path) -> Vec<Json> {
    let text = fs::read_to_string(run.join("progress.jsonl")).unwrap();
    let rows = text.lines().map(|line| {
        let mut row: serde_json::Map<String, Json> = serde_json::from_str(line).unwrap();
        row.retain(|name, _| name != "steps_per_second" && !name.starts_with("seconds/"));
        Json::Object(row)
    });
    rows.collect()
}

fn assert_same(run: &Path, other: &Path) {
    assert!(tensors(run) == tensors(other), "{} and {} differ", run.display(), other.display());
    assert_eq!(progress(run), progress(other));
}

#[test]
fn a_resumed_run_continues_with_the_same_bits() {
    let folder = Folder::new("resume");
    for agent in ["gru", "mingru", "none"] {
        let whole = folder.run(&format!("{agent}-whole"), &format!("--agent {agent}"));
        let run = folder.run(&format!("{agent}-parts"), &format!("--agent {agent} --ppo.updates 2"));
        assert!(tensors(&whole) != tensors(&run));
        // As if the process had been killed while it wrote a row.
        let rows = fs::read_to_string(run.join("progress.jsonl")).unwrap();
        fs::write(run.join("progress.jsonl"), format!("{rows}{{\"update\": 3}}\n{{\"upda")).unwrap();
        let resumed = try_run(&format!("--resume {} --ppo.updates 4", run.display())).unwrap();
        assert_same(&whole, &resumed);
        assert_eq!(progress(&resumed).len(), 4);
    }
}

#[test]
fn a_missing_row_is_an_error() {
    let folder = Folder::new("rows");
    let run = folder.run("run", "--ppo.updates 3");
    let file = run.join("progress.jsonl");
    let rows = fs::read_to_string(&file).unwrap();
    let rows: Vec<_> = rows.split_inclusive('\n').collect();
    for (text, update) in [
        (String::new(), 1),
        (rows[1..].concat(), 1),
        ([rows[0], rows[2]].concat(), 2),
        ([rows[0], &rows[1][1..], rows[2]].concat(), 2),
        (rows.concat().trim_end().to_owned(), 3),
    ] {
        fs::write(&file, &text).unwrap();
        let error = try_run(&format!("--resume {} --ppo.updates 4", run.display())).unwrap_err();
        assert!(matches!(error, Error::Progress { missing, .. } if missing == update), "{error}");
        assert_eq!(fs::read_to_string(&file).unwrap(), text);
    }
    // Without its checkpoint, a run that has begun does not start again.
    fs::remove_file(run.join("checkpoints/last.safetensors")).unwrap();
    let error = try_run(&format!("--resume {} --ppo.updates 4", run.display())).unwrap_err();
    assert!(matches!(error, Error::Checkpoint { .. }), "{error}");
}

#[test]
fn a_run_without_a_checkpoint_starts_again_from_its_settings() {
    let folder = Folder::new("begun");
    let weights = folder.run("weights", "--ppo.updates 1");
    let from = format!("--init-from {}", weights.display());
    let (expected, run) = (folder.run("expected", &from), folder.run("run", &from));
    fs::remove_dir_all(run.join("checkpoints")).unwrap();
    fs::write(run.join("progress.jsonl"), "").unwrap();
    let error = try_run(&format!("{SMALL} --run {}", run.display())).unwrap_err().to_string();
    assert!(error.contains(&format!("continue it with --resume {}", run.display())), "{error}");
    assert_same(&expected, &try_run(&format!("--resume {}", run.display())).unwrap());
}

/// A library to preload, which kills a process at one of its calls that change files.
fn kill_at(folder: &Folder) -> PathBuf {
    let library = folder.0.join("kill_at.so");
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/kill_at.c");
    let status = Process::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).args([source, "-ldl"]).status();
    assert!(status.unwrap().success());
    library
}

#[test]
fn a_run_killed_or_out_of_space_at_any_call_continues_with_one_command() {
    if let Ok(arguments) = std::env::var("LEARN") {
        if let Err(error) = try_run(&arguments) {
            eprintln!("{error}");
            std::process::exit(1);
        }
        return;
    }
    let folder = Folder::new("killed");
    let (library, run) = (kill_at(&folder), folder.0.join("run"));
    let start = format!("{SMALL} --keep-checkpoints --checkpoint-interval 2 --run {}", run.display());
    let resume = format!("--resume {} --ppo.updates 4", run.display());
    let whole = folder.run("whole", "--keep-checkpoints --checkpoint-interval 2");
    let half = folder.run("half", "--keep-checkpoints --checkpoint-interval 2 --ppo.updates 2");
    // As if the process had been killed after the next update.
    let rows = fs::read_to_string(half.join("progress.jsonl")).unwrap();
    fs::write(half.join("progress.jsonl"), format!("{rows}{{\"update\": 3}}\n{{\"upda")).unwrap();
    let checkpoints = |run: &Path| {
        let files = fs::read_dir(run.join("checkpoints")).unwrap();
        files.map(|file| file.unwrap().file_name()).collect::<HashSet<_>>()
    };
    let train = |arguments: &str, kill: usize, error: i32| {
        let mut process = Process::new(std::env::current_exe().unwrap());
        process.args(["--exact", "a_run_killed_or_out_of_space_at_any_call_continues_with_one_command", "--nocapture"]);
        process.env("LEARN", arguments).env("LD_PRELOAD", &library).env("KILL_FOLDER", &run);
        process.env("KILL_AT", kill.to_string()).env("KILL_ERROR", error.to_string()).output().unwrap()
    };
    let [full, quota] = [Errno::NOSPC, Errno::DQUOT].map(Errno::raw_os_error);
    for (is_resumed, error) in
        [false, true].into_iter().flat_map(|is_resumed| [0, full, quota].map(|e| (is_resumed, e)))
    {
        for kill in 1.. {
            let _ = fs::remove_dir_all(&run);
            if is_resumed {
                assert!(Process::new("cp").arg("-r").args([&half, &run]).status().unwrap().success());
            }
            let killed = train(if is_resumed { &resume } else { &start }, kill, error);
            let is_done = killed.status.success();
            if error == 0 {
                assert!(is_done || killed.status.signal() == Some(9), "{killed:?}");
            } else if !is_done {
                let text = String::from_utf8(killed.stderr).unwrap();
                assert!(text.starts_with(run.to_str().unwrap()) && text.lines().count() == 1, "{text}");
                assert!(text.ends_with(&format!("(os error {error})\n")), "{text}");
                let left = [run.clone(), run.join("checkpoints")].into_iter().flat_map(fs::read_dir).flatten();
                let left: Vec<_> = left.map(|file| file.unwrap().path()).collect();
                let is_left = |path: &&PathBuf| path.ends_with("lock") || path.extension().is_some_and(|e| e == "new");
                assert_eq!(left.iter().find(is_left), None, "after call {kill}");
            }
            let again = if run.join("settings.json").exists() { &resume } else { &start };
            let ended = train(again, 0, 0);
            assert!(ended.status.success(), "after call {kill}: {ended:?}");
            assert_same(&whole, &run);
            assert_eq!(checkpoints(&whole), checkpoints(&run), "after call {kill}");
            if is_done {
                assert!(kill > 15, "only {kill} calls");
                break;
            }
        }
    }
}

#[test]
fn results_depend_neither_on_threads_nor_on_groups() {
    let folder = Folder::new("threads");
    let expected = folder.run("one", "--threads 1 --environment.num-envs 32 --ppo.minibatches 1");
    let found = folder.run("three", "--threads 3 --environment.num-envs 32 --ppo.minibatches 1");
    assert_same(&expected, &found);
    let groups = "--threads 1 --environment.num-envs 32 --ppo.minibatches 1 --environment.groups 2";
    assert_same(&expected, &folder.run("groups", groups));
}

#[test]
fn a_run_with_an_engine_is_the_same_as_in_process() {
    let folder = Folder::new("engine");
    let expected = folder.run("expected", "");
    let namespace = Namespace::at(folder.0.join("root"));
    let arguments = format!("{SMALL} --run {}/served --environment.groups 2", folder.0.display());
    let settings = settings(&arguments);
    let pool = pool_config(memory_gym(), &settings).unwrap();
    let config = EngineConfig::new("learn", pool, 1).groups(2).namespace(namespace.clone());
    let wrong = config.clone().service("wrong".to_owned()).pool(config.pool.clone().features(false));
    let _engine = Engine::new(memory_gym(), &config).unwrap().spawn().unwrap();
    let _wrong = Engine::new(memory_gym(), &wrong).unwrap();
    let connect = ConnectConfig::new("learn").namespace(namespace).timeout(Duration::from_secs(10));
    let other = Trainer::connect(&connect.clone().service("wrong".to_owned())).unwrap();
    let error = Environments::served(&settings, other).err().unwrap().to_string();
    assert!(error.contains("same_step and 0 features"), "{error}");
    let trainer = Trainer::connect(&connect).unwrap();
    let environments = |settings: &Settings| Environments::served(settings, trainer);
    let run = learn(&settings, environments, &AtomicBool::new(false)).unwrap();
    assert_same(&expected, &run);
}

#[test]
fn a_run_that_diverges_keeps_its_last_healthy_checkpoint() {
    let folder = Folder::new("diverged");
    let run = folder.run("run", "--ppo.updates 1");
    let healthy = tensors(&run);
    let resume = format!("--resume {} --ppo.updates 9 --ppo.learning-rate 1e30", run.display());
    let error = try_run(&resume).unwrap_err();
    assert!(matches!(error, Error::Diverged { saved: 1, .. }), "{error}");
    assert!(error.to_string().contains("try a smaller --ppo.learning-rate"), "{error}");
    assert!(tensors(&run) == healthy);
}

#[test]
fn a_stopped_run_writes_a_checkpoint() {
    let folder = Folder::new("stopped");
    let settings = settings(&format!("{SMALL} --run {}/run", folder.0.display()));
    let environments = |settings: &Settings| Environments::in_process(memory_gym(), settings);
    let run = learn(&settings, environments, &AtomicBool::new(true)).unwrap();
    assert_eq!(progress(&run).len(), 1);
    let one = folder.run("one", "--ppo.updates 1");
    assert!(tensors(&run) == tensors(&one));
    assert!(!run.join("lock").exists());
}

#[test]
fn errors_say_what_is_allowed_and_leave_nothing() {
    let folder = Folder::new("errors");
    let at = folder.0.display();
    let new = format!("{SMALL} --run {at}/new");
    for (arguments, expected) in [
        (format!("{new} --environment.groups 3"), "must be a multiple of --environment.groups, got 8 environments"),
        (format!("{new} --ppo.minibatches 193"), "--ppo.minibatches must be 1 to 192"),
        (format!("{new} --recurrence.sequence-length 10"), "multiple of --recurrence.sequence-length, got 24 steps"),
        (format!("{new} --environment.option x"), "must be NAME=VALUE with a JSON value"),
        (format!("{new} --environment.option colour=1"), "colour"),
        (format!("{new} --init-from {at}/nowhere"), "nowhere does not exist"),
        (format!("{new} --init-from /dev/null"), "it is not a regular file"),
        (format!("Nothing-v0 --run {at}/new"), "no environment `Nothing-v0`"),
    ] {
        let error = try_run(&arguments).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
        assert!(!folder.0.join("new").exists(), "{error}");
    }
    for (arguments, expected) in [
        ("--threads 5000", "5000 is not in 0..=1024"),
        ("--ppo.gamma 1.5", "must be a number from 0 to 1"),
        ("--ppo.learning-rate nan", "must be a finite number, 0 or more"),
        ("--recurrence.hidden-size 100000000", "100000000 is not in 1..=16384"),
        ("--agent lstm", "[possible values: gru, mingru, none]"),
        ("--resume /nowhere", "no run in /nowhere; expected a folder with settings.json"),
    ] {
        let error = parse(arguments).unwrap_err();
        assert!(error.contains(expected), "{error}");
    }
    let run = folder.run("run", "--ppo.updates 1");
    let error = try_run(&format!("{SMALL} --run {}", run.display())).unwrap_err();
    assert!(matches!(error, Error::RunExists { .. }), "{error}");
    let error = try_run(&format!("--resume {} --recurrence.layers 3", run.display())).unwrap_err().to_string();
    assert!(error.contains("must keep its recurrence.layers: expected 2, got 3"), "{error}");
}

#[test]
fn a_minibatch_of_one_step_learns() {
    let folder = Folder::new("one-step");
    for scope in ["minibatch", "batch", "none"] {
        // A segment of one step is one minibatch.
        let sizes = "--environment.num-envs 1 --ppo.steps 1 --ppo.minibatches 1 --recurrence.sequence-length 1";
        let run = folder.run(scope, &format!("{sizes} --ppo.advantage-normalisation {scope}"));
        let rows = progress(&run);
        assert_eq!(rows.len(), 4);
        assert!(rows.iter().all(|row| row["gradient_norm"].as_f64() > Some(0.0)), "{rows:?}");
    }
}

/// Changes the header and the bytes of the tensors of a checkpoint, with the checksum of the new content.
fn forge(file: &Path, header: impl Fn(&mut Json), bytes: impl Fn(&str, &mut Vec<u8>)) {
    let content = fs::read(file).unwrap();
    let mut text: Json = serde_json::from_str(&agent_file::read(&content).unwrap().header.unwrap()).unwrap();
    header(&mut text);
    let mut tensors: Vec<_> = SafeTensors::deserialize(&content).unwrap().tensors();
    tensors.sort_by(|a, b| a.0.cmp(&b.0));
    let changed: Vec<_> = tensors
        .iter()
        .map(|(name, tensor)| {
            let mut data = tensor.data().to_vec();
            bytes(name, &mut data);
            (name.clone(), tensor.dtype(), tensor.shape().to_vec(), data)
        })
        .collect();
    let views = changed
        .iter()
        .map(|(name, dtype, shape, data)| (name.clone(), TensorView::new(*dtype, shape.clone(), data).unwrap()));
    fs::write(file, agent_file::write(text.to_string(), views.collect()).unwrap()).unwrap();
}

#[test]
fn a_damaged_or_forged_checkpoint_is_an_error_and_takes_no_memory_for_what_it_claims() {
    let folder = Folder::new("forged");
    let run = folder.run("run", "--ppo.updates 1");
    let file = run.join("checkpoints/last.safetensors");
    let (content, settings_file) = (fs::read(&file).unwrap(), run.join("settings.json"));
    let text = fs::read_to_string(&settings_file).unwrap();
    let resume = || try_run(&format!("--resume {} --ppo.updates 2", run.display()));

    // A truncated file.
    fs::write(&file, &content[..content.len() - 1]).unwrap();
    assert!(matches!(resume(), Err(Error::Checkpoint { .. })));
    // Numbers that no run has.
    let same = |_: &str, _: &mut Vec<u8>| {};
    let claims = [("update", u64::MAX), ("steps", u64::MAX), ("optimizer_updates", i32::MAX as u64), ("version", 9)];
    for (name, number) in claims {
        fs::write(&file, &content).unwrap();
        forge(&file, |header| header[name] = number.into(), same);
        let error = resume().unwrap_err().to_string();
        assert!(error.contains(&number.to_string()), "{error}");
    }
    // State that is not finite, or no state of an environment.
    for part in
        ["state/hidden/0", "state/optimizer/mean", "state/optimizer/square", "state/environments", "state/lengths"]
    {
        fs::write(&file, &content).unwrap();
        forge(
            &file,
            |_| {},
            |name, data| {
                if name == part {
                    data.fill(255);
                }
            },
        );
        let error = resume().unwrap_err();
        let is_expected = matches!(error, Error::Diverged { .. } | Error::Checkpoint { .. } | Error::Snapshot(_));
        assert!(is_expected, "{part}: {error}");
        fs::write(&settings_file, &text).unwrap();
    }
    // Sizes that the weights do not have: hundreds of gigabytes.
    fs::write(&file, &content).unwrap();
    let claim = |settings: &mut Json| {
        settings["recurrence"]["hidden_size"] = 16_384.into();
        settings["recurrence"]["layers"] = 64.into();
    };
    forge(&file, |header| claim(&mut header["settings"]), same);
    let mut claimed: Json = serde_json::from_str(&text).unwrap();
    claim(&mut claimed);
    fs::write(&settings_file, claimed.to_string()).unwrap();
    let error = resume().unwrap_err().to_string();
    assert!(error.contains("too few for 34"), "{error}");
    // The checkpoint of another run.
    let other = folder.run("other", "--ppo.updates 1 --environment.option arena_size=6");
    fs::write(&settings_file, &text).unwrap();
    fs::copy(other.join("checkpoints/last.safetensors"), &file).unwrap();
    let error = resume().unwrap_err().to_string();
    assert!(error.contains("must keep its environment.option"), "{error}");
    // Deep nesting is no value of a setting.
    fs::write(&settings_file, format!("{{\"env\": {}", "[".repeat(100_000))).unwrap();
    assert!(parse(&format!("--resume {}", run.display())).unwrap_err().contains("is not of this version"));
}

#[test]
fn presets_and_runs_to_resume_replace_defaults() {
    let paper =
        settings("MortarMayhem-v0 --preset=paper --recurrence.no-embedding --ppo.steps 64").validated().unwrap();
    assert_eq!((paper.recurrence.hidden_size, paper.ppo.steps, paper.ppo.updates), (512, 64, 240_000));
    assert!(!paper.recurrence.embedding && !paper.stop_when_learnt);
    let folder = Folder::new("defaults");
    let run = folder.run("run", "--ppo.updates 1 --time-limit 5 --environment.option arena_size=6");
    let resumed = settings(&format!("--resume={}", run.display()));
    assert_eq!((resumed.environment.num_envs, resumed.time_limit, resumed.ppo.updates), (8, 0.0, 1));
    assert_eq!(resumed.environment.option, ["command_count=[1]", "arena_size=6"]);
    // A new target is kept.
    try_run(&format!("--resume {} --ppo.updates 2 --target-reward 0.5", run.display())).unwrap();
    assert_eq!(settings(&format!("--resume={}", run.display())).target_reward, Some(0.5));
}

#[test]
fn gradients_equal_finite_differences() {
    for agent in ["gru", "mingru", "none"] {
        for residual in ["", "--recurrence.residual"] {
            let settings =
                settings(&format!("{SMALL} --agent {agent} {residual} --model.value-gain 1 --model.vector-width 5"));
            let mut random = Generator::from_seed(8);
            let mut network = network::new(&settings, 4, vec![3, 2], &mut random);
            let resets = [true, false, false, false, true, false, false, false, false];
            let sequences = Sequences::new(3, &resets).unwrap();
            let mut normals = |count: usize| (0..count).map(|_| random.standard_normal() as f32).collect::<Vec<f32>>();
            let states = (0..network.spec.layers).map(|_| normals(3 * 16)).collect();
            let (observations, grad_logits, grad_values) = (normals(9 * 4), normals(9 * 5), normals(9));
            let mut pass = Pass::default();
            (pass.observations, pass.states) = (observations, states);
            (pass.grad_logits, pass.grad_values) = (grad_logits, grad_values);
            let loss = |network: &Network, pass: &mut Pass| {
                network.forward(sequences, pass);
                let dot =
                    |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
                dot(&pass.logits, &pass.grad_logits) + dot(&pass.values, &pass.grad_values)
            };
            network.forward(sequences, &mut pass);
            network.backward(sequences, &mut pass);
            for tensor in network.tensors.clone() {
                let gradient = pass.gradients[tensor.range.clone()].to_vec();
                // Along the gradient, the loss changes by the square of its norm.
                let square: f64 = gradient.iter().map(|g| f64::from(g * g)).sum();
                assert!(square > 0.0, "{}", tensor.name);
                let step = 2e-3 / square.sqrt();
                let mut moved = |sign: f64| {
                    for (weight, gradient) in network.parameters[tensor.range.clone()].iter_mut().zip(&gradient) {
                        *weight += (sign * step * f64::from(*gradient)) as f32;
                    }
                    network.pack();
                    loss(&network, &mut pass)
                };
                let (up, down) = (moved(1.0), moved(-2.0));
                moved(1.0);
                let expected = 2.0 * step * square;
                let error = (up - down - expected).abs() / expected;
                assert!(error < 0.02, "{agent} {residual} {}: {} instead of {expected}", tensor.name, up - down);
            }
        }
    }
}
