//! Random reset parameters within the limits of the parameter tables.

use endless_gym::environments;
use endless_gym_core::envs::ParameterKind;
use endless_gym_core::pool::OptionMap;
use endless_gym_core::random::Generator;
use serde_json::Value as Json;

/// Some of an id's parameters with random values, usually not far from the defaults.
pub fn random(draws: &mut Generator, id: &str) -> OptionMap {
    let parameters = environments().spec(id).map(|spec| spec.parameters).unwrap_or_default();
    let mut options = OptionMap::new();
    for parameter in parameters {
        if draws.random() < 0.3 {
            options.insert(parameter.name.to_owned(), value(draws, parameter.kind));
        }
    }
    options
}

fn value(draws: &mut Generator, kind: ParameterKind) -> Json {
    match kind {
        ParameterKind::Choice { default, .. } => default.into(),
        ParameterKind::Bool { .. } => Json::from(draws.integers(0, 2) == 1),
        ParameterKind::Int { default, min, max } => {
            let near = (2 * default.abs() + 200).clamp(min, max);
            Json::from(draws.integers(min.max(-1), near + 1))
        }
        ParameterKind::Float { default, min, max } => {
            let reach = 2.0 * default.abs() + 0.1;
            Json::from(match draws.integers(0, 10) {
                0 => min,
                1 => draws.uniform(min, max),
                _ => draws.uniform((default - reach).max(min), (default + reach).min(max)),
            })
        }
        ParameterKind::IntList { default, min, max } => {
            let near = (2 * default.iter().max().unwrap_or(&min) + 1).clamp(min, max);
            let length = draws.integers(1, 4);
            Json::from((0..length).map(|_| draws.integers(min, near + 1)).collect::<Vec<_>>())
        }
    }
}
