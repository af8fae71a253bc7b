//! What operators of `endless serve` rely on, with real processes: checkpoints, status, metrics, logs, and its end.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::Stdio;
use std::thread::{self, available_parallelism};
use std::time::{Duration, Instant};

use crate::support::page::Server;
use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::{Process, TIMEOUT, text, wait_until};
use crate::support::service::{assert_rejected, reset, send, step, try_step};
use endless_gym::pool::{EnvReset, PoolConfig, ResetRequest, Seeding};
use endless_gym::service::{Observer, Rejection, Trainer};
use endless_gym_core::conformance::seal;
use rustix::process::Signal;
use serde_json::Value as Json;

const NUM_ENVS: usize = 3;
const GROUPS: usize = 2;

/// The arguments for environments that have a twin in this process.
const ENVIRONMENTS: [&str; 7] = [
    "--env=Endless-MysteryPath-v0",
    "--num-envs=3",
    "--groups=2",
    "--service=gym",
    "--seed-range=0..1000",
    "--seed=4",
    "--frame-stack=3",
];

fn serve(place: &Place, more: &[&str]) -> Process {
    let arguments = [&["serve"], &ENVIRONMENTS[..], more].concat();
    Process::spawn(place.endless(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()))
}

/// The CPUs on which each thread of a process may run, by the thread's name.
fn allowed_cpus(process: u32) -> BTreeMap<String, String> {
    let threads = std::fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let allowed = threads.map(|thread| {
        let status = std::fs::read_to_string(thread.unwrap().path().join("status")).unwrap();
        let field = |name| status.lines().find_map(|line| line.strip_prefix(name)).unwrap().trim().to_owned();
        (field("Name:"), field("Cpus_allowed_list:"))
    });
    allowed.collect()
}

#[test]
fn pinned_threads_have_a_cpu_each() {
    let place = Place::new();
    let all = available_parallelism().unwrap().get();
    let mask = allowed_cpus(std::process::id()).into_values().next().unwrap();
    let start = |name, threads: usize, groups: usize| {
        let shape = format!("serve --env=MortarMayhem-Grid-v0 --num-envs=64 --service={name} --pin-threads");
        let count = format!("--threads={threads} --groups={groups}");
        let arguments: Vec<_> = shape.split(' ').chain(count.split(' ')).collect();
        Process::spawn(place.endless(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()))
    };
    let mut refused = start("refused", all + 1, all + 1);
    assert_eq!(refused.wait().code(), Some(1));
    let error = refused.errors();
    assert!(error.contains(&format!("need a CPU each, and this process may use {all}")), "{error}");
    // One thread that takes requests and its worker; with one CPU, only the former.
    let threads = all.min(2);
    let engine = start("pinned", threads, 1);
    reset(&mut place.trainer("pinned").unwrap(), 0);
    let found = allowed_cpus(engine.id());
    assert_eq!(found["endless"], mask, "{found:?}");
    let mut bound: Vec<_> = found.iter().filter(|(_, cpus)| **cpus != mask).map(|(name, _)| name.as_str()).collect();
    // The kernel keeps 15 bytes of a name.
    let expected = ["endless-engine", "endless-worker-"];
    bound.sort_unstable();
    assert!(all == 1 || bound == expected[..threads], "{found:?}");
    let cpus: BTreeSet<usize> = expected[..threads].iter().map(|name| found[*name].parse().unwrap()).collect();
    assert_eq!(cpus.len(), threads, "{found:?}");
    ended(engine, Signal::INT);
}

/// Ends an engine with a signal, and returns what it printed.
fn ended(mut engine: Process, by: Signal) -> String {
    engine.signal(by);
    assert!(engine.wait().success());
    engine.output()
}

/// The same environments as the engine's, in this process.
struct Twin {
    groups: Vec<Player>,
}

impl Twin {
    fn new() -> Self {
        let group = |group| {
            let config = PoolConfig::new("Endless-MysteryPath-v0", NUM_ENVS)
                .seeding(Seeding::Range { start: 0, end: 1000, step: 1, seed: Some(4) })
                .frames(Some(endless_gym::batch::Frames { stack: 3, ..Default::default() }))
                .first_env(group * NUM_ENVS)
                .total_envs(GROUPS * NUM_ENVS);
            Player::new(&config)
        };
        Twin { groups: (0..GROUPS).map(group).collect() }
    }

