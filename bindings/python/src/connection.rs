//! Environments in another process, through shared memory.
//!
//! [`Connection`] has the same methods as the groups in this process ([`Pools`](crate::pool::Pools)).

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use endless_gym::batch::Block;
use endless_gym::pool::{NextOptions, OptionMap};
use endless_gym::service::{
    self, BatchLease, ConnectConfig, GroupReconnection, LastRequest, Namespace, ServiceError, Trainer,
};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use pyo3::types::{PyBytes, PyList, PyTuple};

use crate::arguments::{self, ActionShape, Episode, Reset};
use crate::arrays::{self, Owner};
use crate::{errors, logs};

/// Longest time between two runs of Python's signal handlers, including that of Ctrl-C.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// Longest time for which a waiting thread keeps the trainer from others.
const SHARED_SLICE: Duration = Duration::from_millis(1);

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

/// The trainer of an engine in another process. Threads may call it at the same time: none holds the trainer while it waits for
/// the interpreter's lock, and a waiting thread gives it away between slices of its timeout.
#[pyclass(frozen, module = "endless_gym._native")]
pub struct Connection {
    /// `None` after `close`.
    trainer: Mutex<Option<Trainer>>,
    /// Whether threads have competed for the trainer, so that slices must be short.
    is_shared: AtomicBool,
    groups: usize,
    /// Seconds to wait for each answer.
    timeout: f64,
    action_shape: ActionShape,
    /// Memory for actions, taken while they are copied.
    actions: Mutex<Vec<i32>>,
    /// The arrays that each group last returned, until the caller has them: an exception of a signal handler may come in between.
    kept: Kept,
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
        Ok(Connection {
            trainer: Mutex::new(Some(trainer)),
            is_shared: AtomicBool::new(false),
            groups,
            timeout,
            action_shape,
            actions: Mutex::default(),
            kept: Kept::new(py, groups)?,
            process: std::process::id(),
        })
    }

    /// Number of groups.
    #[getter]
    fn groups(&self) -> usize {
        self.groups
    }

    /// The results that the caller does not have yet, by group; it replaces those that it has by `None`.
    #[getter]
    fn kept<'py>(&self, py: Python<'py>) -> Bound<'py, PyList> {
        self.kept.list(py)
    }

    /// The engine's specification, as JSON text.
    fn specification(&self, py: Python<'_>) -> PyResult<String> {
        let text = self.with(py, |trainer| Ok(serde_json::to_string(trainer.specification())))?;
        text.map_err(|error| PyRuntimeError::new_err(error.to_string()))
    }

    /// Resets a group.
    #[pyo3(signature = (group, request=None, options=None))]
    fn reset<'py>(
        &self,
        py: Python<'py>,
        group: usize,
        request: Option<Reset>,
        options: Option<&str>,
    ) -> PyResult<Bound<'py, PyTuple>> {
        self.send_reset(py, group, request, options)?;
        Ok(self.receive(py, Some(group))?.1)
    }

    /// Steps group 0.
    fn step<'py>(&self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyTuple>> {
        self.send(py, actions, 0)?;
        Ok(self.receive(py, Some(0))?.1)
    }

    /// Requests a step, whose result `receive` returns.
    fn send(&self, py: Python<'_>, actions: &Bound<'_, PyAny>, group: usize) -> PyResult<()> {
        self.with(py, |_| Ok(()))?;
        // Reading the actions may call any Python code.
        let mut numbers = std::mem::take(&mut *lock(&self.actions));
        self.action_shape.copy(actions, &mut numbers)?;
        self.with(py, |trainer| trainer.send(group, &numbers))?;
        *lock(&self.actions) = numbers;
        self.kept.set(py, group, None)
    }

    /// Requests a reset, whose result `receive` returns.
    #[pyo3(signature = (group, request=None, options=None))]
    fn send_reset(&self, py: Python<'_>, group: usize, request: Option<Reset>, options: Option<&str>) -> PyResult<()> {
        let options: Option<OptionMap> = options.map(arguments::options).transpose()?;
        self.with(py, |trainer| trainer.reset_with(group, Reset::request(request.as_ref()), options.as_ref()))?;
        self.kept.set(py, group, None)
    }

    /// Waits for the answer of `group`, or of any group for `None`. Returns the group's number and arrays.
    fn receive<'py>(&self, py: Python<'py>, group: Option<usize>) -> PyResult<(usize, Bound<'py, PyTuple>)> {
        let received = self.wait(py, |trainer, slice| match group {
            Some(group) => trainer.receive(group, slice),
            None => trainer.receive_any(slice),
        })?;
        let group = received.group();
        let lease = Bound::new(py, Lease(received))?;
        let arrays = arrays::sections(&lease, lease.get().0.batch().layout())?;
        self.kept.set(py, group, Some(&arrays))?;
        Ok((group, arrays))
    }

    /// The state of one environment of a group.
    fn snapshot<'py>(&self, py: Python<'py>, group: usize, env: usize) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.wait(py, |trainer, slice| trainer.snapshot(group, env, slice))?;
        Ok(PyBytes::new(py, &bytes))
    }

    /// Sets the state of one environment of a group to that of a snapshot.
    fn restore(&self, py: Python<'_>, group: usize, env: usize, snapshot: &[u8]) -> PyResult<()> {
        self.wait(py, |trainer, slice| trainer.restore(group, env, snapshot, slice))
    }

    /// Sets the options of next episodes; see `arguments::options`.
    fn set_options(&self, py: Python<'_>, group: usize, sets: &str) -> PyResult<()> {
        let sets: Vec<NextOptions> = arguments::options(sets)?;
        self.wait(py, |trainer, slice| trainer.set_options(group, &sets, slice))
    }

    /// Seeds and options of the running episodes.
    fn running_episodes(&self, py: Python<'_>, group: usize, envs: Vec<usize>) -> PyResult<Vec<Episode>> {
        let episodes = self.wait(py, |trainer, slice| trainer.running_episodes(group, &envs, slice))?;
        Ok(episodes.into_iter().map(arguments::episode).collect())
    }

    /// Saves all environments of the engine to its checkpoint file. Returns the step of each group.
    fn checkpoint(&self, py: Python<'_>) -> PyResult<Vec<u64>> {
        self.wait(py, Trainer::checkpoint)
    }

    /// Connects to the engine of the same name that replaced a lost one. Returns whether it is another engine, its incarnation,
    /// and for each group `(step, lost_step, last_request)`.
    fn reconnect(&self, py: Python<'_>, timeout: f64) -> PyResult<(bool, u64, Vec<GroupFound>)> {
        self.with(py, |_| Ok(()))?;
        logs::start(py)?;
        let found = wait_for_engine(py, timeout, |slice| {
            lock(&self.trainer).as_mut().map(|trainer| trainer.reconnect(slice)).transpose()
        })?;
        let found = found.ok_or_else(errors::closed)?;
        logs::flush(py)?;
        for group in 0..if found.restarted { self.groups } else { 0 } {
            self.kept.set(py, group, None)?;
        }
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
    /// is closed as soon as that call gives the trainer away.
    fn close(&self, py: Python<'_>) {
        py.detach(|| *lock(&self.trainer) = None);
    }
}

