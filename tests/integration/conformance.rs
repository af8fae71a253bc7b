//! The checks of environments find seeded mistakes, and nothing in the environments of the project.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::hint::black_box;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use endless_gym::conformance::{assert_conforms, check};
use endless_gym::environments;
use endless_gym::envs::{
    ActionSpace, Column, EnvSpec, InfoColumn, ObservationSpace, Parameter, ResetParameters, Task, Transition,
};
use endless_gym::pool::Registry;
use endless_gym::random::Generator;
use endless_gym::raster::{Canvas, FrameShape, Rect};
use serde::{Deserialize, Serialize};

const ID: &str = "Sum-v0";
const FEATURES: &[Column] = &[Column { name: "sum", description: "sum, 0 to 99" }];
const TRUTH: &[Column] = &[Column { name: "sum", description: "share of the sum" }];
const INFO: &[InfoColumn] = &[InfoColumn { name: "sum", is_integer: true, description: "last sum" }];
const PARAMETERS: &[Parameter] = &[Parameter::int("start", 0, 0, 10, "first sum")];

/// The mistakes, by number.
const NONE: u8 = 0;
const SEED_IGNORED: u8 = 1;
const GLOBAL_RANDOM: u8 = 2;
const STATE_KEPT: u8 = 3;
const SNAPSHOT_INCOMPLETE: u8 = 4;
const SCENE_INCOMPLETE: u8 = 5;
const NEIGHBOURS_COUNT: u8 = 6;
const REWARD_NAN: u8 = 7;
const INFO_FRACTION: u8 = 8;
const OUTSIDE_SPACE: u8 = 9;
const TRUTH_NAN: u8 = 10;
const ACTION_PANICS: u8 = 11;
const LIMIT_PANICS: u8 = 12;
const THREAD_MATTERS: u8 = 13;
const FEATURE_INFINITE: u8 = 14;
const TRUTH_OUTSIDE: u8 = 15;
const ALLOCATES: u8 = 16;
const FORGERY_ACCEPTED: u8 = 17;
const PICTURE_PANICS: u8 = 18;

/// Numbers that belong to no environment.
static RESETS: AtomicI64 = AtomicI64::new(0);
static LAST: AtomicI64 = AtomicI64::new(0);

/// A sum of actions and random numbers, until it is 90.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Sum<const MISTAKE: u8> {
    sum: i64,
    kept: i64,
    #[serde(skip)]
    unsaved: i64,
    #[serde(default)]
    saved: i64,
}

impl<const MISTAKE: u8> PartialEq for Sum<MISTAKE> {
    fn eq(&self, other: &Self) -> bool {
        MISTAKE == SCENE_INCOMPLETE || self.sum == other.sum
    }
}

impl<const MISTAKE: u8> Task for Sum<MISTAKE> {
    type Parameters = i64;

    fn spec() -> EnvSpec {
        let shape = Some(FrameShape::rgb(100, 10));
        let (frame, picture) = if MISTAKE == PICTURE_PANICS { (None, shape) } else { (shape, None) };
        EnvSpec {
            frame,
            picture,
            features: FEATURES,
            observation_space: Some(ObservationSpace::Discrete(100)),
            ground_truth: TRUTH,
            ground_truth_bounds: Some((0.0, 1.0)),
            info: INFO,
            parameters: PARAMETERS,
            ..EnvSpec::new(ID, "Add up", ActionSpace::Discrete(3))
        }
    }

    fn parameters(given: &ResetParameters) -> i64 {
        given.int("start", 0)
    }

    fn reset(&mut self, start: &i64, random: &mut Generator) {
        assert!(MISTAKE != LIMIT_PANICS || *start < 10, "too large");
        let drawn = match MISTAKE {
            SEED_IGNORED => 1,
            GLOBAL_RANDOM => RESETS.fetch_add(1, Ordering::Relaxed) % 20,
            _ => random.integers(0, 20),
        };
        self.sum = start + drawn + if MISTAKE == STATE_KEPT { self.kept } else { 0 };
        self.kept = (self.kept + 1) % 5;
        (self.unsaved, self.saved) = (0, 0);
    }

