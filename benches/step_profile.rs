//! Profiles the phases of a step, by id and number of environments: `cargo bench --bench step_profile`.
//!
//! Each variant of a step adds one phase to the previous variant, and the cost of a phase is the difference between the
//! two. The variants have separate environments and take turns of a few milliseconds of CPU time. The results are
//! medians.
//!
//! Arguments: ids (default: all). `cargo xtask instructions` counts the instructions of a step.

use std::hint::black_box;
use std::sync::Arc;

use endless_gym_core::batch::{BatchBuffer, Block};
use endless_gym_core::envs::{EnvSpec, Environment, ResetParameters};
use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use endless_gym_memory_gym::mortar_mayhem::{self, MortarMayhem};
use endless_gym_memory_gym::mystery_path::{self, MysteryPath};
use endless_gym_memory_gym::searing_spotlights::{self, SearingSpotlights};
use endless_gym_memory_gym::{FRAME, SCREEN, memory_gym};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use rustix::mm::{Advice, madvise};
use rustix::time::{ClockId, clock_gettime};
use serde_json::Map;

const SIZES: [usize; 3] = [64, 1024, 16384];
const ROUNDS: usize = 9;
/// Environment steps of a variant in one round, at least four steps of all environments.
const ROUND_STEPS: usize = 16384;
/// Steps before the first round, after which episodes that began together have spread out.
const WARM_UP: usize = 150;

/// Runs the rules with their random draws, and resets.
const RULES: u8 = 0;
/// Also makes the scene.
const SCENE: u8 = 1;
/// Also compares the scene with the shown one and stores it.
const COMPARED: u8 = 2;
/// Also paints the differences.
const PAINTED: u8 = 3;

/// Steps after which the actions repeat, in other states.
const ACTION_STEPS: usize = 251;

/// Random actions of all environments, step after step, drawn before the clock starts, since drawing them takes about as long as a
/// step.
struct Actions {
    steps: Vec<Vec<i32>>,
    step: usize,
}

impl Actions {
    fn new(spec: &EnvSpec, num_envs: usize) -> Self {
        let branches = spec.action_space.branches();
        let mut random = SmallRng::seed_from_u64(1);
        let mut draw = |choices: &i32| random.random_range(0..*choices);
        let mut step = || (0..num_envs).flat_map(|_| branches).map(&mut draw).collect();
        Actions { steps: (0..ACTION_STEPS).map(|_| step()).collect(), step: 0 }
    }

    fn next(&mut self) -> &[i32] {
        self.step = (self.step + 1) % ACTION_STEPS;
        &self.steps[self.step]
    }
}

/// One environment, with what a pool keeps for it.
struct Player<E: Environment> {
    env: E,
    random: Generator,
    shown: E::Scene,
    ended: bool,
}

/// Environments that play and paint up to a phase.
struct Players<E: Environment> {
    assets: Arc<E::Assets>,
    players: Vec<Player<E>>,
    actions: Actions,
}

impl<E: Environment> Players<E> {
    fn new(spec: &'static EnvSpec, variant: E::Variant, num_envs: usize, warm_up: usize) -> Self {
        let parameters = ResetParameters::new(spec.id, spec.parameters, &Map::new()).unwrap();
        let assets = Arc::new(E::assets(variant, &parameters));
        let player = |number| {
            let (mut env, mut random) = (E::new(&assets), Generator::from_seed(1 + number as u64));
            env.reset(&assets, &mut random);
            Player { shown: env.scene(), env, random, ended: false }
        };
        let players = (0..num_envs).map(player).collect();
        let mut players = Players { players, assets, actions: Actions::new(spec, num_envs) };
        for _ in 0..warm_up {
            players.step::<COMPARED>(&mut []);
        }
        players
    }

    /// Paints the first frames, which also touches the memory.
    fn paint(&self, frames: &mut [u8]) {
        for (player, frame) in self.players.iter().zip(frames.chunks_exact_mut(FRAME.bytes())) {
            E::paint(&self.assets, &player.shown, &mut Canvas::new(frame, SCREEN, SCREEN));
        }
    }

    /// Steps all environments. `frames` holds either one frame for all, which stays in the cache, or one for each.
    fn step<const PHASE: u8>(&mut self, frames: &mut [u8]) {
        let actions = self.actions.next();
        let branches = actions.len() / self.players.len();
        let own = frames.len() > FRAME.bytes();
        for (number, player) in self.players.iter_mut().enumerate() {
            if player.ended {
                player.env.reset(&self.assets, &mut player.random);
                player.ended = false;
            } else {
                let action = &actions[number * branches..][..branches];
                player.ended = black_box(player.env.step(action, &mut player.random)).terminated;
            }
            if PHASE >= SCENE {
                let scene = player.env.scene();
                if PHASE == SCENE {
                    black_box(&scene);
                } else if scene != player.shown {
                    if PHASE == PAINTED {
                        let frame = &mut frames[if own { number * FRAME.bytes() } else { 0 }..][..FRAME.bytes()];
                        let mut canvas = Canvas::new(frame, SCREEN, SCREEN);
                        E::repaint(&self.assets, &player.shown, &scene, &mut canvas);
                    }
                    player.shown = scene;
                }
            }
        }
    }
}

