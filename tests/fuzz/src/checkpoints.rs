//! The content of a checkpoint for each environment: a snapshot, and the earlier frames of a stack.

use arbitrary::{Result, Unstructured};
use endless_gym::environments;
use endless_gym_core::batch::{Frames, zeroed};
use endless_gym_core::conformance::seal;
use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};

use crate::playing;

const ENVS: usize = 2;

/// The target.
pub fn target(input: &mut Unstructured<'_>) -> Result<()> {
    let spec = playing::spec(input)?;
    let frames = Some(Frames { stack: input.int_in_range(1..=4)?, ..Frames::default() });
    let seeding = Seeding::Continue { seed: Some(3) };
    let config = PoolConfig::new(spec.id, ENVS).frames(frames).seeding(seeding).check_drawing(true);
    let pool =
        || Pool::new(environments(), &config, &Threads::new(1).expect("one thread")).expect("defaults are valid");
    let mut saving = pool();
    let mut blocks = zeroed(saving.layout().blocks());
    saving.reset(ResetRequest::Seed(1), &mut blocks).expect("a pool can be reset");
    let mut saved = saving.save().expect("it can be saved").expect("it was reset");
    for _ in 0..input.int_in_range(0..=6)? {
        let env = &mut saved[usize::from(input.arbitrary::<bool>()?)];
        match input.int_in_range(0..=4_u8)? {
            0 => env.earlier_frames.truncate(input.int_in_range(0..=env.earlier_frames.len())?),
            1 => env.earlier_frames.extend_from_slice(input.arbitrary()?),
            2 => env.snapshot = input.arbitrary()?,
            _ => {
                let place = input.choose_index(env.snapshot.len().max(1))?;
                let byte = input.arbitrary()?;
                env.snapshot.get_mut(place).into_iter().for_each(|at| *at = byte);
                seal(&mut env.snapshot);
            }
        }
    }
    saved.truncate(input.int_in_range(0..=20)?.max(1));
    let mut pool = pool();
    if pool.resume(&saved).is_ok() {
        assert_eq!(saved.len(), ENVS, "every environment is resumed");
        for _ in 0..30 {
            pool.step(&vec![1; ENVS * spec.action_space.width()], &mut blocks).expect("a resumed pool plays");
        }
    } else if pool.step(&vec![0; ENVS * spec.action_space.width()], &mut blocks).is_ok() {
        panic!("a pool that was not resumed must be reset first");
    }
    Ok(())
}