    fn reset(&mut self, trainer: &mut Trainer) {
        for (group, twin) in self.groups.iter_mut().enumerate() {
            trainer.reset(group, ResetRequest::All).unwrap();
            twin.reset(ResetRequest::All);
            let received = trainer.receive(group, TIMEOUT).unwrap();
            assert!(received.batch().bytes() == twin.bytes());
        }
    }

    /// Adopts the engine's episodes.
    fn adopt(&mut self, trainer: &mut Trainer) {
        for (group, twin) in self.groups.iter_mut().enumerate() {
            trainer.reset(group, ResetRequest::Each(&[EnvReset::Keep; NUM_ENVS])).unwrap();
            twin.observe();
            let received = trainer.receive(group, TIMEOUT).unwrap();
            assert!(received.batch().bytes() == twin.bytes());
        }
    }

    /// Plays steps with actions derived from step, environment and group.
    fn play(&mut self, trainer: &mut Trainer, steps: std::ops::Range<usize>) {
        for step in steps {
            for (group, twin) in self.groups.iter_mut().enumerate() {
                let actions: Vec<i32> = (0..NUM_ENVS).map(|env| ((step * 7 + env + group) % 5 % 4) as i32).collect();
                twin.step(&actions);
                trainer.send(group, &actions).unwrap();
                let received = trainer.receive(group, TIMEOUT).unwrap();
                assert!(received.batch().bytes() == twin.bytes(), "step {step}");
            }
        }
    }
}

#[test]
fn a_resumed_engine_continues_identically() {
    let place = Place::new();
    let file = place.root().join("state");
    let checkpoint = format!("--checkpoint={}", file.display());
    let mut twin = Twin::new();

    // Checkpoint on request; then the engine is killed, and everything after the checkpoint is lost.
    let mut engine = serve(&place, &[&checkpoint]);
    let mut trainer = place.trainer("gym").unwrap();
    assert_rejected(trainer.checkpoint(TIMEOUT), Rejection::NotReset, "");
    twin.reset(&mut trainer);
    twin.play(&mut trainer, 0..70);
    assert_eq!(trainer.checkpoint(TIMEOUT).unwrap(), [71, 71]);
    for group in 0..GROUPS {
        step(&mut trainer, group);
    }
    engine.kill();

    // Two engines cannot save to one file, even with different names.
    let first = serve(&place, &[&checkpoint, "--resume"]);
    drop(place.trainer("gym").unwrap());
    let named = ENVIRONMENTS.map(|argument| if argument == "--service=gym" { "--service=second" } else { argument });
    let second = place.run(&[&["serve"], &named[..], &[&checkpoint, "--resume"]].concat());
    let message = format!("is in use by another engine (process {}); stop it, or choose another file", first.id());
    assert_eq!(second.status.code(), Some(1));
    assert!(text(&second.stderr).contains(&message), "{}", text(&second.stderr));
    drop(first);

    // Without `--resume`, the file is not overwritten.
    let refused = place.run(&[&["serve"], &ENVIRONMENTS[..], &[&checkpoint]].concat());
    assert_eq!(refused.status.code(), Some(1));
    assert!(text(&refused.stderr).contains("state exists; resume from it (`--resume`)"), "{}", text(&refused.stderr));
    let other = place.run(&["serve", "--env=MysteryPath-v0", &checkpoint, "--resume"]);
    assert!(text(&other.stderr).contains("the environment Endless-MysteryPath-v0, and the engine has MysteryPath-v0"));

    // The same trainer adopts the episodes, and continues from the checkpoint's step.
    let engine = serve(&place, &[&checkpoint, "--resume"]);
    let found = trainer.reconnect(TIMEOUT).unwrap();
    assert!(found.restarted);
    assert_eq!(
        found.groups.iter().map(|group| (group.step, group.lost_step)).collect::<Vec<_>>(),
        [(Some(71), Some(72)); 2]
    );
    assert_rejected(try_step(&mut trainer, 0), Rejection::NotReset, "");
    twin.adopt(&mut trainer);
    twin.play(&mut trainer, 70..140);

    // Checkpoint on SIGTERM; a new trainer adopts the episodes.
    drop(trainer);
    let output = ended(engine, Signal::TERM);
    assert!(output.contains("resumed from") && output.contains("after 71, 71 batches"), "{output}");
    let engine = serve(&place, &[&checkpoint, "--resume", "--every=20ms"]);
    let mut trainer = place.trainer("gym").unwrap();
    twin.adopt(&mut trainer);
    twin.play(&mut trainer, 140..160);

    // Checkpoint periodically, until nothing changes.
    let saved = || place.status("gym")["checkpoints"].as_u64().unwrap();
    wait_until("nothing is saved any more", || {
        let before = saved();
        std::thread::sleep(Duration::from_millis(200));
        before > 0 && saved() == before
    });
    drop(trainer);
    drop(engine);
    let _engine = serve(&place, &[&checkpoint, "--resume"]);
    let mut trainer = place.trainer("gym").unwrap();
    twin.adopt(&mut trainer);
    twin.play(&mut trainer, 160..200);
}

