//! Batches of an engine that another process trains with.

use std::time::Duration;

use endless_gym::service::{ConnectConfig, Observers};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::connection::{Lease, wait, wait_for_engine};
use crate::{arguments, arrays, logs};

/// A batch: the group, its step, the batches missed before it, and its arrays.
type Watched<'py> = (usize, u64, u64, Bound<'py, PyTuple>);

/// An observer of one group of an engine, or of all for `None`.
#[pyclass(module = "endless_gym._native")]
pub struct Observer {
    observers: Observers,
    process: u32,
}

#[pymethods]
impl Observer {
    /// Connects to the engine named `service`, and waits up to `timeout` seconds for it to start.
    #[new]
    #[pyo3(signature = (service, group, timeout))]
    fn new(py: Python<'_>, service: &str, group: Option<usize>, timeout: f64) -> PyResult<Self> {
        logs::start(py)?;
        let config = ConnectConfig::new(service);
        let connect = |slice| Observers::connect(&config.clone().timeout(slice), group);
        let observers = wait_for_engine(py, timeout, connect)?;
        logs::flush(py)?;
        Ok(Observer { observers, process: std::process::id() })
    }

    /// The engine's specification, as JSON text.
    fn specification(&self) -> PyResult<String> {
        let text = serde_json::to_string(self.observers.specification());
        text.map_err(|error| PyRuntimeError::new_err(error.to_string()))
    }

    /// Waits for the next batch, up to `timeout` seconds, or without a limit for `None`.
    #[pyo3(signature = (timeout))]
    fn next<'py>(&mut self, py: Python<'py>, timeout: Option<f64>) -> PyResult<Watched<'py>> {
        if self.process != std::process::id() {
            return Err(PyRuntimeError::new_err(
                "this observer belongs to the process that this process was forked from; create a new observer in the child",
            ));
        }
        let timeout = timeout.map_or(Ok(Duration::MAX), arguments::timeout)?;
        let observers = &mut self.observers;
        let observed = wait(py, timeout, |slice| observers.next(slice))?;
        let (group, step) = (observed.lease.group(), observed.lease.step());
        let lease = Bound::new(py, Lease(observed.lease))?;
        let arrays = arrays::sections(&lease, lease.get().0.batch().layout())?;
        Ok((group, step, observed.missed, arrays))
    }
}
