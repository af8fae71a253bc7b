//! Arguments from Python: actions, reset parameters, seeds, durations.

use std::time::Duration;

use endless_gym::batch::Frames;
use endless_gym::envs::ActionSpace;
use endless_gym::pool::{EnvReset, ResetRequest, RunningEpisode};
use endless_gym::raster::FrameShape;
use endless_gym::service::timeout_from_seconds;
use numpy::{
    Element, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArray, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyException, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyByteArray, PySequence};
use serde::de::DeserializeOwned;
use serde_json::Value as Json;

use crate::errors;

/// The required shape of actions: that of the action space, for a group with the environments as the first axis.
pub struct ActionShape {
    shape: Vec<usize>,
    meaning: String,
    /// Whether the numbers are float32, whose bits the engine receives.
    is_box: bool,
}

impl ActionShape {
    /// The shape for one environment, or for a group of `num_envs`.
    pub fn new(space: &ActionSpace, num_envs: Option<usize>) -> Self {
        let (width, one, is_box) = match space {
            ActionSpace::Discrete(_) => (None, "an integer", false),
            ActionSpace::MultiDiscrete(branches) => (Some(branches.len()), "an integer for each branch", false),
            ActionSpace::Box { low, .. } => (Some(low.len()), "a number for each dimension", true),
        };
        let of = match (num_envs, width) {
            (None, _) => "",
            (Some(_), None) => " for each environment",
            (Some(_), Some(_)) => " of each environment",
        };
        ActionShape { shape: num_envs.into_iter().chain(width).collect(), meaning: format!("{one}{of}"), is_box }
    }

    /// Copies the numbers of an array, or of a list of the same shape, into `to`, in C order. The engine checks their range.
    pub fn copy(&self, given: &Bound<'_, PyAny>, to: &mut Vec<i32>) -> PyResult<()> {
        to.clear();
        if self.is_box {
            return self.copy_floats(given, to);
        }
        if let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, i64>>() {
            self.check(array.shape())?;
            return append(&array, to, action);
        }
        if let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, i32>>() {
            self.check(array.shape())?;
            return append(&array, to, Ok);
        }
        let no_integers = || {
            let shown: String = given.repr()?.to_string().chars().take(80).collect();
            Ok::<_, PyErr>(PyTypeError::new_err(format!("actions must be integers, got {shown}")))
        };
        // numpy would treat it as a list of small integers.
        if given.is_instance_of::<PyByteArray>() {
            return Err(no_integers()?);
        }
        let array = given.py().import("numpy")?.call_method1("asarray", (given,));
        let array = array.or_else(|refusal| Err(self.refused(given, refusal)?))?.cast_into::<PyUntypedArray>()?;
        // The dtype of an empty list is float64.
        if array.is_empty() {
            self.check(array.shape())?;
        }
        if !matches!(array.dtype().kind(), b'i' | b'u') {
            return Err(no_integers()?);
        }
        self.check(array.shape())?;
        let array = array.call_method1("astype", ("int64",))?.cast_into::<PyArrayDyn<i64>>()?;
        append(&array.readonly(), to, action)
    }

    /// Copies the bits of numbers, as float32.
    fn copy_floats(&self, given: &Bound<'_, PyAny>, to: &mut Vec<i32>) -> PyResult<()> {
        let bits = |number: f32| Ok(number.to_bits().cast_signed());
        if let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, f32>>() {
            self.check(array.shape())?;
            return append(&array, to, bits);
        }
        let array = given.py().import("numpy")?.call_method1("asarray", (given, "float32"));
        let array = array.or_else(|refusal| Err(self.refused(given, refusal)?))?.cast_into::<PyArrayDyn<f32>>()?;
        self.check(array.shape())?;
        append(&array.readonly(), to, bits)
    }

