//! Python extension modules with environments of Endless Gym, which the Python package `endless_gym` plays in process.
//!
//! A crate with environments of its own has a library of the type `cdylib` and depends on this crate without its default features,
//! one of which defines the package's own module. [`module!`] defines the crate's module, here `_native`:
//!
//! ```ignore
//! endless_gym_python::module!(_native, Registry::new().with::<TMaze>());
//! ```
//!
//! In Python, `endless_gym.register_envs(_native)` adds its ids to those of `endless_gym`. `endless new` writes such a crate.
//!
//! The module is a thin layer. The Python package around it defines spaces, infos and Gymnasium's interface.

mod arguments;
mod arrays;
mod buffers;
mod connection;
mod ends;
mod environments;
mod errors;
mod experts;
#[cfg(feature = "native")]
mod films;
#[cfg(feature = "native")]
mod kernels;
mod logs;
mod observer;
mod pool;
mod single;

use std::ffi::OsString;

use endless_gym::DEFAULT_ENV_ID;
#[cfg(feature = "native")]
use endless_gym::envs::UnknownEnvironment;
use endless_gym::pool::{Autoreset, Registry, RegistryError};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use environments::{ENVIRONMENTS, environments};
pub use pyo3;

/// The specifications of all environments, as JSON text.
#[pyfunction]
fn specs() -> PyResult<String> {
    let specs: Vec<_> = environments().specs().collect();
    serde_json::to_string(&specs).map_err(|error| PyRuntimeError::new_err(error.to_string()))
}

/// The specification of an environment, whose id may have arguments, as JSON text.
#[pyfunction]
fn spec(id: &str) -> PyResult<String> {
    let spec = environments().spec(id).map_err(|error| PyValueError::new_err(error.to_string()))?;
    serde_json::to_string(spec).map_err(|error| PyRuntimeError::new_err(error.to_string()))
}

/// The ids of `known` that an unknown one may stand for, such as `A-v0 or B-v0`; `None` if there are none.
#[cfg(feature = "native")]
#[pyfunction]
fn likely_ids(id: String, known: Vec<String>) -> Option<String> {
    UnknownEnvironment { id, known: known.join(", "), problem: None }.likely()
}

/// The maximum number of steps of an episode with reset parameters, an object of JSON; -1 without a limit, or if this module does not
/// have the id.
#[pyfunction]
fn max_episode_steps(id: &str, options: &str) -> PyResult<i64> {
    let Ok(spec) = environments().spec(id) else { return Ok(-1) };
    let limit = spec.max_episode_steps(&arguments::json(options)?);
    Ok(limit.map_err(|error| PyValueError::new_err(error.to_string()))?.unwrap_or(-1))
}

/// Runs the program `endless` and returns its exit status. `executable` is the command that starts it in a new process.
#[pyfunction]
fn endless(py: Python<'_>, arguments: Vec<OsString>, executable: Vec<OsString>) -> u8 {
    py.detach(|| endless_gym_cli::main(environments(), arguments, &executable))
}

#[cfg(feature = "native")]
#[pymodule(name = "_native")]
fn native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(films::write_film, module)?)?;
    module.add_function(wrap_pyfunction!(likely_ids, module)?)?;
    module.add_function(wrap_pyfunction!(kernels::gru_forward, module)?)?;
    module.add_function(wrap_pyfunction!(kernels::gru_backward, module)?)?;
    module.add_function(wrap_pyfunction!(kernels::lstm_forward, module)?)?;
    module.add_function(wrap_pyfunction!(kernels::lstm_backward, module)?)?;
    module.add_function(wrap_pyfunction!(kernels::mingru_forward, module)?)?;
    module.add_function(wrap_pyfunction!(kernels::mingru_backward, module)?)?;
    let agents = endless_gym_kernels::file::PAGE_AGENTS.map(|(name, _)| name);
    module.add("PAGE_AGENTS", PyTuple::new(module.py(), agents)?)?;
    populate(module, Ok(endless_gym::environments().clone()))
}

/// Defines the Python extension module `$name` with the environments of `$registry`, a `Result<Registry, RegistryError>`.
#[macro_export]
macro_rules! module {
    ($name:ident, $registry:expr) => {
        #[$crate::pyo3::pymodule]
        #[pyo3(crate = "::endless_gym_python::pyo3")]
        fn $name(module: &$crate::pyo3::Bound<'_, $crate::pyo3::types::PyModule>) -> $crate::pyo3::PyResult<()> {
            $crate::populate(module, $registry)
        }
    };
}

/// Adds what `endless_gym` uses to an extension module, with these environments; [`module!`] calls it. The first registry in a
/// shared object stays.
///
/// # Errors
///
/// `ValueError` with the message of the [`RegistryError`]; any error of Python.
pub fn populate(module: &Bound<'_, PyModule>, registry: Result<Registry, RegistryError>) -> PyResult<()> {
    let registry = registry.map_err(|error| PyValueError::new_err(error.to_string()))?;
    ENVIRONMENTS.get_or_init(|| registry);
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("AUTORESET_MODES", PyTuple::new(py, Autoreset::ALL.map(Autoreset::name))?)?;
    module.add("DEFAULT_ENV_ID", DEFAULT_ENV_ID)?;
    module.add("MAX_ENVS", endless_gym::pool::MAX_ENVS)?;
    module.add("MAX_GROUPS", endless_gym::service::MAX_GROUPS)?;
    module.add("MAX_THREADS", endless_gym::pool::MAX_THREADS)?;
    module.add("MAX_BATCHES_HELD", endless_gym::service::MAX_BATCHES_HELD)?;
    module.add_class::<experts::Experts>()?;
    module.add_class::<observer::Observer>()?;
    module.add_class::<pool::Pools>()?;
    module.add_class::<single::Single>()?;
    module.add_class::<connection::Connection>()?;
    module.add_function(wrap_pyfunction!(arguments::frame_shape, module)?)?;
    module.add_function(wrap_pyfunction!(buffers::note_export, module)?)?;
    module.add_function(wrap_pyfunction!(buffers::writable_view, module)?)?;
    module.add_function(wrap_pyfunction!(pool::check_pool_config, module)?)?;
    module.add_function(wrap_pyfunction!(pool::cores, module)?)?;
    module.add_function(wrap_pyfunction!(connection::running_engines, module)?)?;
    module.add_function(wrap_pyfunction!(connection::segment_prefix, module)?)?;
    module.add_function(wrap_pyfunction!(ends::ended_episodes, module)?)?;
    module.add_function(wrap_pyfunction!(endless, module)?)?;
    module.add_function(wrap_pyfunction!(max_episode_steps, module)?)?;
    module.add_function(wrap_pyfunction!(spec, module)?)?;
    module.add_function(wrap_pyfunction!(specs, module)?)
}
