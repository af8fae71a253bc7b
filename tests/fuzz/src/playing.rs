//! Pools that the targets play.

use std::sync::LazyLock;

use arbitrary::{Result, Unstructured};
use endless_gym_core::batch::{Block, zeroed};
use endless_gym_core::envs::{ActionSpace, EnvSpec};
use endless_gym_core::pool::{
    Autoreset, OptionMap, Pool, PoolConfig, PoolError, Registry, ResetOptions, ResetRequest, Seeding, Threads,
};
use endless_gym_core::random::Generator;
use endless_gym_memory_gym::memory_gym;
use endless_gym_popgym::register;

/// All ids.
pub fn registry() -> &'static Registry {
    static REGISTRY: LazyLock<Registry> = LazyLock::new(|| register(memory_gym().clone()).expect("ids are unique"));
    &REGISTRY
}

/// Any of the ids.
pub(crate) fn spec(input: &mut Unstructured<'_>) -> Result<&'static EnvSpec> {
    let specs: Vec<_> = registry().specs().collect();
    input.choose(&specs).copied()
}

/// A pool with everything that a batch can contain, which draws each frame twice and compares the two.
pub(crate) fn pool(spec: &EnvSpec, options: OptionMap, autoreset: Autoreset) -> std::result::Result<Pool, PoolError> {
    let config = PoolConfig::new(spec.id, 1)
        .seeding(Seeding::Continue { seed: Some(3) })
        .options(ResetOptions::Shared(options))
        .autoreset(autoreset)
        .final_observation(autoreset == Autoreset::SameStep)
        .features(true)
        .check_drawing(true);
    Pool::new(registry(), &config, &Threads::new(1)?)
}

/// Resets a pool.
pub(crate) fn reset(pool: &mut Pool) -> Vec<Block> {
    let mut blocks = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut blocks).expect("a pool can be reset");
    blocks
}

/// Draws the ground-truth view, if there is one.
pub(crate) fn view(pool: &mut Pool) {
    if pool.spec().shown().is_some() {
        pool.ground_truth_view(0).expect("the environment exists");
    }
}

/// Plays `steps` actions from `input`, or zeros when it is exhausted.
pub(crate) fn play(pool: &mut Pool, blocks: &mut [Block], input: &mut Unstructured<'_>, steps: usize) -> Result<()> {
    let space = pool.spec().action_space.clone();
    for _ in 0..steps {
        let action = match &space {
            ActionSpace::Box { .. } => space.sample(&mut Generator::from_seed(input.arbitrary()?)),
            _ => space.branches().iter().map(|count| input.int_in_range(0..=count - 1)).collect::<Result<_>>()?,
        };
        pool.step(&action, blocks).expect("an action in range is played");
    }
    view(pool);
    Ok(())
}
