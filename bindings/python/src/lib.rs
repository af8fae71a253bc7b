//! The native module `endless_gym._native`: pools, engines and their batches for Python.
//!
//! It is a thin layer. The Python package around it defines spaces, infos and Gymnasium's interface.

mod arguments;
mod arrays;
mod buffers;
mod connection;
mod ends;
mod errors;
mod experts;
mod logs;
mod observer;
mod pool;
mod single;

use std::ffi::OsString;

use endless_gym::pool::Autoreset;
use endless_gym::{DEFAULT_ENV_ID, environments};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// The specifications of all environments, as JSON text.
#[pyfunction]
fn specs() -> PyResult<String> {
    let specs: Vec<_> = environments().specs().collect();
    serde_json::to_string(&specs).map_err(|error| PyRuntimeError::new_err(error.to_string()))
}

/// Runs the program `endless` and returns its exit status. `executable` is the command that starts it in a new process.
#[pyfunction]
fn endless(py: Python<'_>, arguments: Vec<OsString>, executable: Vec<OsString>) -> u8 {
    py.detach(|| endless_gym_cli::main(environments(), arguments, &executable))
}

#[pymodule(name = "_native")]
fn native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("AUTORESET_MODES", PyTuple::new(py, Autoreset::ALL.map(Autoreset::name))?)?;
    module.add("DEFAULT_ENV_ID", DEFAULT_ENV_ID)?;
    module.add("MAX_ENVS", endless_gym::pool::MAX_ENVS)?;
    module.add("MAX_GROUPS", endless_gym::service::MAX_GROUPS)?;
    module.add("MAX_THREADS", endless_gym::pool::MAX_THREADS)?;
    module.add("MAX_BATCHES_HELD", endless_gym::service::MAX_BATCHES_HELD)?;
    module.add("EngineLost", py.get_type::<errors::EngineLost>())?;
    module.add("TooManyBatchesHeld", py.get_type::<errors::TooManyBatchesHeld>())?;
    module.add_class::<experts::Experts>()?;
    module.add_class::<observer::Observer>()?;
    module.add_class::<pool::Pools>()?;
    module.add_class::<single::Single>()?;
    module.add_class::<connection::Connection>()?;
    module.add_function(wrap_pyfunction!(arguments::frame_shape, module)?)?;
    module.add_function(wrap_pyfunction!(buffers::note_export, module)?)?;
    module.add_function(wrap_pyfunction!(buffers::writable_view, module)?)?;
    module.add_function(wrap_pyfunction!(pool::check_pool_config, module)?)?;
    module.add_function(wrap_pyfunction!(connection::running_engines, module)?)?;
    module.add_function(wrap_pyfunction!(connection::segment_prefix, module)?)?;
    module.add_function(wrap_pyfunction!(ends::ended_episodes, module)?)?;
    module.add_function(wrap_pyfunction!(endless, module)?)?;
    module.add_function(wrap_pyfunction!(specs, module)?)
}
