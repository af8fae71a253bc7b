//! Own environments that panic or never end a step: what their engine, its trainer and its operator learn, and what is left.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};

use endless_gym::batch::zeroed;
use endless_gym::envs::{ActionSpace, Column, EnvSpec, ResetParameters, Task, Transition};
use endless_gym::pool::{Pool, PoolConfig, PoolError, Registry, ResetRequest, Threads};
use endless_gym::random::Generator;
use endless_gym::service::{ConnectConfig, Rejection, ServiceError, Trainer};
use rustix::process::Signal;
use serde::{Deserialize, Serialize};

use crate::support::place::Place;
use crate::support::process::{Process, TIMEOUT, wait_until};
use crate::support::service::{assert_rejected, set_role};

const ID: &str = "Faulty-v0";
const NUM_ENVS: usize = 100;

/// Actions: play, panic with a text, a formatted text or a number, and never end.
const PLAY: i32 = 0;
const TEXT: i32 = 1;
const FORMATTED: i32 = 2;
const NUMBER: i32 = 3;
const ENDLESS: i32 = 4;

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Faulty;

impl Task for Faulty {
    type Parameters = ();

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[Column { name: "zero", description: "always 0" }];
        EnvSpec { features: FEATURES, ..EnvSpec::new(ID, "Fail", ActionSpace::Discrete(5)) }
    }

    fn parameters(_: &ResetParameters) {}

    fn reset(&mut self, (): &(), _: &mut Generator) {}

    fn is_valid(&self, (): &()) -> bool {
        true
    }

    fn step(&mut self, (): &(), action: &[i32], _: &mut Generator) -> Transition {
        match action[0] {
            TEXT => panic!("out of coins"),
            FORMATTED => panic!("out of {} coins", 3),
            NUMBER => std::panic::panic_any(7),
            ENDLESS => loop {
                std::hint::spin_loop();
            },
            _ => Transition::default(),
        }
    }
}

fn registry() -> Registry {
    Registry::new().with::<Faulty>().unwrap()
}

/// Runs the program with these environments, for a child process.
pub fn program(arguments: &[&str]) -> ! {
    let arguments = arguments.iter().map(Into::into);
    let executable = env!("CARGO_BIN_EXE_endless").into();
    std::process::exit(endless_gym_cli::main(&registry(), arguments, &[executable]).into())
}

/// Actions of which that of one environment is `action`.
fn actions(env: usize, action: i32) -> Vec<i32> {
    (0..NUM_ENVS).map(|other| if other == env { action } else { PLAY }).collect()
}

#[test]
fn a_panic_names_the_environment_and_the_seed_and_the_pool_can_be_reset() {
    for threads in [1, 3] {
        let threads = Threads::new(threads).unwrap();
        let mut pool = Pool::new(&registry(), &PoolConfig::new(ID, NUM_ENVS), &threads).unwrap();
        let mut blocks = zeroed(pool.layout().blocks());
        for (env, action, message) in
            [(0, TEXT, "out of coins"), (42, FORMATTED, "out of 3 coins"), (99, NUMBER, "not text (`panic_any`)")]
        {
            pool.reset(ResetRequest::Seed(1000), &mut blocks).unwrap();
            pool.step(&actions(0, PLAY), &mut blocks).unwrap();
            let error = pool.step(&actions(env, action), &mut blocks).unwrap_err().to_string();
            let start = format!("Faulty-v0 panicked in environment {env}, in an episode with seed {}: ", 1000 + env);
            assert!(error.starts_with(&start) && error.ends_with(message), "{error}");
            assert!(matches!(pool.step(&actions(0, PLAY), &mut blocks), Err(PoolError::NotReset)));
        }
    }
}

/// An engine of two groups, which writes its errors to a file.
fn engine(place: &Place) -> (Process, PathBuf) {
    let errors = place.root().join("errors");
    let mut command = place.command(std::env::current_exe().unwrap());
    set_role(&mut command, "faulty serve --num-envs=100 --groups=2 --service=gym");
    let engine = Process::spawn(command.stdout(Stdio::null()).stderr(File::create(&errors).unwrap()));
    (engine, errors)
}

