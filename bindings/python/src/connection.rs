//! Environments in another process, through shared memory.
//!
//! [`Connection`] has the same methods as the groups in this process ([`Pools`](crate::pool::Pools)).

use std::time::{Duration, Instant};

use endless_gym::batch::Block;
use endless_gym::pool::{NextOptions, OptionMap};
use endless_gym::service::{
    self, BatchLease, ConnectConfig, GroupReconnection, LastRequest, Namespace, ServiceError, Trainer,
};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyTuple};

use crate::arguments::{self, ActionShape, Episode, Reset};
use crate::arrays::{self, Owner};
use crate::{errors, logs};

/// Longest time between two runs of Python's signal handlers, including that of Ctrl-C.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// The steps of a group in the current engine and in the lost one, and what became of the last request.
type GroupFound = (Option<u64>, Option<u64>, &'static str);

/// The owner of the arrays of one batch in shared memory. The engine writes to the memory again once all arrays are gone.
#[pyclass(frozen)]
pub struct Lease(pub BatchLease);

// SAFETY: the engine does not write to a batch that a trainer holds, and its memory stays mapped for as long.
unsafe impl Owner for Lease {
    fn memory(&self) -> (*const Block, usize) {
        let blocks = self.0.blocks();
        (blocks.as_ptr(), blocks.len())
    }
}

/// The trainer of an engine in another process.
#[pyclass(module = "endless_gym._native")]
pub struct Connection {
    /// `None` after `close`.
    trainer: Option<Trainer>,
    groups: usize,
    /// Seconds to wait for each answer.
    timeout: f64,
    action_shape: ActionShape,
    actions: Vec<i32>,
    process: u32,
}

#[pymethods]
impl Connection {
    /// Connects to the engine named `service`. Waits up to `timeout` seconds for it to start, and for each of its answers.
    #[new]
    fn new(py: Python<'_>, service: &str, timeout: f64) -> PyResult<Self> {
        logs::start(py)?;
        let config = ConnectConfig::new(service);
        let connect = |slice| Trainer::connect(&ConnectConfig { timeout: slice, ..config.clone() });
        let trainer = wait_for_engine(py, timeout, connect)?;
        logs::flush(py)?;
        let specification = trainer.specification();
        let action_shape = ActionShape::group(&specification.action_space, specification.num_envs);
        let groups = specification.groups;
        let (actions, process) = (Vec::new(), std::process::id());
        Ok(Connection { trainer: Some(trainer), groups, timeout, action_shape, actions, process })
    }

    /// Number of groups.
    #[getter]
    fn groups(&self) -> usize {
        self.groups
    }

    /// The engine's specification, as JSON text.
    fn specification(&mut self) -> PyResult<String> {
        let text = serde_json::to_string(self.trainer()?.specification());
        text.map_err(|error| PyRuntimeError::new_err(error.to_string()))
    }

    /// Resets a group.
    #[pyo3(signature = (group, request=None, options=None))]
    fn reset<'py>(
        &mut self,
        py: Python<'py>,
        group: usize,
        request: Option<Reset>,
        options: Option<&str>,
    ) -> PyResult<Bound<'py, PyTuple>> {
        self.send_reset(group, request, options)?;
        Ok(self.receive(py, Some(group))?.1)
    }

    /// Steps group 0.
    fn step<'py>(&mut self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyTuple>> {
        self.send(actions, 0)?;
        Ok(self.receive(py, Some(0))?.1)
    }

    /// Requests a step, whose result `receive` returns.
    fn send(&mut self, actions: &Bound<'_, PyAny>, group: usize) -> PyResult<()> {
        self.trainer()?;
        self.action_shape.copy(actions, &mut self.actions)?;
        let trainer = self.trainer.as_mut().ok_or_else(errors::closed)?;
        trainer.send(group, &self.actions).map_err(errors::service)
    }

    /// Requests a reset, whose result `receive` returns.
    #[pyo3(signature = (group, request=None, options=None))]
    fn send_reset(&mut self, group: usize, request: Option<Reset>, options: Option<&str>) -> PyResult<()> {
        let options: Option<OptionMap> = options.map(arguments::options).transpose()?;
        let request = Reset::request(request.as_ref());
        self.trainer()?.reset_with(group, request, options.as_ref()).map_err(errors::service)
    }

    /// Waits for the answer of `group`, or of any group for `None`. Returns the group's number and arrays.
    fn receive<'py>(&mut self, py: Python<'py>, group: Option<usize>) -> PyResult<(usize, Bound<'py, PyTuple>)> {
        let received = self.wait(py, |trainer, slice| match group {
            Some(group) => trainer.receive(group, slice),
            None => trainer.receive_any(slice),
        })?;
        let group = received.group();
        let lease = Bound::new(py, Lease(received))?;
        let arrays = arrays::sections(&lease, lease.get().0.batch().layout())?;
        Ok((group, arrays))
    }

    /// The state of one environment of a group.
    fn snapshot<'py>(&mut self, py: Python<'py>, group: usize, env: usize) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.wait(py, |trainer, slice| trainer.snapshot(group, env, slice))?;
        Ok(PyBytes::new(py, &bytes))
    }

    /// Sets the state of one environment of a group to that of a snapshot.
    fn restore(&mut self, py: Python<'_>, group: usize, env: usize, snapshot: &[u8]) -> PyResult<()> {
        self.wait(py, |trainer, slice| trainer.restore(group, env, snapshot, slice))
    }

    /// Sets the options of next episodes; see `arguments::options`.
    fn set_options(&mut self, py: Python<'_>, group: usize, sets: &str) -> PyResult<()> {
        let sets: Vec<NextOptions> = arguments::options(sets)?;
        self.wait(py, |trainer, slice| trainer.set_options(group, &sets, slice))
    }

    /// Seeds and options of the running episodes.
    fn running_episodes(&mut self, py: Python<'_>, group: usize, envs: Vec<usize>) -> PyResult<Vec<Episode>> {
        let episodes = self.wait(py, |trainer, slice| trainer.running_episodes(group, &envs, slice))?;
        Ok(episodes.into_iter().map(arguments::episode).collect())
    }

    /// Saves all environments of the engine to its checkpoint file. Returns the step of each group.
    fn checkpoint(&mut self, py: Python<'_>) -> PyResult<Vec<u64>> {
        self.wait(py, Trainer::checkpoint)
    }

    /// Connects to the engine of the same name that replaced a lost one. Returns whether it is another engine, its incarnation,
    /// and for each group `(step, lost_step, last_request)`.
    fn reconnect(&mut self, py: Python<'_>, timeout: f64) -> PyResult<(bool, u64, Vec<GroupFound>)> {
        let trainer = self.trainer()?;
        logs::start(py)?;
        let found = wait_for_engine(py, timeout, |slice| trainer.reconnect(slice))?;
        logs::flush(py)?;
        let group = |group: GroupReconnection| {
            let last = match group.last_request {
                LastRequest::None => "none",
                LastRequest::Pending => "pending",
                LastRequest::Played => "played",
                LastRequest::NotPlayed => "not_played",
                LastRequest::Unknown => "unknown",
            };
            (group.step, group.lost_step, last)
        };
        Ok((found.restarted, found.incarnation, found.groups.into_iter().map(group).collect()))
    }

    /// Disconnects. Arrays remain valid. If another call is waiting, for example when a signal handler calls this, the connection
    /// stays open.
    fn close(slf: &Bound<'_, Self>) {
        if let Ok(mut connection) = slf.try_borrow_mut() {
            connection.trainer = None;
        }
    }
}