    fn step(&mut self, _: &i64, action: &[i32], random: &mut Generator) -> Transition {
        assert!(MISTAKE != ACTION_PANICS || action[0] < 2, "not implemented");
        self.sum += i64::from(action[0]) + if MISTAKE == SEED_IGNORED { 1 } else { random.integers(0, 3) };
        match MISTAKE {
            SNAPSHOT_INCOMPLETE => {
                self.unsaved += 1;
                self.sum += self.unsaved % 2;
            }
            NEIGHBOURS_COUNT => self.sum += LAST.swap(self.sum, Ordering::Relaxed) % 3,
            ALLOCATES => self.kept += black_box(vec![action[0]; 3]).len() as i64 % 3,
            // Long enough for other threads to join.
            THREAD_MATTERS => std::thread::sleep(Duration::from_micros(50)),
            _ => {}
        }
        self.sum = self.sum.min(99);
        let reward = match MISTAKE {
            REWARD_NAN if self.sum > 40 => f64::NAN,
            THREAD_MATTERS => {
                let mut hasher = DefaultHasher::new();
                std::thread::current().id().hash(&mut hasher);
                hasher.finish() as f64
            }
            _ => 1.0,
        };
        Transition { reward, terminated: self.sum >= 90, truncated: false }
    }

    fn features(&self, _: &i64, out: &mut [f32]) {
        out[0] = match MISTAKE {
            OUTSIDE_SPACE => 2.0 * self.sum as f32,
            FEATURE_INFINITE if self.sum > 50 => f32::INFINITY,
            _ => self.sum as f32,
        };
    }

    fn paint(&self, _: &i64, canvas: &mut Canvas<'_>) {
        assert!(MISTAKE != PICTURE_PANICS || self.sum < 50, "too far to the right");
        canvas.draw_rect([200; 3], Rect::new(self.sum as i32, 2, 5, 5), 0);
    }

    fn ground_truth(&self, _: &i64, out: &mut [f64]) {
        out[0] = match MISTAKE {
            TRUTH_NAN => f64::NAN,
            TRUTH_OUTSIDE => self.sum as f64 / 10.0,
            _ => self.sum as f64 / 100.0,
        };
    }

    fn info(&self, _: &i64, out: &mut [f64]) {
        out[0] = self.sum as f64 + if MISTAKE == INFO_FRACTION { 0.5 } else { 0.0 };
    }

    fn is_valid(&self, _: &i64) -> bool {
        MISTAKE == FORGERY_ACCEPTED || (0..100).contains(&self.sum)
    }
}

/// The problems that the checks find.
fn problems<T: Task>() -> Vec<String> {
    let registry = Registry::new().with::<T>().unwrap();
    check(&registry, ID).unwrap().into_iter().filter_map(|outcome| outcome.problem).collect()
}

#[test]
fn a_task_without_mistakes_conforms() {
    assert_conforms::<Sum<NONE>>();
}

#[test]
fn each_seeded_mistake_is_found() {
    let found = [
        (problems::<Sum<SEED_IGNORED>>(), "are the same for 8 seeds"),
        (problems::<Sum<GLOBAL_RANDOM>>(), "differs in another pool"),
        (problems::<Sum<STATE_KEPT>>(), "differs after other episodes"),
        (problems::<Sum<SNAPSHOT_INCOMPLETE>>(), "after a restored snapshot"),
        (problems::<Sum<SCENE_INCOMPLETE>>(), "the frame of environment"),
        (problems::<Sum<NEIGHBOURS_COUNT>>(), "differs from one without neighbours"),
        (problems::<Sum<REWARD_NAN>>(), "the reward is NaN"),
        (problems::<Sum<INFO_FRACTION>>(), "the info `sum` is declared an integer"),
        (problems::<Sum<OUTSIDE_SPACE>>(), "are not in Discrete(100)"),
        (problems::<Sum<TRUTH_NAN>>(), "a number of the ground truth is NaN"),
        (problems::<Sum<ALLOCATES>>(), " allocations in 400 steps"),
        (problems::<Sum<TRUTH_OUTSIDE>>(), "a number of the ground truth is "),
        (problems::<Sum<ACTION_PANICS>>(), "panicked in environment 0, in an episode with seed 0: not implemented"),
        (problems::<Sum<LIMIT_PANICS>>(), "`start` = 10: Sum-v0 panicked in environment 0"),
        (problems::<Sum<THREAD_MATTERS>>(), "with three threads"),
        (problems::<Sum<FORGERY_ACCEPTED>>(), "`is_valid` accepts a snapshot with the bytes "),
        (problems::<Sum<FEATURE_INFINITE>>(), "the feature `sum` is"),
        (problems::<Sum<PICTURE_PANICS>>(), "too far to the right"),
    ];
    for (problems, expected) in found {
        assert!(problems.iter().any(|problem| problem.contains(expected)), "expected {expected}, found {problems:?}");
    }
}

#[test]
#[ignore = "slow"]
fn every_environment_of_the_program_conforms() {
    for spec in environments().specs() {
        for outcome in check(environments(), spec.id).unwrap() {
            assert_eq!(outcome.problem, None, "{}: {}", spec.id, outcome.rule);
        }
    }
}
