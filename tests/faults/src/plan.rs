//! Plans which faults happen when. A plan depends only on a seed and a round number, so that printing both suffices to
//! repeat it.

use endless_gym_core::random::{Generator, SeedSequence};
use serde::{Deserialize, Serialize};

use crate::shape::Shape;

/// One process of a round.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Role {
    Engine,
    Trainer,
    Observer,
}

/// One fault. Times are in milliseconds; moments within a start or an end are in microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Fault {
    /// SIGKILL; a successor starts after `down`.
    Kill { role: Role, down: u64 },
    /// A process is killed, and so is its successor while it starts.
    KillStarting { role: Role, moment: u64 },
    /// A process is asked to end, and killed while it does.
    KillEnding { role: Role, moment: u64 },
    /// SIGSTOP and, later, SIGCONT.
    Stop { role: Role, time: u64 },
    /// The same for the successor of a killed process while it starts.
    StopStarting { role: Role, moment: u64, time: u64 },
    /// The engine ends regularly and is started again.
    Restart { down: u64 },
    /// A trainer with a forked child is killed or ends; the child lives on.
    Fork { is_killed: bool },
    /// A process is restarted with a limit on its descriptors.
    Descriptors { role: Role, limit: u64 },
    /// The modification times of all files move, as after a jump of the clock; then the trainer is replaced.
    ClockJump { seconds: i64 },
    /// The namespace's directory is removed; then the trainer or the engine is replaced.
    RemoveRoot { then: Role },
    /// /dev/shm is full for a time, during which a process is killed and started again.
    FillMemory { role: Role, time: u64 },
    /// An observer that keeps every batch.
    HoardingObserver,
    /// A process with another root directory of the same path but the same /dev/shm lists engines when the segments are
    /// old.
    OtherContainer,
    /// Another user's process tries to list engines, to connect, and to remove files.
    OtherUser,
    /// A run of `endless learn` is killed before or after its first checkpoint, and so, at the moment `resumed`, is the
    /// process that continues it. Moments are in millionths of the time that an undisturbed run takes.
    KillLearner { has_checkpoint: bool, moment: u64, resumed: Option<u64> },
}

impl Fault {
    /// The name under which the fault is counted.
    pub fn kind(self) -> String {
        let (role, what) = match self {
            Fault::Kill { role, .. } => (role, "killed"),
            Fault::KillStarting { role, .. } => (role, "killed while it starts"),
            Fault::KillEnding { role, .. } => (role, "killed while it ends"),
            Fault::Stop { role, .. } => (role, "stopped"),
            Fault::StopStarting { role, .. } => (role, "stopped while it starts"),
            Fault::Descriptors { role, .. } => (role, "with few descriptors"),
            Fault::Restart { .. } => (Role::Engine, "restarted"),
            Fault::Fork { is_killed: true } => return "forked trainer killed".to_owned(),
            Fault::Fork { is_killed: false } => return "forked trainer ended".to_owned(),
            Fault::ClockJump { .. } => return "clock jump".to_owned(),
            Fault::RemoveRoot { .. } => return "directory removed".to_owned(),
            Fault::FillMemory { .. } => return "full /dev/shm".to_owned(),
            Fault::HoardingObserver => return "hoarding observer".to_owned(),
            Fault::OtherContainer => return "container with its own root".to_owned(),
            Fault::OtherUser => return "other user".to_owned(),
            Fault::KillLearner { has_checkpoint, resumed, .. } => {
                let what = match (resumed, has_checkpoint) {
                    (None, false) => "starts",
                    (None, true) => "learns",
                    (Some(_), false) => "starts again",
                    (Some(_), true) => "resumes",
                };
                return format!("learner killed while it {what}");
            }
        };
        format!("{role:?} {what}").to_lowercase()
    }
}

/// A fault and the time before it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    pub pause: u64,
    pub fault: Fault,
}

/// One round: an engine, a trainer, observers and visitors in a new namespace, and the faults that they suffer.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    pub shape: Shape,
    /// The seed of the trainer's resets, actions and calls.
    pub trainer_seed: u64,
    /// Whether its resets change the reset parameters.
    pub with_options: bool,
    /// Mean time between a batch and the trainer's next request, in microseconds.
    pub think: i64,
    pub observers: usize,
    /// Processes that list engines and try to connect all the time.
    pub visitors: usize,
    /// Size in megabytes of a separate /dev/shm for the round.
    pub own_memory: Option<u64>,
    pub steps: Vec<Step>,
}

/// About how long a process takes to start and connect, in microseconds.
const START: i64 = 60_000;

/// The time that an undisturbed run of `endless learn` takes.
pub const MILLION: i64 = 1_000_000;

impl Plan {
    /// Round `number` of a seed.
    pub fn new(seed: u64, number: u64) -> Self {
        let words = [seed as u32, (seed >> 32) as u32, number as u32, (number >> 32) as u32];
        let draws = &mut Generator::from_seed_sequence(&SeedSequence::from_words(&words));
        let own_memory = (draws.integers(0, 4) == 0).then(|| draws.integers(16, 65) as u64);
        let shape = Shape::random(draws, 6);
        let count = draws.integers(3, 8);
        Plan {
            shape,
            trainer_seed: draws.integers(0, 1 << 40) as u64,
            with_options: draws.integers(0, 2) == 0,
            think: 300,
            observers: draws.integers(0, 3) as usize,
            visitors: draws.integers(0, 3) as usize,
            own_memory,
            steps: (0..count)
                .map(|_| Step { pause: draws.integers(0, 300) as u64, fault: fault(draws, own_memory.is_some()) })
                .collect(),
        }
    }
}

fn fault(draws: &mut Generator, owns_memory: bool) -> Fault {
    let role = *draws.choice(&[Role::Engine, Role::Engine, Role::Trainer, Role::Trainer, Role::Observer]);
    let mut below = |limit: i64| draws.integers(0, limit) as u64;
    let (moment, time, down) = (below(START), below(1500), below(200));
    if owns_memory && below(2) == 0 {
        return if below(4) == 0 { Fault::HoardingObserver } else { Fault::FillMemory { role, time } };
    }
    match below(22) {
        0..=2 => Fault::Kill { role, down },
        3..=4 => Fault::KillStarting { role, moment },
        5 => Fault::KillEnding { role, moment: moment / 4 },
        6..=7 => Fault::Stop { role, time },
        8..=9 => Fault::StopStarting { role, moment, time },
        10 => Fault::Restart { down },
        11 => Fault::Fork { is_killed: below(2) == 0 },
        12 => Fault::Descriptors { role, limit: 4 + below(60) },
        13 => Fault::ClockJump { seconds: if below(2) == 0 { -3600 } else { 3600 } },
        14 => Fault::RemoveRoot { then: if below(2) == 0 { Role::Trainer } else { Role::Engine } },
        15 => Fault::HoardingObserver,
        16 => Fault::OtherContainer,
        17..=20 => {
            let has_checkpoint = below(2) == 0;
            let resumed = (below(2) == 0).then(|| below(MILLION));
            Fault::KillLearner { has_checkpoint, moment: below(MILLION), resumed }
        }
        // A user namespace contains no other user.
        _ if owns_memory => Fault::Kill { role, down },
        _ => Fault::OtherUser,
    }
}