impl Connection {
    /// Waits for an answer of the engine; see [`wait`].
    fn wait<T: Send>(
        &mut self,
        py: Python<'_>,
        mut answer: impl FnMut(&mut Trainer, Duration) -> Result<T, ServiceError> + Send,
    ) -> PyResult<T> {
        let timeout = arguments::timeout(self.timeout)?;
        let trainer = self.trainer()?;
        wait(py, timeout, |slice| answer(trainer, slice))
    }

    /// The trainer, unless the connection is closed or belongs to another process.
    fn trainer(&mut self) -> PyResult<&mut Trainer> {
        let trainer = self.trainer.as_mut().ok_or_else(errors::closed)?;
        if self.process == std::process::id() {
            return Ok(trainer);
        }
        Err(PyRuntimeError::new_err(
            "this connection belongs to the process that this process was forked from; connect to another engine in the child",
        ))
    }
}

/// Calls `answer` with slices of the timeout, without the interpreter's lock, until it returns anything but a timeout. Runs
/// Python's signal handlers between the calls.
pub fn wait<T: Send>(
    py: Python<'_>,
    timeout: Duration,
    mut answer: impl FnMut(Duration) -> Result<T, ServiceError> + Send,
) -> PyResult<T> {
    let start = Instant::now();
    loop {
        let slice = timeout.saturating_sub(start.elapsed()).min(SIGNAL_INTERVAL);
        match py.detach(|| answer(slice)) {
            Ok(answer) => {
                logs::flush(py)?;
                return Ok(answer);
            }
            Err(ServiceError::TimedOut { service, activity, .. }) => {
                py.check_signals()?;
                if start.elapsed() >= timeout {
                    return Err(errors::service(ServiceError::TimedOut { service, waited: timeout, activity }));
                }
            }
            Err(error) => return Err(errors::service(error)),
        }
    }
}

/// Calls `connect` with slices of the timeout, without the interpreter's lock, until there is an engine. Runs Python's signal
/// handlers between the calls.
pub fn wait_for_engine<T: Send>(
    py: Python<'_>,
    timeout: f64,
    mut connect: impl FnMut(Duration) -> Result<T, ServiceError> + Send,
) -> PyResult<T> {
    let (timeout, start) = (arguments::timeout(timeout)?, Instant::now());
    loop {
        let left = timeout.saturating_sub(start.elapsed());
        match py.detach(|| connect(left.min(SIGNAL_INTERVAL))) {
            Ok(connected) => return Ok(connected),
            // The engine is not running yet, or it was replaced during the call, or another process has locked the namespace.
            Err(
                ServiceError::UnknownEngine { .. }
                | ServiceError::EngineUnreachable { .. }
                | ServiceError::EngineRestarted { .. }
                | ServiceError::NamespaceLocked { .. },
            ) if left > SIGNAL_INTERVAL => {
                py.check_signals()?;
            }
            Err(error) => return Err(errors::service(error)),
        }
    }
}

/// Names of the running engines in the default namespace.
#[pyfunction]
pub fn running_engines(py: Python<'_>) -> PyResult<Vec<String>> {
    py.detach(|| service::running_engines(&Namespace::default())).map_err(errors::service)
}

/// The prefix of all shared memory segments in the default namespace, for tests that look for leaks.
#[pyfunction]
pub fn segment_prefix() -> String {
    Namespace::default().prefix().to_owned()
}
