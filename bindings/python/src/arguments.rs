//! Arguments from Python: actions, reset parameters, seeds, durations.

use std::time::Duration;

use endless_gym::batch::Frames;
use endless_gym::batch::PixelFormat;
use endless_gym::pool::{Autoreset, ResetOptions, ResetRequest, Seeding, UnknownAutoreset};
use endless_gym::service::timeout_from_seconds;
use numpy::{Element, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use serde_json::{Map, Value as Json};

use crate::errors;

/// Copies the integers of an array-like into `to`, in C order. The engine checks their number and range.
pub fn actions(given: &Bound<'_, PyAny>, to: &mut Vec<i32>) -> PyResult<()> {
    to.clear();
    if let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, i64>>() {
        append(&array, to, action)?;
    } else if let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, i32>>() {
        append(&array, to, Ok)?;
    } else if let Ok(list) = given.extract::<Vec<i64>>() {
        for number in list {
            to.push(action(number)?);
        }
    } else {
        let module = given.py().import("numpy")?;
        let array = module.call_method1("asarray", (given,))?;
        let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
        if !matches!(kind.as_str(), "i" | "u" | "b") {
            let shown = given.repr()?.to_string();
            let shown: String = shown.chars().take(80).collect();
            return Err(PyTypeError::new_err(format!("actions must be integers, got {shown}")));
        }
        let array = array.call_method1("astype", ("int64",))?.cast_into::<numpy::PyArrayDyn<i64>>()?;
        append(&array.readonly(), to, action)?;
    }
    Ok(())
}

/// Appends the numbers in C order, for any memory order of the array.
fn append<T: Element + Copy>(
    array: &PyReadonlyArrayDyn<'_, T>,
    to: &mut Vec<i32>,
    convert: impl Fn(T) -> PyResult<i32>,
) -> PyResult<()> {
    to.reserve(array.len());
    match array.as_array().as_slice() {
        Some(numbers) => numbers.iter().try_for_each(|number| convert(*number).map(|action| to.push(action))),
        None => array.as_array().iter().try_for_each(|number| convert(*number).map(|action| to.push(action))),
    }
}

/// An action as the engine's type.
pub fn action(given: i64) -> PyResult<i32> {
    let range = |_| PyValueError::new_err(format!("an action must be 0 to {}, got {given}", i32::MAX));
    i32::try_from(given).map_err(range)
}

/// The frames of an observation, from grayscale, channels first, row-major and number of stacked frames.
pub fn frames((grayscale, channels_first, row_major, stack): (bool, bool, bool, usize)) -> Frames {
    Frames { format: PixelFormat { grayscale, channels_first, row_major }, stack }
}

/// A timeout from a number of seconds.
pub fn timeout(seconds: f64) -> PyResult<Duration> {
    timeout_from_seconds(seconds).map_err(errors::service)
}

/// Reset parameters from the JSON text of an object.
pub fn options(text: &str) -> PyResult<Map<String, Json>> {
    serde_json::from_str(text).map_err(|error| PyValueError::new_err(format!("options must be JSON objects: {error}")))
}

/// The reset parameters of a pool, from the JSON text of one object for all environments, or of a list with one for each.
pub fn pool_options(text: &str) -> PyResult<ResetOptions> {
    if text.starts_with('[') {
        let each = serde_json::from_str(text);
        each.map(ResetOptions::Each)
            .map_err(|error| PyValueError::new_err(format!("options must be JSON objects: {error}")))
    } else {
        options(text).map(ResetOptions::Shared)
    }
}

/// The auto-reset mode of that name.
pub fn autoreset(name: &str) -> PyResult<Autoreset> {
    name.parse().map_err(|error: UnknownAutoreset| PyValueError::new_err(error.to_string()))
}

/// The source of the episodes' seeds.
pub fn seeding(seed: Option<u64>, range: Option<(u64, u64)>, list: Option<Vec<u64>>) -> Seeding {
    match (range, list) {
        (Some((start, end)), _) => Seeding::Range { start, end, seed },
        (None, Some(list)) => Seeding::List(list),
        (None, None) => Seeding::Continue { seed },
    }
}

/// The environments that a reset applies to, and their seeds.
#[derive(FromPyObject)]
pub enum Reset {
    /// All environments of the group; environment `i` of group `g` is seeded with this seed plus `g * num_envs + i`.
    Seed(u64),
    /// A reset mask and seeds, one of each per environment: 0 does not reset, 1 starts the next episode, 2 starts one with the seed.
    Each(Vec<u8>, Vec<u64>),
}

impl Reset {
    /// The request to a pool or an engine; `None` resets all environments without seeds.
    pub fn request(request: Option<&Reset>) -> ResetRequest<'_> {
        match request {
            None => ResetRequest::All,
            Some(Reset::Seed(seed)) => ResetRequest::Seed(*seed),
            Some(Reset::Each(reset, seed)) => ResetRequest::Each { reset, seed },
        }
    }
}
