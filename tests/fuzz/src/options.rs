//! Reset options: JSON text, or parameter names with any values.

use arbitrary::{Result, Unstructured};
use endless_gym_core::envs::{EnvSpec, ParameterKind};
use endless_gym_core::pool::{Autoreset, OptionMap, ResetRequest};
use serde_json::Value as Json;

use crate::playing;

const STEPS: usize = 60;

/// The target.
pub fn target(input: &mut Unstructured<'_>) -> Result<()> {
    let spec = playing::spec(input)?;
    let autoreset = *input.choose(&[Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled])?;
    let later: bool = input.arbitrary()?;
    let options = if input.arbitrary()? {
        match serde_json::from_slice::<OptionMap>(input.bytes(input.len())?) {
            Ok(options) => options,
            Err(_) => return Ok(()),
        }
    } else {
        structured(spec, input)?
    };
    let given = if later { OptionMap::new() } else { options.clone() };
    let Ok(mut pool) = playing::pool(spec, given, autoreset) else { return Ok(()) };
    let mut blocks = playing::reset(&mut pool);
    if later && pool.reset_with(ResetRequest::Seed(1), Some(&options), &mut blocks).is_err() {
        pool.step(&vec![0; spec.action_space.width()], &mut blocks).expect("a refused reset changes nothing");
        return Ok(());
    }
    playing::play(&mut pool, &mut blocks, input, STEPS)?;
    pool.reset(ResetRequest::All, &mut blocks).expect("a pool can be reset");
    Ok(())
}

/// Some of the parameters, mostly with values within or just outside the limits.
fn structured(spec: &EnvSpec, input: &mut Unstructured<'_>) -> Result<OptionMap> {
    let mut options = OptionMap::new();
    for parameter in spec.parameters {
        if input.ratio(1, 3)? {
            options.insert(parameter.name.to_owned(), value(&parameter.kind, input)?);
        }
    }
    Ok(options)
}

fn value(kind: &ParameterKind, input: &mut Unstructured<'_>) -> Result<Json> {
    Ok(match (input.int_in_range(0..=9_u8)?, kind) {
        (0, _) => Json::from(input.arbitrary::<i64>()?),
        (1, _) => Json::from(input.arbitrary::<f64>()?),
        (2, _) => input.arbitrary::<Vec<i8>>()?.into(),
        (_, ParameterKind::Bool { .. }) => Json::from(input.arbitrary::<bool>()?),
        (_, ParameterKind::Int { min, max, .. }) => integer(*min, *max, input)?.into(),
        (_, ParameterKind::Float { min, max, default }) => {
            let share = f64::from(input.arbitrary::<u16>()?) / f64::from(u16::MAX);
            let near = 2.0 * default.abs() + 1.0;
            let (from, to) = if input.arbitrary()? { (*min, *max) } else { (min.max(-near), max.min(near)) };
            Json::from(from + share * (to - from))
        }
        (_, ParameterKind::Choice { choices, .. }) => input.choose(choices)?.to_owned().into(),
        (_, ParameterKind::IntList { min, max, .. }) => {
            let length = input.int_in_range(0..=4_u8)?;
            Json::from((0..length).map(|_| integer(*min, *max, input)).collect::<Result<Vec<_>>>()?)
        }
    })
}

/// An integer within the limits, just beyond them, or near the minimum.
fn integer(min: i64, max: i64, input: &mut Unstructured<'_>) -> Result<i64> {
    let small = i64::from(input.arbitrary::<u8>()?);
    Ok(match input.int_in_range(0..=7_u8)? {
        0 => min,
        1 => max,
        2 => min.saturating_sub(1),
        3 => max.saturating_add(1),
        4 => input.int_in_range(min..=max)?,
        _ => min.saturating_add(small).min(max),
    })
}
