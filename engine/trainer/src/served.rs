//! The specification of the environments that an engine serves, which this program need not have.

use std::num::NonZeroU16;

use endless_gym_core::batch::{BatchSection, Section};
use endless_gym_core::envs::{Column, EnvSpec, InfoColumn, Learnt, ObservationSpace};
use endless_gym_service::ServiceSpecification;
use serde::Deserialize;

use crate::error::Error;

/// What a trainer needs of [`ServiceSpecification::environment`].
#[derive(Deserialize)]
struct Described {
    features: Vec<Feature>,
    observation_space: Option<Space>,
    learnt: Option<Reached>,
}

#[derive(Deserialize)]
struct Feature {
    name: String,
}

#[derive(Deserialize)]
struct Reached {
    name: String,
    mean: f64,
}

/// An [`ObservationSpace`], where a bound of null is infinite.
#[derive(Deserialize)]
enum Space {
    Discrete(NonZeroU16),
    MultiDiscrete(Vec<NonZeroU16>),
    Box { low: Vec<Option<f32>>, high: Vec<Option<f32>> },
    Tuple(Vec<Space>),
}

/// The parts of the specification that a trainer needs. They are kept until the program ends, as those of its own
/// environments are. Fails with [`Error::Json`] or [`Error::Settings`] if the engine does not describe its
/// environments.
pub(crate) fn spec(served: &ServiceSpecification) -> Result<EnvSpec, Error> {
    let source = format!("the specification of engine `{}`", served.service);
    let described = Described::deserialize(&served.environment).map_err(Error::json(&source))?;
    let observation_space = described.observation_space.map(Space::kept);
    let (width, features) = (observation_space.as_ref().map(ObservationSpace::width), described.features.len());
    if width.is_some_and(|width| width != features) {
        return Err(Error::Settings(format!("{source} must have an observation space of its {features} features")));
    }
    let column = |feature: Feature| Column { name: text(feature.name), description: "" };
    let info = |name: &String| InfoColumn { name: text(name.clone()), is_integer: false, description: "" };
    Ok(EnvSpec {
        vector_observation: served.batch.section(BatchSection::VectorObservation).map_or(0, Section::width),
        info: list(served.info.iter().map(info)),
        features: list(described.features.into_iter().map(column)),
        observation_space,
        learnt: described.learnt.map(|reached| Learnt { name: text(reached.name), mean: reached.mean }),
        ..EnvSpec::new(text(served.id.clone()), "", served.action_space.clone())
    })
}

impl Space {
    fn kept(self) -> ObservationSpace {
        let bounds = |bounds: Vec<Option<f32>>, none: f32| list(bounds.into_iter().map(|bound| bound.unwrap_or(none)));
        match self {
            Space::Discrete(choices) => ObservationSpace::Discrete(choices.get().into()),
            Space::MultiDiscrete(numbers) => {
                ObservationSpace::MultiDiscrete(list(numbers.into_iter().map(|choices| choices.get().into())))
            }
            Space::Box { low, high } => {
                ObservationSpace::Box { low: bounds(low, f32::NEG_INFINITY), high: bounds(high, f32::INFINITY) }
            }
            Space::Tuple(parts) => ObservationSpace::Tuple(list(parts.into_iter().map(Space::kept))),
        }
    }
}

fn text(text: String) -> &'static str {
    Box::leak(text.into_boxed_str())
}

fn list<T>(items: impl Iterator<Item = T>) -> &'static [T] {
    Box::leak(items.collect())
}