#[test]
fn missing_and_damaged_checkpoints_are_told_apart() {
    let place = Place::new();
    let file = place.root().join("state");
    let checkpoint = format!("--checkpoint={}", file.display());
    let engine = serve(&place, &[&checkpoint, "--resume"]);
    Twin::new().reset(&mut place.trainer("gym").unwrap());
    let output = ended(engine, Signal::INT);
    assert!(output.contains("does not exist yet"), "{output}");
    let good = std::fs::read(&file).unwrap();
    std::fs::write(&file, &good[..good.len() / 2]).unwrap();
    let damaged = place.run(&[&["serve"], &ENVIRONMENTS[..], &[&checkpoint, "--resume"]].concat());
    assert_eq!(damaged.status.code(), Some(1));
    let message = format!("endless: checkpoint {} is damaged: its checksum differs\n", file.display());
    assert_eq!(text(&damaged.stderr), message);
}

#[test]
fn a_forged_state_in_a_checkpoint_is_refused() {
    let place = Place::new();
    let file = place.root().join("state");
    let arguments = ["serve", "--env=popgym-PositionOnlyPendulumEasy-v0", "--num-envs=1", "--service=gym", "--seed=4"];
    let checkpoint = format!("--checkpoint={}", file.display());
    let arguments = [&arguments[..], &[&checkpoint, "--resume"]].concat();
    let serve = || Process::spawn(place.endless(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()));
    let engine = serve();
    let mut trainer = place.trainer("gym").unwrap();
    reset(&mut trainer, 0);
    step(&mut trainer, 0);
    drop(trainer);
    ended(engine, Signal::INT);
    let good = std::fs::read(&file).unwrap();
    let snapshot = good.windows(4).position(|bytes| bytes == b"EGYM").unwrap();
    // The snapshot ends with angle, velocity, observation and steps; after it, the checkpoint has the empty list of earlier frames.
    let velocity = good.len() - 1 - 1 - 8 - 8;
    for (number, is_valid) in [(0.25_f64, true), (1e200, false), (f64::NAN, false), (-8.5, false)] {
        let mut forged = good.clone();
        forged[velocity..][..8].copy_from_slice(&number.to_le_bytes());
        let end = good.len() - 1;
        seal(&mut forged[snapshot..end]);
        seal(&mut forged);
        std::fs::write(&file, &forged).unwrap();
        if is_valid {
            let engine = serve();
            let mut trainer = place.trainer("gym").unwrap();
            trainer.reset(0, ResetRequest::Each(&[EnvReset::Keep])).unwrap();
            trainer.receive(0, TIMEOUT).unwrap();
            assert!(step(&mut trainer, 0).batch().reward()[0].is_finite());
            drop(trainer);
            ended(engine, Signal::INT);
        } else {
            let refused = place.run(&arguments);
            assert_eq!(refused.status.code(), Some(1), "{number}");
            assert!(text(&refused.stderr).contains("the state has a number that is out of its range"));
        }
    }
}

