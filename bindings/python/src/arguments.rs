//! What Python hands over: actions, options, seeds.

use endless_gym::batch::Frames;
use endless_gym::pool::{Autoreset, ResetOptions, ResetRequest, Seeding, UnknownAutoreset};
use endless_gym::raster::PixelFormat;
use numpy::{Element, PyArrayMethods, PyReadonlyArrayDyn};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use serde_json::{Map, Value as Json};

/// Integers of any array-like, row after row. Whether they are in range is the engine's to check.
pub fn actions(given: &Bound<'_, PyAny>, to: &mut Vec<i32>) -> PyResult<()> {
    to.clear();
    if let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, i64>>() {
        append(&array, to, clamp);
    } else if let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, i32>>() {
        append(&array, to, |action| action);
    } else if let Ok(list) = given.extract::<Vec<i64>>() {
        to.extend(list.into_iter().map(clamp));
    } else {
        let module = given.py().import("numpy")?;
        let array = module.call_method1("asarray", (given,))?;
        let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
        if !matches!(kind.as_str(), "i" | "u" | "b") {
            let shown = given.repr()?.to_string();
            let shown: String = shown.chars().take(80).collect();
            return Err(PyTypeError::new_err(format!("actions are integers; {shown} given")));
        }
        let array = array.call_method1("astype", ("int64",))?.cast_into::<numpy::PyArrayDyn<i64>>()?;
        append(&array.readonly(), to, clamp);
    }
    Ok(())
}

/// Appends the numbers in the order of the array's indices, whatever their order in memory.
fn append<T: Element + Copy>(array: &PyReadonlyArrayDyn<'_, T>, to: &mut Vec<i32>, convert: impl Fn(T) -> i32) {
    match array.as_array().as_slice() {
        Some(numbers) => to.extend(numbers.iter().map(|number| convert(*number))),
        None => to.extend(array.as_array().iter().map(|number| convert(*number))),
    }
}

/// What does not fit an i32 is as far out of range as what is just outside.
fn clamp(action: i64) -> i32 {
    i32::try_from(action).unwrap_or(-1)
}

/// Grey, channels first, row-major, number of frames.
pub fn frames((grayscale, channels_first, row_major, stack): (bool, bool, bool, usize)) -> Frames {
    Frames { format: PixelFormat { grayscale, channels_first, row_major }, stack }
}

/// Reset parameters from the JSON text of an object.
pub fn options(text: &str) -> PyResult<Map<String, Json>> {
    serde_json::from_str(text).map_err(|error| PyValueError::new_err(format!("options cannot be read: {error}")))
}

/// The reset parameters of a pool: the JSON text of an object for all environments, or of a list of them.
pub fn pool_options(text: &str) -> PyResult<ResetOptions> {
    if text.starts_with('[') {
        let each = serde_json::from_str(text);
        each.map(ResetOptions::Each).map_err(|error| PyValueError::new_err(format!("options cannot be read: {error}")))
    } else {
        options(text).map(ResetOptions::Shared)
    }
}

/// An auto-reset mode by its name.
pub fn autoreset(name: &str) -> PyResult<Autoreset> {
    name.parse().map_err(|error: UnknownAutoreset| PyValueError::new_err(error.to_string()))
}

/// Where the seeds of episodes come from.
pub fn seeding(seed: Option<u64>, range: Option<(u64, u64)>, list: Option<Vec<u64>>) -> Seeding {
    match (range, list) {
        (Some((start, end)), _) => Seeding::Range { start, end, seed },
        (None, Some(list)) => Seeding::List(list),
        (None, None) => Seeding::Continue { seed },
    }
}

/// Which environments a reset is for.
#[derive(FromPyObject)]
pub enum Reset {
    /// All, environment `i` with this seed plus `i`.
    Seed(u64),
    /// For each environment 0 (leave alone), 1 (start the next episode) or 2 (start one with the seed), and the seeds.
    Each(Vec<u8>, Vec<u64>),
}

impl Reset {
    /// The engine's form of it.
    pub fn request(request: Option<&Reset>) -> ResetRequest<'_> {
        match request {
            None => ResetRequest::All,
            Some(Reset::Seed(seed)) => ResetRequest::Seed(*seed),
            Some(Reset::Each(reset, seed)) => ResetRequest::Each { reset, seed },
        }
    }
}
