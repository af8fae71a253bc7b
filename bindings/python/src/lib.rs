//! The native module `endless_gym._native`: the engine for Python.
//!
//! It is a thin layer; spaces, infos and Gymnasium's interface are made in Python, in the package around it.

mod arguments;
mod arrays;
mod connection;
mod dlpack;
mod ends;
mod errors;
mod pool;
mod single;

use std::ffi::OsString;

use endless_gym::envs;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

/// All environments' specifications, as JSON text.
#[pyfunction]
fn specs() -> PyResult<String> {
    let specs: Vec<_> = envs::specs().collect();
    serde_json::to_string(&specs).map_err(|error| PyRuntimeError::new_err(error.to_string()))
}

/// Runs the program `endless` and returns its exit status. `itself` is the command that starts it anew.
#[pyfunction]
fn endless(py: Python<'_>, arguments: Vec<OsString>, itself: Vec<OsString>) -> u8 {
    py.detach(|| endless_gym::cli::main(arguments, &itself))
}

#[pymodule(name = "_native")]
fn native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("EngineLost", py.get_type::<errors::EngineLost>())?;
    module.add("TooManyBatchesHeld", py.get_type::<errors::TooManyBatchesHeld>())?;
    module.add_class::<pool::Pool>()?;
    module.add_class::<pool::Threads>()?;
    module.add_class::<single::Single>()?;
    module.add_class::<connection::Connection>()?;
    module.add_function(wrap_pyfunction!(connection::running_engines, module)?)?;
    module.add_function(wrap_pyfunction!(dlpack::dlpack, module)?)?;
    module.add_function(wrap_pyfunction!(ends::ended_episodes, module)?)?;
    module.add_function(wrap_pyfunction!(endless, module)?)?;
    module.add_function(wrap_pyfunction!(specs, module)?)
}