    /// The error for actions that numpy refuses; its cause is numpy's.
    fn refused(&self, given: &Bound<'_, PyAny>, refusal: PyErr) -> PyResult<PyErr> {
        let py = given.py();
        if !refusal.is_instance_of::<PyException>(py) {
            return Ok(refusal); // Ctrl-C, for example.
        }
        let error = if refusal.is_instance_of::<PyValueError>(py) && given.is_instance_of::<PySequence>() {
            // Lists whose items have different lengths.
            self.error("a list of items with different shapes")
        } else {
            PyTypeError::new_err(format!(
                "actions must be numbers that numpy can read, got {}: {}; pass `actions.detach().cpu()` for a PyTorch tensor",
                given.get_type().name()?,
                refusal.value(py)
            ))
        };
        error.set_cause(py, Some(refusal));
        Ok(error)
    }

    fn check(&self, given: &[usize]) -> PyResult<()> {
        if given == self.shape { Ok(()) } else { Err(self.error(&format!("the shape {}", shown(given)))) }
    }

    fn error(&self, given: &str) -> PyErr {
        let (shape, meaning) = (shown(&self.shape), &self.meaning);
        PyValueError::new_err(format!("actions must have the shape {shape}, {meaning}, got {given}"))
    }
}

/// A shape as Python shows it.
fn shown(shape: &[usize]) -> String {
    match shape {
        [length] => format!("({length},)"),
        shape => format!("({})", shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")),
    }
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

/// The shape of an observation, from the JSON text of its frames' format and a frame's width, height and channels.
#[pyfunction]
pub fn frame_shape(frames: &str, size: (usize, usize, usize)) -> PyResult<Vec<usize>> {
    let (width, height, channels) = size;
    Ok(json::<Frames>(frames)?.shape(FrameShape { width, height, channels }))
}

/// A configuration from JSON text that the package has written.
pub fn json<T: DeserializeOwned>(text: &str) -> PyResult<T> {
    serde_json::from_str(text).map_err(|error| PyValueError::new_err(format!("invalid configuration: {error}")))
}

/// A timeout from a number of seconds.
pub fn timeout(seconds: f64) -> PyResult<Duration> {
    timeout_from_seconds(seconds).map_err(errors::service)
}

/// Reset parameters from the JSON text of an object, or those of next episodes from a list of objects with `options` and `envs`.
pub fn options<T: DeserializeOwned>(text: &str) -> PyResult<T> {
    serde_json::from_str(text).map_err(|error| PyValueError::new_err(format!("options must be JSON objects: {error}")))
}

/// A running episode: the environment's number, the seed, the JSON text of the options, and whether the last step ended it.
pub type Episode = (usize, Option<u64>, String, bool);

/// A running episode for Python.
pub fn episode(RunningEpisode { env, seed, options, ended }: RunningEpisode) -> Episode {
    (env, seed, Json::from(options).to_string(), ended)
}

/// The environments that a reset applies to, and their seeds.
#[derive(FromPyObject)]
pub enum Reset {
    /// All environments of the group; environment `i` of group `g` is seeded with this seed plus `g * num_envs + i`.
    Seed(u64),
    /// One item for each environment, from a reset mask and seeds: 0 does not reset, 1 starts the next episode, 2 starts one with the
    /// seed.
    Each(#[pyo3(from_py_with = each)] Vec<EnvReset>),
}

fn each(given: &Bound<'_, PyAny>) -> PyResult<Vec<EnvReset>> {
    let (reset, seed): (Vec<u8>, Vec<u64>) = given.extract()?;
    let item = |(reset, seed)| match reset {
        0 => EnvReset::Keep,
        1 => EnvReset::Next,
        _ => EnvReset::Seed(seed),
    };
    Ok(reset.into_iter().zip(seed).map(item).collect())
}

impl Reset {
    /// The request to a pool or an engine; `None` resets all environments without seeds.
    pub fn request(request: Option<&Reset>) -> ResetRequest<'_> {
        match request {
            None => ResetRequest::All,
            Some(Reset::Seed(seed)) => ResetRequest::Seed(*seed),
            Some(Reset::Each(each)) => ResetRequest::Each(each),
        }
    }
}
