//! Environments in another process, through shared memory.

use std::time::{Duration, Instant};

use endless_gym::batch::Block;
use endless_gym::service::{
    BatchLease, ConnectConfig, Namespace, ServiceError, Trainer, running_engines as list_engines, timeout_from_seconds,
};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyTuple};

use crate::arguments::{self, Reset};
use crate::arrays::{self, Owner};
use crate::errors;

/// How long Python's signal handlers may have to wait, Ctrl-C's among them.
const SIGNALS_EVERY: Duration = Duration::from_millis(50);

/// A batch in shared memory. The engine gets it back once the arrays that look into it are all gone.
#[pyclass(frozen)]
struct Lent(BatchLease);

impl Owner for Lent {
    fn blocks(&self) -> &[Block] {
        self.0.blocks()
    }
}

/// The trainer's side of an engine.
#[pyclass(module = "endless_gym._native")]
pub struct Connection {
    trainer: Trainer,
    actions: Vec<i32>,
    process: u32,
}

#[pymethods]
impl Connection {
    /// Connects to the engine of that name, waiting up to `timeout` seconds for it to appear.
    #[new]
    fn new(py: Python<'_>, service: &str, timeout: f64) -> PyResult<Self> {
        let (timeout, start) = (seconds(timeout)?, Instant::now());
        loop {
            let left = timeout.saturating_sub(start.elapsed());
            let config = ConnectConfig { timeout: left.min(SIGNALS_EVERY), ..ConnectConfig::new(service) };
            match py.detach(|| Trainer::connect(&config)) {
                Ok(trainer) => return Ok(Connection { trainer, actions: Vec::new(), process: std::process::id() }),
                Err(ServiceError::UnknownEngine { .. }) if left > SIGNALS_EVERY => py.check_signals()?,
                Err(error) => return Err(errors::service(error)),
            }
        }
    }

    /// What the engine serves, as JSON text.
    fn specification(&self) -> PyResult<String> {
        let text = serde_json::to_string(self.trainer.specification());
        text.map_err(|error| PyRuntimeError::new_err(error.to_string()))
    }

    #[pyo3(signature = (group, request=None, options=None))]
    fn reset(&mut self, group: usize, request: Option<Reset>, options: Option<&str>) -> PyResult<()> {
        self.check_process()?;
        let options = options.map(arguments::options).transpose()?;
        let request = Reset::request(request.as_ref());
        self.trainer.reset_with(group, request, options.as_ref()).map_err(errors::service)
    }

    fn send(&mut self, group: usize, actions: &Bound<'_, PyAny>) -> PyResult<()> {
        self.check_process()?;
        arguments::actions(actions, &mut self.actions)?;
        self.trainer.send(group, &self.actions).map_err(errors::service)
    }

    /// The group that answered, and its arrays. `group` is the one to wait for; `None` takes whichever is first.
    fn receive<'py>(
        &mut self,
        py: Python<'py>,
        group: Option<usize>,
        timeout: f64,
    ) -> PyResult<(usize, Bound<'py, PyTuple>)> {
        let received = self.wait(py, timeout, |trainer, slice| match group {
            Some(group) => trainer.receive(group, slice),
            None => trainer.receive_any(slice),
        })?;
        let group = received.group();
        let lent = Bound::new(py, Lent(received))?;
        let arrays = arrays::sections(&lent, lent.get().0.batch().layout())?;
        Ok((group, arrays))
    }

    /// The state of one environment of a group.
    fn snapshot<'py>(
        &mut self,
        py: Python<'py>,
        group: usize,
        env: usize,
        timeout: f64,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.wait(py, timeout, |trainer, slice| trainer.snapshot(group, env, slice))?;
        Ok(PyBytes::new(py, &bytes))
    }

    /// Puts one environment of a group into the state of a snapshot.
    fn restore(&mut self, py: Python<'_>, group: usize, env: usize, snapshot: &[u8], timeout: f64) -> PyResult<()> {
        self.wait(py, timeout, |trainer, slice| trainer.restore(group, env, snapshot, slice))
    }

    /// Goes on with an engine of the same name that was started in place of a lost one.
    fn reconnect(&mut self, py: Python<'_>, timeout: f64) -> PyResult<()> {
        self.check_process()?;
        let timeout = seconds(timeout)?;
        py.detach(|| self.trainer.reconnect(timeout)).map_err(errors::service)
    }
}

impl Connection {
    /// Waits for an answer, without the interpreter, and looks for signals meanwhile.
    fn wait<T: Send>(
        &mut self,
        py: Python<'_>,
        timeout: f64,
        mut answer: impl FnMut(&mut Trainer, Duration) -> Result<T, ServiceError> + Send,
    ) -> PyResult<T> {
        self.check_process()?;
        let (timeout, start) = (seconds(timeout)?, Instant::now());
        let trainer = &mut self.trainer;
        loop {
            let slice = timeout.saturating_sub(start.elapsed()).min(SIGNALS_EVERY);
            match py.detach(|| answer(trainer, slice)) {
                Ok(answer) => return Ok(answer),
                Err(ServiceError::TimedOut { service, .. }) => {
                    py.check_signals()?;
                    if start.elapsed() >= timeout {
                        return Err(errors::service(ServiceError::TimedOut { service, waited: timeout }));
                    }
                }
                Err(error) => return Err(errors::service(error)),
            }
        }
    }

    fn check_process(&self) -> PyResult<()> {
        if self.process == std::process::id() {
            return Ok(());
        }
        Err(PyRuntimeError::new_err(
            "this connection belongs to the process that this one was forked from; connect in the child, to another engine",
        ))
    }
}

fn seconds(given: f64) -> PyResult<Duration> {
    timeout_from_seconds(given).map_err(errors::service)
}

/// Names of the engines that this user's processes can connect to.
#[pyfunction]
pub fn running_engines(py: Python<'_>) -> PyResult<Vec<String>> {
    py.detach(|| list_engines(&Namespace::default())).map_err(errors::service)
}