fn read(path: &PathBuf) -> String {
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn trainer_and_operator_learn_where_an_environment_panicked() {
    let place = Place::new();
    let (mut engine, errors) = engine(&place);
    let mut trainer = place.trainer("gym").unwrap();
    trainer.reset(1, ResetRequest::Seed(50)).unwrap();
    trainer.receive(1, TIMEOUT).unwrap();
    trainer.send(1, &actions(7, NUMBER)).unwrap();
    let panic = "Faulty-v0 panicked in environment 7, in an episode with seed 157: ";
    assert_rejected(trainer.receive(1, TIMEOUT), Rejection::Panic, &format!("for group 1: {panic}"));
    assert_eq!(engine.wait().code(), Some(1));
    assert!(read(&errors).contains(&format!("the engine ends, since in group 1 {panic}")), "{}", read(&errors));
    let lost = trainer.reset(0, ResetRequest::All).and_then(|()| trainer.receive(0, TIMEOUT).map(drop));
    assert!(matches!(lost, Err(ServiceError::EngineLost { .. })), "{lost:?}");
}

/// Sends a step that never ends.
fn stick(trainer: &mut Trainer) {
    trainer.reset(1, ResetRequest::All).unwrap();
    trainer.receive(1, TIMEOUT).unwrap();
    trainer.send(1, &actions(7, ENDLESS)).unwrap();
    assert!(matches!(trainer.receive(1, Duration::from_millis(300)), Err(ServiceError::TimedOut { .. })));
}

#[track_caller]
fn assert_explained(errors: &str) {
    let start = "endless: engine `gym` of Faulty-v0 was asked to stop, but the step of group 1 has been running for ";
    assert!(errors.contains(start) && errors.ends_with("; it ends without saving\n"), "{errors}");
}

#[test]
fn an_engine_in_a_step_that_never_ends_stops_on_a_signal_and_leaves_nothing() {
    let place = Place::new();
    let (mut engine, errors) = engine(&place);
    let mut trainer = place.trainer("gym").unwrap();
    stick(&mut trainer);
    drop(trainer);
    engine.signal(Signal::TERM);
    assert_eq!(engine.wait().code(), Some(1));
    assert_explained(&read(&errors));
    std::fs::remove_file(errors).unwrap();
    place.assert_nothing_left();
}

#[test]
fn a_second_signal_ends_an_engine_in_a_step_that_never_ends_at_once() {
    let place = Place::new();
    let (mut engine, _) = engine(&place);
    stick(&mut place.trainer("gym").unwrap());
    engine.signal(Signal::TERM);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(engine.0.try_wait().unwrap(), None::<ExitStatus>, "the engine waits");
    engine.signal(Signal::TERM);
    assert_eq!(engine.wait().code(), Some(130));
}

/// Starts an engine as a child process, sends it a step that never ends, and prints the engine's process id.
pub fn stuck_trainer() -> ! {
    let mut command = std::process::Command::new(std::env::current_exe().unwrap());
    set_role(
        &mut command,
        &format!("faulty serve --num-envs=100 --groups=2 --service=gym --child={}", std::process::id()),
    );
    let engine = command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    stick(&mut Trainer::connect(&ConnectConfig::new("gym").timeout(TIMEOUT)).unwrap());
    println!("\nengine {}", engine.id());
    std::thread::sleep(Duration::from_secs(600));
    std::process::exit(1)
}

#[test]
fn an_engine_in_a_step_that_never_ends_ends_after_its_killed_trainer_and_leaves_nothing() {
    let place = Place::new();
    let errors = place.root().join("errors");
    let mut command = place.command(std::env::current_exe().unwrap());
    set_role(&mut command, "stuck trainer");
    let mut trainer = Process::spawn(command.stdout(Stdio::piped()).stderr(File::create(&errors).unwrap()));
    let mut lines = BufReader::new(trainer.0.stdout.take().unwrap()).lines().map_while(Result::ok);
    let engine = lines
        .find_map(|line| Some(line.strip_prefix("engine ")?.to_owned()))
        .unwrap_or_else(|| panic!("{}", read(&errors)));
    trainer.kill();
    let killed = Instant::now();
    let process = PathBuf::from(format!("/proc/{engine}"));
    wait_until("the engine ends", || !process.exists());
    assert!(killed.elapsed() < Duration::from_secs(20), "{:?}", killed.elapsed());
    assert_explained(&read(&errors));
    std::fs::remove_file(errors).unwrap();
    place.assert_nothing_left();
}
