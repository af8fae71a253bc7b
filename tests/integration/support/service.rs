//! Engines and trainers in child processes of the service's tests.
//!
//! The test program starts itself: the ignored test `role` plays the role that an environment variable names.

use std::io::Read;
use std::process::{Command, Stdio};

use crate::faulty_environments;
use endless_gym::memory_gym;
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::service::{
    BatchLease, ConnectConfig, Engine, EngineConfig, Namespace, Observer, Observers, Rejection, ServiceError, Trainer,
};

use super::meeting;
use super::place::Place;
use super::process::{Process, TIMEOUT};

pub const ID: &str = "MortarMayhem-Grid-v0";
const ROLE: &str = "ENDLESS_TEST_ROLE";

impl Place {
    /// A namespace with an engine `gym` in a child process, and its trainer.
    pub fn started(num_envs: usize, groups: usize) -> (Place, Process, Trainer) {
        let place = Place::new();
        let engine = place.engine("gym", num_envs, groups);
        let trainer = place.trainer("gym").unwrap();
        (place, engine, trainer)
    }

    /// Starts an engine in a child process.
    pub fn engine(&self, service: &str, num_envs: usize, groups: usize) -> Process {
        self.role(&format!("engine {service} {num_envs} {groups}"))
    }

    /// Starts this test program in a role.
    pub fn role(&self, role: &str) -> Process {
        let mut command = self.command(std::env::current_exe().unwrap());
        set_role(&mut command, role);
        Process::spawn(command.stdin(Stdio::piped()).stdout(Stdio::null()))
    }

    /// The configuration of an engine that checks what it draws.
    pub fn engine_config(&self, service: &str, num_envs: usize, groups: usize) -> EngineConfig {
        engine_config(self.namespace(), service, num_envs, groups)
    }
}

/// Sets the role of a command that starts this test program.
pub fn set_role(command: &mut Command, role: &str) {
    command.args(["role", "--exact", "--ignored", "--nocapture"]).env(ROLE, role);
}

fn engine_config(namespace: &Namespace, service: &str, num_envs: usize, groups: usize) -> EngineConfig {
    let pool = PoolConfig::new(ID, num_envs).check_drawing(true);
    EngineConfig::new(service, pool, 1).namespace(namespace.clone()).groups(groups)
}

/// Resets a group with seed 3, and returns its first batch.
pub fn reset(trainer: &mut Trainer, group: usize) -> BatchLease {
    trainer.reset(group, ResetRequest::Seed(3)).unwrap();
    trainer.receive(group, TIMEOUT).unwrap()
}

/// Requests a step of a group with actions of 1.
pub fn send(trainer: &mut Trainer, group: usize) {
    trainer.send_with(group, |actions| actions.fill(1)).unwrap();
}

/// Steps a group with actions of 1.
pub fn step(trainer: &mut Trainer, group: usize) -> BatchLease {
    try_step(trainer, group).unwrap()
}

pub fn try_step(trainer: &mut Trainer, group: usize) -> Result<BatchLease, ServiceError> {
    trainer.send_with(group, |actions| actions.fill(1))?;
    trainer.receive(group, TIMEOUT)
}

/// The batch of a step that the trainer has received: the engine delivers it to the observers one after the other.
pub fn observed(observer: &mut Observer, step: u64) -> BatchLease {
    std::iter::repeat_with(|| observer.next(TIMEOUT).unwrap()).find(|lease| lease.step() >= step).unwrap()
}

/// Resets a group and steps it.
pub fn play(trainer: &mut Trainer, group: usize, steps: u64) {
    let first = reset(trainer, group).step();
    for number in 1..=steps {
        let received = step(trainer, group);
        assert_eq!(received.step(), first + number);
        assert_eq!(received.batch().reward().len(), trainer.specification().num_envs);
    }
}

/// Asserts that a call failed with an error that matches the pattern, and returns the error.
macro_rules! assert_error {
    ($result:expr, $pattern:pat $(if $guard:expr)?) => {{
        let error = $result.map(drop).unwrap_err();
        assert!(matches!(&error, $pattern $(if $guard)?), "{error}");
        error
    }};
}
pub(crate) use assert_error;

/// Asserts that an engine rejected a request for that reason, with a message that contains `part`.
#[track_caller]
pub fn assert_rejected<T>(result: Result<T, ServiceError>, expected: Rejection, part: &str) {
    let error = result.map(drop).unwrap_err();
    assert!(matches!(error, ServiceError::Rejected { reason, .. } if reason == expected), "{error}");
    assert!(error.to_string().contains(part), "{error}");
}

/// Plays the role that the environment variable names, if any.
pub fn play_role() {
    let Ok(role) = std::env::var(ROLE) else { return };
    let connect = |service| Trainer::connect(&ConnectConfig::new(service).timeout(TIMEOUT)).unwrap();
    match role.split(' ').collect::<Vec<_>>()[..] {
        ["engine", service, num_envs, groups] => {
            let (num_envs, groups) = (num_envs.parse().unwrap(), groups.parse().unwrap());
            let config = engine_config(&Namespace::default(), service, num_envs, groups);
            serve(Engine::new(memory_gym(), &config).unwrap_or_else(|e| panic!("{e}: {e:?}")));
        }
        ["meeting", num_envs, groups, threads] => {
            let (pool, groups) = (meeting::pool(num_envs.parse().unwrap()), groups.parse().unwrap());
            let config = EngineConfig::new("meeting", pool, threads.parse().unwrap()).groups(groups);
            serve(Engine::new(&meeting::registry(), &config).unwrap());
        }
        ["trainer", service] => {
            let mut trainer = connect(service);
            for group in 0..trainer.specification().groups {
                trainer.reset(group, ResetRequest::All).unwrap();
            }
            loop {
                match trainer.receive_any(TIMEOUT) {
                    // A stopped engine has not answered yet; keep waiting until it is continued or killed.
                    Err(ServiceError::TimedOut { .. }) => {}
                    received => {
                        let group = received.unwrap().group();
                        send(&mut trainer, group);
                    }
                }
            }
        }
        ["faulty", ref arguments @ ..] => faulty_environments::program(arguments),
        ["stuck", "trainer"] => faulty_environments::stuck_trainer(),
        ["observer", service] => {
            let config = ConnectConfig::new(service).timeout(TIMEOUT);
            let mut observers = Observers::connect(&config, None).unwrap();
            loop {
                observers.next(TIMEOUT).unwrap();
            }
        }
        _ => panic!("unknown role {role}"),
    }
}

/// Serves until the parent process closes standard input.
fn serve(engine: Engine) {
    let engine = engine.spawn().unwrap();
    let stopper = engine.stopper();
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        stopper.stop();
    });
    engine.join().unwrap();
}