#[test]
fn status_shows_engines_and_their_processes() {
    let place = Place::new();
    let missing = place.run(&["status", "gym"]);
    assert_eq!(missing.status.code(), Some(1));
    assert!(text(&missing.stderr).starts_with("endless: no engine `gym` is running in"), "{}", text(&missing.stderr));
    assert_eq!(text(&place.run(&["status"]).stdout), "no engine is running\n");
    assert_eq!(text(&place.run(&["status", "--json"]).stdout), "[]\n");

    let engine = serve(&place, &[]);
    let mut trainer = place.trainer("gym").unwrap();
    let own = std::process::id();
    let idle = place.status("gym");
    assert_eq!(
        (&idle["process"], &idle["trainers"], &idle["observers"]),
        (&engine.id().into(), &[own].into(), &Json::Array(vec![]))
    );
    assert_eq!((&idle["groups"][0]["trainer_process"], &idle["env_steps"]), (&Json::Null, &0.into()));
    let mut observer = Observer::connect(&place.connect_config("gym"), 1).unwrap();
    let mut twin = Twin::new();
    twin.reset(&mut trainer);
    twin.play(&mut trainer, 0..50);
    let _held = step(&mut trainer, 0);
    step(&mut trainer, 0);
    let seen = observer.next(TIMEOUT).unwrap();
    step(&mut trainer, 1);
    let seen = [seen, observer.next(TIMEOUT).unwrap()];

    let before = place.leftovers();
    let status = place.status("gym");
    assert_eq!((&status["trainers"], &status["observers"]), (&[own].into(), &[own].into()));
    assert_eq!((&status["env_steps"], &status["groups"][0]["step"]), (&(103 * NUM_ENVS).into(), &53.into()));
    let observers = [0, 1].map(|group| status["groups"][group]["observers"].as_array().unwrap().len());
    assert_eq!(observers, [0, 1], "{status}");
    let of_group = &status["groups"][1]["observers"][0];
    assert_eq!((&of_group["process"], &of_group["held"], &of_group["batches"]), (&own.into(), &2.into(), &2.into()));
    assert_eq!((&status["groups"][0]["held"], &status["groups"][0]["kind"]), (&1.into(), &"step".into()));
    assert_eq!(status["incarnation"], format!("{:016x}", trainer.specification().incarnation));
    assert!(status["shared_memory_bytes"].as_u64().unwrap() > 1_000_000, "{status}");
    assert!(status["groups"][1]["seconds_since_request"].as_f64().unwrap() < 60.0);
    let table = place.run(&["status"]);
    for part in [
        "gym",
        "Endless-MysteryPath-v0",
        "2 x 3",
        "309",
        "held by observers",
        &own.to_string(),
        &engine.id().to_string(),
    ] {
        assert!(text(&table.stdout).contains(part), "{part}: {}", text(&table.stdout));
    }
    assert!(text(&place.run(&["status", "gym"]).stdout).contains("incarnation"));
    assert_eq!(place.leftovers(), before, "looking leaves nothing and removes nothing");
    drop((seen, observer));
    assert_eq!(place.status("gym")["groups"][1]["observers"], Json::Array(vec![]));

    // A stopped engine does not answer, but its status can still be read.
    engine.stop();
    send(&mut trainer, 0);
    assert_eq!(place.status("gym")["groups"][0]["step"], 53);
    engine.resume();
    trainer.receive(0, TIMEOUT).unwrap();

    let mut watch = place.endless(&["status", "--watch", "0.05", "--json"]);
    let mut watch = Process::spawn(watch.stdout(Stdio::piped()));
    let lines = BufReader::new(watch.0.stdout.take().unwrap()).lines();
    assert!(lines.map_while(Result::ok).filter(|line| line.contains("\"incarnation\"")).nth(2).is_some());
    watch.interrupt();

    // A named engine is observed until it ends.
    let watch = |more: &[&str]| {
        let arguments = [&["status", "gym", "--watch", "0.05"], more].concat();
        Process::spawn(place.endless(&arguments).stdout(Stdio::piped()))
    };
    let (mut lines, mut tables) = (watch(&["--json"]), watch(&[]));
    let mut readings = BufReader::new(lines.0.stdout.take().unwrap()).lines();
    let mut next = || serde_json::from_str::<Json>(&readings.next().unwrap().unwrap()).unwrap()[0].clone();
    assert_eq!(next()["mean_length"], Json::Null);
    let mut shown = BufReader::new(tables.0.stdout.take().unwrap());
    let seen = thread::spawn(move || {
        let mut said = String::new();
        while !said.contains("\nmean return ") {
            assert!(shown.read_line(&mut said).unwrap() > 0, "{said}");
        }
        (shown, said)
    });
    wait_until("both see an episode end", || {
        (0..20).for_each(|_| drop(step(&mut trainer, 0)));
        let reading = next();
        let is_seen = reading["mean_return"].is_number() && reading["mean_length"].as_f64().unwrap() > 1.0;
        is_seen && seen.is_finished()
    });
    ended(engine, Signal::INT);
    assert!(lines.wait().success() && tables.wait().success());
    let (mut shown, mut said) = seen.join().unwrap();
    shown.read_to_string(&mut said).unwrap();
    assert!(said.ends_with("\nthe engine has ended\n"), "{said}");
}

