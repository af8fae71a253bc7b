//! What an operator of `endless serve` relies on: checkpoints, status, metrics, logs, and its end. Real processes.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::support::program::{Room, signal, text, wait};
use endless_gym::batch::{Batch, Block, zeroed};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use endless_gym::service::{Observer, Rejection, ServiceError, Trainer};
use rustix::process::Signal;
use serde_json::Value as Json;

const SECONDS: Duration = Duration::from_secs(10);
const NUM_ENVS: usize = 3;
const GROUPS: usize = 2;

/// A running `endless serve`, killed at the end of the test.
struct Served(Child);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Served {
    fn end(mut self, by: Signal) -> String {
        signal(&self.0, by);
        assert!(wait(&mut self.0).success());
        let mut output = String::new();
        self.0.stdout.take().unwrap().read_to_string(&mut output).unwrap();
        output
    }
}

/// Environments of which the engine has a twin in this process.
const ENVIRONMENTS: [&str; 7] = [
    "--env=Endless-MysteryPath-v0",
    "--num-envs=3",
    "--groups=2",
    "--service=gym",
    "--seed-range=0..1000",
    "--seed=4",
    "--frame-stack=3",
];

fn serve(room: &Room, more: &[&str]) -> Served {
    let arguments = [&["serve"], &ENVIRONMENTS[..], more].concat();
    Served(room.endless(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
}

fn wait_for(file: &Path) {
    let start = Instant::now();
    while !file.exists() {
        assert!(start.elapsed() < SECONDS, "{} does not appear", file.display());
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The engine's environments in this process.
struct Twin {
    groups: Vec<(Pool, Vec<Block>)>,
}

impl Twin {
    fn new() -> Self {
        let group = |group| {
            let config = PoolConfig {
                seeding: Seeding::Range { start: 0, end: 1000, step: 1, seed: Some(4) },
                frames: Some(endless_gym::batch::Frames { stack: 3, ..Default::default() }),
                first_env: group * NUM_ENVS,
                total_envs: GROUPS * NUM_ENVS,
                ..PoolConfig::new("Endless-MysteryPath-v0", NUM_ENVS)
            };
            let pool = Pool::new(&config, &Threads::new(1).unwrap()).unwrap();
            let blocks = zeroed(pool.layout().blocks());
            (pool, blocks)
        };
        Twin { groups: (0..GROUPS).map(group).collect() }
    }

    fn reset(&mut self, trainer: &mut Trainer) {
        for (group, (pool, blocks)) in self.groups.iter_mut().enumerate() {
            trainer.reset(group, ResetRequest::All).unwrap();
            pool.reset(ResetRequest::All, blocks).unwrap();
            let received = trainer.receive(group, SECONDS).unwrap();
            assert!(received.batch().bytes() == Batch::new(pool.layout(), blocks).bytes());
        }
    }

    /// Adopts the engine's episodes.
    fn adopt(&mut self, trainer: &mut Trainer) {
        for (group, (pool, blocks)) in self.groups.iter_mut().enumerate() {
            trainer.reset(group, ResetRequest::Each { reset: &[0; NUM_ENVS], seed: &[0; NUM_ENVS] }).unwrap();
            pool.observe(blocks).unwrap();
            let received = trainer.receive(group, SECONDS).unwrap();
            assert!(received.batch().bytes() == Batch::new(pool.layout(), blocks).bytes());
        }
    }

    /// Plays steps whose actions depend on their numbers.
    fn play(&mut self, trainer: Option<&mut Trainer>, steps: std::ops::Range<usize>) {
        let mut trainer = trainer;
        for step in steps {
            for (group, (pool, blocks)) in self.groups.iter_mut().enumerate() {
                let actions: Vec<i32> = (0..NUM_ENVS).map(|env| ((step * 7 + env + group) % 5 % 4) as i32).collect();
                pool.step(&actions, blocks).unwrap();
                if let Some(trainer) = &mut trainer {
                    trainer.send(group, &actions).unwrap();
                    let received = trainer.receive(group, SECONDS).unwrap();
                    assert!(received.batch().bytes() == Batch::new(pool.layout(), blocks).bytes(), "step {step}");
                }
            }
        }
    }
}

#[test]
fn an_engine_that_resumes_continues_as_one_that_never_stopped() {
    let room = Room::new("resume");
    let file = room.root.join("state");
    let checkpoint = format!("--checkpoint={}", file.display());
    let mut twin = Twin::new();

    // On request; then the engine is killed, and everything after the checkpoint is lost.
    let mut engine = serve(&room, &[&checkpoint]);
    let mut trainer = room.connect("gym");
    let refused = trainer.checkpoint(SECONDS).unwrap_err();
    assert!(matches!(refused, ServiceError::Rejected { reason: Rejection::NotReset, .. }), "{refused}");
    twin.reset(&mut trainer);
    twin.play(Some(&mut trainer), 0..70);
    assert_eq!(trainer.checkpoint(SECONDS).unwrap(), [71, 71]);
    for group in 0..GROUPS {
        trainer.send(group, &[1; NUM_ENVS]).unwrap();
        trainer.receive(group, SECONDS).unwrap();
    }
    engine.0.kill().unwrap();
    engine.0.wait().unwrap();

    // Two engines do not save to one file, whatever their names are.
    let first = serve(&room, &[&checkpoint, "--resume"]);
    drop(room.connect("gym"));
    let named = ENVIRONMENTS.map(|argument| if argument == "--service=gym" { "--service=second" } else { argument });
    let second = room.run(&[&["serve"], &named[..], &[&checkpoint, "--resume"]].concat());
    let message = format!("is in use by another engine (process {}); stop it, or choose another file", first.0.id());
    assert_eq!(second.status.code(), Some(1));
    assert!(text(&second.stderr).contains(&message), "{}", text(&second.stderr));
    drop(first);

    // Without `--resume`, the file is not overwritten.
    let refused = room.run(&[&["serve"], &ENVIRONMENTS[..], &[&checkpoint]].concat());
    assert_eq!(refused.status.code(), Some(1));
    assert!(text(&refused.stderr).contains("state exists; resume from it (`--resume`)"), "{}", text(&refused.stderr));
    let other = room.run(&["serve", "--env=MysteryPath-v0", &checkpoint, "--resume"]);
    assert!(text(&other.stderr).contains("the environment Endless-MysteryPath-v0, and the engine has MysteryPath-v0"));

    // The same trainer adopts the episodes, and continues from the checkpoint's step.
    let engine = serve(&room, &[&checkpoint, "--resume"]);
    let found = trainer.reconnect(SECONDS).unwrap();
    assert!(found.restarted);
    assert_eq!(
        found.groups.iter().map(|group| (group.step, group.lost_step)).collect::<Vec<_>>(),
        [(Some(71), Some(72)); 2]
    );
    trainer.send(0, &[1; NUM_ENVS]).unwrap();
    let refused = trainer.receive(0, SECONDS).unwrap_err();
    assert!(matches!(refused, ServiceError::Rejected { reason: Rejection::NotReset, .. }), "{refused}");
    twin.adopt(&mut trainer);
    twin.play(Some(&mut trainer), 70..140);

    // On SIGTERM; a new trainer adopts the episodes.
    drop(trainer);
    let output = engine.end(Signal::TERM);
    assert!(output.contains("resumed from") && output.contains("after 71, 71 batches"), "{output}");
    let engine = serve(&room, &[&checkpoint, "--resume", "--every=20ms"]);
    let mut trainer = room.connect("gym");
    twin.adopt(&mut trainer);
    twin.play(Some(&mut trainer), 140..160);

    // Periodically, until nothing changes.
    let saved = || room.status("gym")["checkpoints"].as_u64().unwrap();
    let start = Instant::now();
    loop {
        let before = saved();
        std::thread::sleep(Duration::from_millis(200));
        if before > 0 && saved() == before {
            break;
        }
        assert!(start.elapsed() < SECONDS);
    }
    drop(trainer);
    drop(engine);
    let _engine = serve(&room, &[&checkpoint, "--resume"]);
    let mut trainer = room.connect("gym");
    twin.adopt(&mut trainer);
    twin.play(Some(&mut trainer), 160..200);
}

#[test]
fn a_checkpoint_that_is_missing_or_damaged_is_told_apart() {
    let room = Room::new("damaged");
    let file = room.root.join("state");
    let checkpoint = format!("--checkpoint={}", file.display());
    let engine = serve(&room, &[&checkpoint, "--resume"]);
    Twin::new().reset(&mut room.connect("gym"));
    let output = engine.end(Signal::INT);
    assert!(output.contains("does not exist yet"), "{output}");
    wait_for(&file);
    let good = std::fs::read(&file).unwrap();
    for (bytes, part) in [
        (good[..good.len() / 2].to_vec(), "is damaged: its checksum differs"),
        (b"something else".to_vec(), "is not a checkpoint"),
        (vec![], "is not a checkpoint"),
    ] {
        std::fs::write(&file, bytes).unwrap();
        let output = room.run(&[&["serve"], &ENVIRONMENTS[..], &[&checkpoint, "--resume"]].concat());
        assert_eq!(output.status.code(), Some(1));
        assert!(text(&output.stderr).contains(part), "{}", text(&output.stderr));
        assert_eq!(text(&output.stderr).lines().count(), 1);
    }
    let nowhere = room.run(&["serve", "--checkpoint=/nowhere/state"]);
    assert!(text(&nowhere.stderr).contains("checkpoint /nowhere/state cannot be written"), "{}", text(&nowhere.stderr));
    for wrong in [vec!["--every=5m"], vec!["--resume"], vec![&checkpoint, "--every=soon"]] {
        assert_eq!(room.run(&[vec!["serve"], wrong].concat()).status.code(), Some(2));
    }
}

#[test]
fn status_shows_engines_and_their_processes() {
    let room = Room::new("status");
    let missing = room.run(&["status", "gym"]);
    assert_eq!(missing.status.code(), Some(1));
    assert!(text(&missing.stderr).starts_with("endless: no engine `gym` is running in"), "{}", text(&missing.stderr));
    assert_eq!(text(&room.run(&["status"]).stdout), "no engine is running\n");
    assert_eq!(text(&room.run(&["status", "--json"]).stdout), "[]\n");

    let engine = serve(&room, &[]);
    let mut trainer = room.connect("gym");
    let own = std::process::id();
    let idle = room.status("gym");
    assert_eq!(
        (&idle["process"], &idle["trainers"], &idle["observers"]),
        (&engine.0.id().into(), &[own].into(), &Json::Array(vec![]))
    );
    assert_eq!((&idle["groups"][0]["trainer_process"], &idle["env_steps"]), (&Json::Null, &0.into()));
    let mut observer = Observer::connect(&room.config("gym"), 1).unwrap();
    let mut twin = Twin::new();
    twin.reset(&mut trainer);
    twin.play(Some(&mut trainer), 0..50);
    trainer.send(0, &[0; NUM_ENVS]).unwrap();
    let _held = trainer.receive(0, SECONDS).unwrap();
    trainer.send(0, &[0; NUM_ENVS]).unwrap();
    let lease = trainer.receive(0, SECONDS).unwrap();
    drop(lease);
    let seen = observer.next(SECONDS).unwrap();
    trainer.send(1, &[0; NUM_ENVS]).unwrap();
    trainer.receive(1, SECONDS).unwrap();
    let seen = [seen, observer.next(SECONDS).unwrap()];

    let before = room.everything();
    let status = room.status("gym");
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
    let table = room.run(&["status"]);
    for part in [
        "gym",
        "Endless-MysteryPath-v0",
        "2 x 3",
        "309",
        "held by observers",
        &own.to_string(),
        &engine.0.id().to_string(),
    ] {
        assert!(text(&table.stdout).contains(part), "{part}: {}", text(&table.stdout));
    }
    assert!(text(&room.run(&["status", "gym"]).stdout).contains("incarnation"));
    assert_eq!(room.everything(), before, "looking leaves nothing and removes nothing");
    drop((seen, observer));
    assert_eq!(room.status("gym")["groups"][1]["observers"], Json::Array(vec![]));

    // An engine that is stopped does not answer, and its status can still be read.
    signal(&engine.0, Signal::STOP);
    trainer.send(0, &[0; NUM_ENVS]).unwrap();
    assert_eq!(room.status("gym")["groups"][0]["step"], 53);
    signal(&engine.0, Signal::CONT);
    trainer.receive(0, SECONDS).unwrap();

    let mut watch = room.endless(&["status", "--watch", "0.05", "--json"]).stdout(Stdio::piped()).spawn().unwrap();
    let lines = BufReader::new(watch.stdout.take().unwrap()).lines();
    assert!(lines.map_while(Result::ok).filter(|line| line.contains("\"incarnation\"")).nth(2).is_some());
    signal(&watch, Signal::INT);
    wait(&mut watch);
}

/// The answer to a request, head and body.
fn http(address: &str, request: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[test]
fn metrics_are_served_for_prometheus() {
    let room = Room::new("metrics");
    let mut engine = serve(&room, &["--metrics=127.0.0.1:0"]);
    let mut lines = BufReader::new(engine.0.stdout.take().unwrap()).lines();
    let printed = lines.by_ref().map(Result::unwrap).find(|line| line.starts_with("metrics at ")).unwrap();
    let address = printed.strip_prefix("metrics at http://").unwrap().strip_suffix("/metrics").unwrap().to_owned();
    // Clients that send half a request, and one that never reads.
    let _stuck: Vec<_> = (0..20)
        .map(|_| {
            let mut stream = TcpStream::connect(&address).unwrap();
            stream.write_all(b"GET /metrics HTTP/1.1\r\nHost:").unwrap();
            stream
        })
        .collect();
    let mut trainer = room.connect("gym");
    let mut twin = Twin::new();
    twin.reset(&mut trainer);
    twin.play(Some(&mut trainer), 0..10);
    let get = |path: &str| http(&address, &format!("GET {path} HTTP/1.1\r\nHost: here\r\nConnection: close\r\n\r\n"));
    let answer = get("/metrics");
    assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("text/plain; version=0.0.4"), "{answer}");
    let body = answer.split("\r\n\r\n").nth(1).unwrap();
    for line in [
        "# TYPE endless_gym_env_steps_total counter",
        "endless_gym_env_steps_total{service=\"gym\",group=\"1\"} 30",
        "endless_gym_batches_total{service=\"gym\",group=\"0\"} 11",
        "endless_gym_seconds_since_checkpoint{service=\"gym\"} NaN",
    ] {
        assert!(body.lines().any(|found| found == line), "{line}: {body}");
    }
    assert!(body.contains("endless_gym_engine_info{service=\"gym\",id=\"Endless-MysteryPath-v0\",num_envs=\"3\""));
    // Every sample has its HELP and TYPE before it.
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
    assert!(get("/").starts_with("HTTP/1.1 404"));
    assert!(
        http(&address, "POST /metrics HTTP/1.1\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
            .starts_with("HTTP/1.1 405")
    );
    let taken = room.run(&["serve", "--service=other", &format!("--metrics={address}")]);
    assert!(text(&taken.stderr).starts_with(&format!("endless: --metrics {address}: ")), "{}", text(&taken.stderr));
    // The stuck clients do not delay the end.
    let start = Instant::now();
    signal(&engine.0, Signal::TERM);
    assert!(wait(&mut engine.0).success());
    assert!(start.elapsed() < Duration::from_secs(5));
}

#[test]
fn logs_follow_the_option_and_the_variable() {
    let room = Room::new("logs");
    let errors = |arguments: &[&str], variable: Option<&str>| {
        let mut command = room.endless(&[&["serve", "--num-envs=1"], arguments].concat());
        command.env_remove("ENDLESS_GYM_LOG").stdout(Stdio::null()).stderr(Stdio::piped());
        variable.map(|value| command.env("ENDLESS_GYM_LOG", value));
        let mut engine = Served(command.spawn().unwrap());
        let mut trainer = room.connect("endless");
        trainer.reset(0, ResetRequest::All).unwrap();
        trainer.receive(0, SECONDS).unwrap();
        signal(&engine.0, Signal::INT);
        wait(&mut engine.0);
        let mut output = String::new();
        engine.0.stderr.take().unwrap().read_to_string(&mut output).unwrap();
        output
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
    let wrong = room.run(&["list", "--log=loud=very"]);
    assert_eq!(wrong.status.code(), Some(1));
    assert!(text(&wrong.stderr).starts_with("endless: --log must be off, error, warn"), "{}", text(&wrong.stderr));
}

#[test]
fn a_second_signal_ends_the_program_at_once() {
    let room = Room::new("twice");
    // A fifo without a reader: the last checkpoint cannot be written, and the engine never ends by itself.
    let fifo: PathBuf = room.root.join("state.new");
    let mut engine = serve(&room, &[&format!("--checkpoint={}", room.root.join("state").display())]);
    Twin::new().reset(&mut room.connect("gym"));
    assert!(Command::new("mkfifo").arg(&fifo).status().unwrap().success());
    signal(&engine.0, Signal::INT);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(engine.0.try_wait().unwrap(), None, "the engine waits");
    signal(&engine.0, Signal::INT);
    assert_eq!(wait(&mut engine.0).code(), Some(130));
}