impl Connection {
    /// Calls the trainer, which answers at once.
    fn with<T>(&self, py: Python<'_>, call: impl FnOnce(&mut Trainer) -> Result<T, ServiceError>) -> PyResult<T> {
        self.check_process()?;
        // Without a detour through the interpreter's lock, which another thread might take.
        let mut trainer = match self.trainer.try_lock() {
            Ok(trainer) => trainer,
            Err(_) => {
                self.is_shared.store(true, Ordering::Relaxed);
                self.trainer.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner)
            }
        };
        call(trainer.as_mut().ok_or_else(errors::closed)?).map_err(errors::service)
    }

    /// Waits for an answer of the engine; see [`wait`].
    fn wait<T: Send>(
        &self,
        py: Python<'_>,
        mut answer: impl FnMut(&mut Trainer, Duration) -> Result<T, ServiceError> + Send,
    ) -> PyResult<T> {
        self.check_process()?;
        let timeout = arguments::timeout(self.timeout)?;
        let answer = wait(py, timeout, |slice| {
            let is_shared = self.is_shared.load(Ordering::Relaxed);
            let slice = if is_shared { slice.min(SHARED_SLICE) } else { slice };
            let answer = lock(&self.trainer).as_mut().map(|trainer| answer(trainer, slice)).transpose();
            if is_shared && matches!(answer, Err(ServiceError::TimedOut { .. })) {
                // A mutex is not fair: the other threads need time to take it.
                std::thread::sleep(SHARED_SLICE / 10);
            }
            answer
        })?;
        answer.ok_or_else(errors::closed)
    }

    /// An error if the connection belongs to another process.
    fn check_process(&self) -> PyResult<()> {
        if self.process == std::process::id() {
            return Ok(());
        }
        Err(PyRuntimeError::new_err(
            "this connection belongs to the process that this process was forked from; connect to another engine in the child",
        ))
    }
}

/// The last results of groups; see `Connection`.
pub struct Kept(Py<PyList>);

impl Kept {
    pub fn new(py: Python<'_>, groups: usize) -> PyResult<Self> {
        Ok(Kept(PyList::new(py, (0..groups).map(|_| py.None()))?.unbind()))
    }

    pub fn list<'py>(&self, py: Python<'py>) -> Bound<'py, PyList> {
        self.0.bind(py).clone()
    }

    pub fn set(&self, py: Python<'_>, group: usize, arrays: Option<&Bound<'_, PyTuple>>) -> PyResult<()> {
        self.0.bind(py).set_item(group, arrays)
    }
}

/// A lock whose contents are valid even if a thread has panicked.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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