#[test]
fn metrics_are_served_for_prometheus() {
    let place = Place::new();
    let mut server =
        Server::start(place.endless(&[&["serve"], &ENVIRONMENTS[..], &["--metrics=127.0.0.1:0"]].concat()));
    let address = server.address();
    assert_eq!(server.url, format!("http://{address}/metrics"));
    // Clients that send half a request and never read.
    let _stuck: Vec<_> = (0..20)
        .map(|_| {
            let mut stream = TcpStream::connect(address).unwrap();
            stream.write_all(b"GET /metrics HTTP/1.1\r\nHost:").unwrap();
            stream
        })
        .collect();
    let mut trainer = place.trainer("gym").unwrap();
    let mut twin = Twin::new();
    twin.reset(&mut trainer);
    twin.play(&mut trainer, 0..10);
    let (status, head, body) = server.get("/metrics", &[]);
    assert!(status == 200 && head.contains("text/plain; version=0.0.4"), "{head}");
    let body = text(&body);
    for line in [
        "# TYPE endless_gym_env_steps_total counter",
        "endless_gym_env_steps_total{service=\"gym\",group=\"1\"} 30",
        "endless_gym_batches_total{service=\"gym\",group=\"0\"} 11",
        "endless_gym_seconds_since_checkpoint{service=\"gym\"} NaN",
    ] {
        assert!(body.lines().any(|found| found == line), "{line}: {body}");
    }
    assert!(body.contains("endless_gym_engine_info{service=\"gym\",id=\"Endless-MysteryPath-v0\",num_envs=\"3\""));
    // HELP and TYPE precede every sample.
    let mut described = (String::new(), String::new());
    for line in body.lines() {
        match line.split(' ').collect::<Vec<_>>()[..] {
            ["#", "HELP", name, ..] => described.0 = name.to_owned(),
            ["#", "TYPE", name, "counter" | "gauge"] => described.1 = name.to_owned(),
            [sample, value] => {
                let name = sample.split('{').next().unwrap();
                assert_eq!((name, name), (&*described.0, &*described.1));
                value.parse::<f64>().unwrap();
            }
            _ => {}
        }
    }
    assert_eq!(server.status("/", &[]), 404);
    let taken = place.run(&["serve", "--service=other", &format!("--metrics={address}")]);
    assert!(text(&taken.stderr).starts_with(&format!("endless: --metrics {address}: ")), "{}", text(&taken.stderr));
    // The stuck clients do not delay the engine's end.
    let start = Instant::now();
    server.process.signal(Signal::TERM);
    assert!(server.process.wait().success());
    assert!(start.elapsed() < Duration::from_secs(5));
}

#[test]
fn the_log_option_overrides_the_variable() {
    let place = Place::new();
    let errors = |arguments: &[&str], variable: Option<&str>| {
        let mut command = place.endless(&[&["serve", "--num-envs=1"], arguments].concat());
        command.env_remove("ENDLESS_GYM_LOG").stdout(Stdio::null()).stderr(Stdio::piped());
        variable.map(|value| command.env("ENDLESS_GYM_LOG", value));
        let mut engine = Process::spawn(&mut command);
        reset(&mut place.trainer("endless").unwrap(), 0);
        engine.interrupt();
        engine.errors()
    };
    assert_eq!(errors(&[], None), "");
    for output in [errors(&["--log=info"], None), errors(&["--log", "info"], Some("off")), errors(&[], Some("info"))] {
        for part in
            ["INFO", "engine started", "service=\"endless\"", "a trainer sends its first request", "engine stopped"]
        {
            assert!(output.contains(part), "{part}: {output}");
        }
    }
    assert_eq!(errors(&["--log=off"], Some("info")), "");
    let wrong = place.run(&["list", "--log=loud=very"]);
    assert_eq!(wrong.status.code(), Some(1));
    assert!(text(&wrong.stderr).starts_with("endless: --log must be off, error, warn"), "{}", text(&wrong.stderr));
}