/// A step of all environments.
type Step = Box<dyn FnMut()>;

/// Memory that a step writes to, in small or in huge pages.
fn memory(blocks: usize, huge: bool) -> BatchBuffer {
    let mut memory = BatchBuffer::new(blocks);
    let page = rustix::param::page_size();
    let (start, bytes) = (memory.as_mut_ptr(), size_of_val(&memory[..]));
    let before = start.addr().wrapping_neg() % page;
    if !huge && bytes > before {
        // SAFETY: whole pages of the buffer, whose content the advice does not change.
        unsafe { madvise(start.wrapping_byte_add(before).cast(), bytes - before, Advice::LinuxNoHugepage) }.unwrap();
    }
    memory
}

fn pool_step(spec: &'static EnvSpec, num_envs: usize, huge: bool) -> Step {
    let config = PoolConfig::new(spec.id, num_envs).seeding(Seeding::Continue { seed: Some(1) });
    let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
    let mut batch = memory(pool.layout().blocks(), huge);
    let mut actions = Actions::new(spec, num_envs);
    pool.reset(ResetRequest::All, &mut batch).unwrap();
    let mut step = move || pool.step(actions.next(), &mut batch).unwrap();
    for _ in 0..WARM_UP {
        step();
    }
    Box::new(step)
}

fn player_step<E: Environment + 'static, const PHASE: u8>(
    spec: &'static EnvSpec,
    variant: E::Variant,
    num_envs: usize,
    frames: usize,
    huge: bool,
) -> Step {
    let mut players = Players::<E>::new(spec, variant, num_envs, WARM_UP);
    let bytes = frames * FRAME.bytes();
    let mut frames = memory(bytes.div_ceil(size_of::<Block>()), huge);
    players.paint(&mut bytemuck::cast_slice_mut(&mut frames)[..bytes]);
    Box::new(move || players.step::<PHASE>(&mut bytemuck::cast_slice_mut(&mut frames)[..bytes]))
}

/// CPU time of this thread, in nanoseconds.
fn processor_time() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e9 + time.tv_nsec as f64
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Prints the rows of one id.
fn times<E: Environment + 'static>(spec: &'static EnvSpec, variant: E::Variant) {
    for num_envs in SIZES {
        let mut steps = [
            player_step::<E, RULES>(spec, variant, num_envs, 1, false),
            player_step::<E, SCENE>(spec, variant, num_envs, 1, false),
            player_step::<E, COMPARED>(spec, variant, num_envs, 1, false),
            player_step::<E, PAINTED>(spec, variant, num_envs, 1, false),
            player_step::<E, PAINTED>(spec, variant, num_envs, num_envs, false),
            pool_step(spec, num_envs, false),
            pool_step(spec, num_envs, true),
        ];
        let repeats = (ROUND_STEPS / num_envs).max(4);
        let mut times = vec![Vec::new(); steps.len()];
        for _ in 0..ROUNDS {
            for (step, times) in steps.iter_mut().zip(&mut times) {
                // Warm the caches with this variant's memory.
                step();
                let start = processor_time();
                for _ in 0..repeats {
                    step();
                }
                times.push((processor_time() - start) / (repeats * num_envs) as f64);
            }
        }
        let [rules, scene, compared, painted, frames, pool, huge] =
            times.into_iter().map(median).collect::<Vec<_>>().try_into().unwrap();
        println!(
            "| {} | {num_envs} | {rules:.0} | {:.0} | {:.0} | {:.0} | {:.0} | {:.0} | {pool:.0} | {huge:.0} |",
            spec.id,
            scene - rules,
            compared - scene,
            painted - compared,
            frames - painted,
            pool - frames,
        );
    }
}

/// Prints the rows of a family's ids: of those in `wanted`, or of all if it is empty.
fn all_times<E: Environment + 'static>(ids: &'static [(EnvSpec, E::Variant)], wanted: &[&str]) {
    for (spec, variant) in ids.iter().filter(|(spec, _)| wanted.is_empty() || wanted.contains(&spec.id)) {
        times::<E>(spec, *variant);
    }
}

fn main() {
    // Cargo adds `--bench`.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    println!("| id | environments | rules | scene | compare | paint | own frames | pool | all | huge pages |");
    println!("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |");
    all_times::<MortarMayhem>(&*mortar_mayhem::IDS, &arguments);
    all_times::<MysteryPath>(&*mystery_path::IDS, &arguments);
    all_times::<SearingSpotlights>(&*searing_spotlights::IDS, &arguments);
}
