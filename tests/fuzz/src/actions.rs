//! Actions: any numbers, in any quantity.

use arbitrary::{Result, Unstructured};
use endless_gym_core::batch::zeroed;
use endless_gym_core::pool::{Autoreset, EnvReset, OptionMap, ResetRequest};

use crate::playing;

const STEPS: usize = 100;

/// The target.
pub fn target(input: &mut Unstructured<'_>) -> Result<()> {
    let spec = playing::spec(input)?;
    let autoreset = *input.choose(&[Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled])?;
    let mut pool = playing::pool(spec, OptionMap::new(), autoreset).expect("defaults are valid");
    let mut blocks = playing::reset(&mut pool);
    for _ in 0..STEPS {
        if input.is_empty() {
            break;
        }
        let before = pool.snapshot(0).expect("the environment exists");
        match input.int_in_range(0..=9_u8)? {
            0 => {
                let actions: Vec<i32> = input.arbitrary()?;
                let played = pool.step(&actions, &mut blocks).is_ok();
                let valid = spec.action_space.check(1, &actions).is_ok();
                assert_eq!(played, valid, "{actions:?}");
                assert!(played || pool.snapshot(0).expect("it exists") == before, "a refused action changes nothing");
            }
            1 => {
                let each: Vec<Option<Option<u64>>> = input.arbitrary()?;
                let item = |reset: &Option<_>| {
                    reset.map_or(EnvReset::Keep, |seed: Option<_>| seed.map_or(EnvReset::Next, EnvReset::Seed))
                };
                let each: Vec<_> = each.iter().map(item).collect();
                let reset = pool.reset(ResetRequest::Each(&each), &mut blocks).is_ok();
                assert!(reset || pool.snapshot(0).expect("it exists") == before, "a refused reset changes nothing");
            }
            2 => {
                let count = input.int_in_range(0..=pool.layout().blocks() - 1)?;
                let actions = vec![0; spec.action_space.width()];
                assert!(pool.step(&actions, &mut zeroed(count)).is_err(), "{count} blocks are too few");
            }
            _ => playing::play(&mut pool, &mut blocks, input, 1)?,
        }
    }
    Ok(())
}
