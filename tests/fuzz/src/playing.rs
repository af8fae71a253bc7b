//! Pools that the targets play.

use arbitrary::{Result, Unstructured};
use endless_gym::environments;
use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::envs::{ActionSpace, EnvSpec};
use endless_gym_core::pool::{
    Autoreset, OptionMap, Pool, PoolConfig, PoolError, ResetOptions, ResetRequest, Seeding, Threads,
};
use endless_gym_core::random::Generator;

/// Any of the ids.
pub(crate) fn spec(input: &mut Unstructured<'_>) -> Result<&'static EnvSpec> {
    let specs: Vec<_> = environments().specs().collect();
    input.choose(&specs).copied()
}

/// One environment with everything that a batch can contain.
pub(crate) fn config(spec: &EnvSpec, options: OptionMap, autoreset: Autoreset) -> PoolConfig {
    PoolConfig::new(spec.id, 1)
        .options(ResetOptions::Shared(options))
        .autoreset(autoreset)
        .final_observation(autoreset == Autoreset::SameStep)
        .features(true)
}

/// A pool with everything that a batch can contain, which draws each frame twice and compares the two.
pub(crate) fn pool(spec: &EnvSpec, options: OptionMap, autoreset: Autoreset) -> std::result::Result<Pool, PoolError> {
    let config = config(spec, options, autoreset).seeding(Seeding::Continue { seed: Some(3) }).check_drawing(true);
    Pool::new(environments(), &config, &Threads::new(1)?)
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
        let batch = Batch::new(pool.layout(), blocks);
        assert!(batch.reward().iter().all(|reward| reward.is_finite()), "{:?}", batch.reward());
        assert!(batch.features().iter().all(|feature| feature.is_finite()), "{:?}", batch.features());
    }
    view(pool);
    Ok(())
}
