//! An environment whose step waits for other environments of the same process, so that it ends only if groups step at once.

use std::sync::{Condvar, Mutex};
use std::time::Duration;

use endless_gym::envs::{ActionSpace, Column, EnvSpec, ResetParameters, Task, Transition};
use endless_gym::pool::{PoolConfig, Registry};
use endless_gym::random::Generator;
use serde::{Deserialize, Serialize};

const ID: &str = "Meeting-v0";

/// Most environments that can meet.
pub const MOST: i32 = 64;

/// How long an environment waits for the others.
const PATIENCE: Duration = Duration::from_secs(20);

/// How many environments have come to the running meeting, and how many meetings have ended.
static MEETING: Mutex<(i32, u64)> = Mutex::new((0, 0));
static ENDED: Condvar = Condvar::new();

/// The action is the number of environments that must meet, this one included, or 0 or 1 for none. The reward is 1 if they did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Meeting {
    steps: u64,
}

impl Task for Meeting {
    type Parameters = ();

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[Column { name: "steps", description: "steps of the episode" }];
        EnvSpec { features: FEATURES, ..EnvSpec::new(ID, "Meet", ActionSpace::Discrete(MOST + 1)) }
    }

    fn parameters(_: &ResetParameters) {}

    fn reset(&mut self, (): &(), _: &mut Generator) {
        self.steps = 0;
    }

    fn step(&mut self, (): &(), action: &[i32], _: &mut Generator) -> Transition {
        self.steps += 1;
        let mut meeting = MEETING.lock().unwrap();
        if action[0] > 1 {
            meeting.0 += 1;
            let number = meeting.1;
            if meeting.0 == action[0] {
                *meeting = (0, number + 1);
                ENDED.notify_all();
            } else {
                let waiting = ENDED.wait_timeout_while(meeting, PATIENCE, |(_, ended)| *ended == number);
                if waiting.unwrap().1.timed_out() {
                    return Transition::default();
                }
            }
        }
        Transition { reward: 1.0, ..Transition::default() }
    }

    fn is_valid(&self, (): &()) -> bool {
        true
    }

    fn features(&self, (): &(), out: &mut [f32]) {
        out[0] = self.steps as f32;
    }
}

/// The registry with this environment.
pub fn registry() -> Registry {
    Registry::new().with::<Meeting>().unwrap()
}

/// The configuration of a group.
pub fn pool(num_envs: usize) -> PoolConfig {
    PoolConfig::new(ID, num_envs).features(true).frames(None)
}
