//! Environments in another process, through shared memory.
//!
//! [`Connection`] has the same methods as the groups in this process ([`Pools`](crate::pool::Pools)).

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use endless_gym::batch::Block;
use endless_gym::pool::{NextOptions, OptionMap};
use endless_gym::service::{
    self, BatchLease, ConnectConfig, ErrorKind, GroupReconnection, LastRequest, Namespace, ServiceError, Trainer,
    TrainerGroup,
};
use pyo3::exceptions::{PyIndexError, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use pyo3::types::{PyBytes, PyList, PyTuple};

use crate::arguments::{self, ActionShape, Episode, Reset};
use crate::arrays::{self, Owner};
use crate::{errors, logs};

/// Longest time between two runs of Python's signal handlers, including that of Ctrl-C.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// Longest time for which a waiting thread keeps a group from others.
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

/// A group of the trainer.
struct Group {
    /// `None` after `close`. A thread that locks several groups does so in the order of their numbers.
    trainer: Mutex<Option<TrainerGroup>>,
    /// Whether threads have competed for the group, so that slices must be short.
    is_shared: AtomicBool,
}

impl Group {
    /// Locks the group, in a thread without the interpreter's lock.
    fn lock(&self) -> MutexGuard<'_, Option<TrainerGroup>> {
        self.trainer.try_lock().unwrap_or_else(|_| {
            self.is_shared.store(true, Ordering::Relaxed);
            lock(&self.trainer)
        })
    }
}

/// The trainer of an engine in another process. Threads may call it at the same time, and those that use different groups do not
/// wait for each other: none holds a group while it waits for the interpreter's lock, and a waiting thread gives its group away
/// between slices of its timeout.
#[pyclass(frozen, module = "endless_gym._native")]
pub struct Connection {
    groups: Vec<Group>,
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
        let connect = |slice| Trainer::connect(&config.clone().timeout(slice));
        let trainer = wait_for_engine(py, timeout, connect)?;
        logs::flush(py)?;
        let specification = trainer.specification();
        let action_shape = ActionShape::new(&specification.action_space, Some(specification.num_envs));
        let kept = Kept::new(py, specification.groups)?;
        let group = |group| Group { trainer: Mutex::new(Some(group)), is_shared: AtomicBool::new(false) };
        Ok(Connection {
            groups: trainer.into_groups().into_iter().map(group).collect(),
            timeout,
            action_shape,
            actions: Mutex::default(),
            kept,
            process: std::process::id(),
        })
    }

    /// Number of groups.
    #[getter]
    fn groups(&self) -> usize {
        self.groups.len()
    }

    /// The results that the caller does not have yet, by group; it replaces those that it has by `None`.
    #[getter]
    fn kept<'py>(&self, py: Python<'py>) -> Bound<'py, PyList> {
        self.kept.list(py)
    }

    /// The engine's specification, as JSON text.
    fn specification(&self, py: Python<'_>) -> PyResult<String> {
        let text = self.with(py, 0, |group| Ok(serde_json::to_string(group.specification())))?;
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
        self.with(py, group, |_| Ok(()))?;
        // Reading the actions may call any Python code.
        let mut numbers = std::mem::take(&mut *lock(&self.actions));
        self.action_shape.copy(actions, &mut numbers)?;
        self.with(py, group, |group| group.send(&numbers))?;
        *lock(&self.actions) = numbers;
        self.kept.set(py, group, None)
    }

    /// Requests a reset, whose result `receive` returns.
    #[pyo3(signature = (group, request=None, options=None))]
    fn send_reset(&self, py: Python<'_>, group: usize, request: Option<Reset>, options: Option<&str>) -> PyResult<()> {
        let options: Option<OptionMap> = options.map(arguments::options).transpose()?;
        self.with(py, group, |group| group.reset_with(Reset::request(request.as_ref()), options.as_ref()))?;
        self.kept.set(py, group, None)
    }

    /// Waits for the answer of `group`, or of any group for `None`. Returns the group's number and arrays.
    fn receive<'py>(&self, py: Python<'py>, group: Option<usize>) -> PyResult<(usize, Bound<'py, PyTuple>)> {
        let received = match group {
            Some(group) => self.wait(py, group, TrainerGroup::receive)?,
            None => self.receive_any(py)?,
        };
        let group = received.group();
        let lease = Bound::new(py, Lease(received))?;
        let arrays = arrays::sections(&lease, lease.get().0.batch().layout())?;
        self.kept.set(py, group, Some(&arrays))?;
        Ok((group, arrays))
    }

    /// The state of one environment of a group.
    fn snapshot<'py>(&self, py: Python<'py>, group: usize, env: usize) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.wait(py, group, |group, slice| group.snapshot(env, slice))?;
        Ok(PyBytes::new(py, &bytes))
    }

    /// Sets the state of one environment of a group to that of a snapshot.
    fn restore(&self, py: Python<'_>, group: usize, env: usize, snapshot: &[u8]) -> PyResult<()> {
        self.wait(py, group, |group, slice| group.restore(env, snapshot, slice))
    }

    /// Sets the options of next episodes; see `arguments::options`.
    fn set_options(&self, py: Python<'_>, group: usize, sets: &str) -> PyResult<()> {
        let sets: Vec<NextOptions> = arguments::options(sets)?;
        self.wait(py, group, |group, slice| group.set_options(&sets, slice))
    }

    /// Seeds and options of the running episodes.
    fn running_episodes(&self, py: Python<'_>, group: usize, envs: Vec<usize>) -> PyResult<Vec<Episode>> {
        let episodes = self.wait(py, group, |group, slice| group.running_episodes(&envs, slice))?;
        Ok(episodes.into_iter().map(arguments::episode).collect())
    }

    /// Saves all environments of the engine to its checkpoint file. Returns the step of each group.
    fn checkpoint(&self, py: Python<'_>) -> PyResult<Vec<u64>> {
        self.wait(py, 0, TrainerGroup::checkpoint)
    }

    /// Connects to the engine of the same name that replaced a lost one. Returns whether it is another engine, its incarnation,
    /// and for each group `(step, lost_step, last_request)`.
    fn reconnect(&self, py: Python<'_>, timeout: f64) -> PyResult<(bool, u64, Vec<GroupFound>)> {
        self.with(py, 0, |_| Ok(()))?;
        logs::start(py)?;
        let found = wait_for_engine(py, timeout, |slice| {
            let mut locked = self.lock_all();
            let Some(mut groups) = locked.iter_mut().map(|group| group.take()).collect::<Option<Vec<_>>>() else {
                return Ok(None);
            };
            let (found, groups) = match Trainer::from_groups(&mut groups) {
                Ok(mut trainer) => (trainer.reconnect(slice).map(Some), trainer.into_groups()),
                Err(_) => (Ok(None), groups),
            };
            locked.iter_mut().zip(groups).for_each(|(locked, group)| **locked = Some(group));
            found
        })?;
        let found = found.ok_or_else(errors::closed)?;
        logs::flush(py)?;
        for group in 0..if found.restarted { self.groups.len() } else { 0 } {
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
    /// is closed as soon as that call gives its group away.
    fn close(&self, py: Python<'_>) {
        py.detach(|| self.groups.iter().for_each(|group| *group.lock() = None));
    }
}

impl Connection {
    /// Calls a group, which answers at once.
    fn with<T>(
        &self,
        py: Python<'_>,
        group: usize,
        call: impl FnOnce(&mut TrainerGroup) -> Result<T, ServiceError>,
    ) -> PyResult<T> {
        self.check_process()?;
        let group = self.group(group)?;
        // Without a detour through the interpreter's lock, which another thread might take.
        let mut trainer = group.trainer.try_lock().unwrap_or_else(|_| {
            group.is_shared.store(true, Ordering::Relaxed);
            group.trainer.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner)
        });
        call(trainer.as_mut().ok_or_else(errors::closed)?).map_err(errors::service)
    }

    /// Waits for an answer to a group; see [`wait`].
    fn wait<T: Send>(
        &self,
        py: Python<'_>,
        group: usize,
        mut answer: impl FnMut(&mut TrainerGroup, Duration) -> Result<T, ServiceError> + Send,
    ) -> PyResult<T> {
        let group = self.group(group)?;
        self.wait_in_slices(py, std::slice::from_ref(group), |slice| {
            group.lock().as_mut().map(|group| answer(group, slice)).transpose()
        })
    }

    /// Waits for the first batch of any group.
    fn receive_any(&self, py: Python<'_>) -> PyResult<BatchLease> {
        self.wait_in_slices(py, &self.groups, |slice| {
            let mut locked = self.lock_all();
            let groups: Option<Vec<_>> = locked.iter_mut().map(|group| group.as_mut()).collect();
            groups.map(|mut groups| TrainerGroup::receive_any(&mut groups, slice)).transpose()
        })
    }

    /// Waits for an answer to one of these groups, which `answer` locks for a slice of the timeout. `None` means that the connection
    /// is closed.
    fn wait_in_slices<T: Send>(
        &self,
        py: Python<'_>,
        groups: &[Group],
        mut answer: impl FnMut(Duration) -> Result<Option<T>, ServiceError> + Send,
    ) -> PyResult<T> {
        self.check_process()?;
        let timeout = arguments::timeout(self.timeout)?;
        let answer = wait(py, timeout, |slice| {
            let is_shared = groups.iter().any(|group| group.is_shared.load(Ordering::Relaxed));
            let answer = answer(if is_shared { slice.min(SHARED_SLICE) } else { slice });
            if is_shared && matches!(answer, Err(ServiceError::TimedOut { .. })) {
                // A mutex is not fair: the other threads need time to take it.
                std::thread::sleep(SHARED_SLICE / 10);
            }
            answer
        })?;
        answer.ok_or_else(errors::closed)
    }

    fn lock_all(&self) -> Vec<MutexGuard<'_, Option<TrainerGroup>>> {
        self.groups.iter().map(Group::lock).collect()
    }

    fn group(&self, group: usize) -> PyResult<&Group> {
        self.groups.get(group).ok_or_else(|| PyIndexError::new_err(format!("there is no group {group}")))
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
            Err(error)
                if left > SIGNAL_INTERVAL && matches!(error.kind(), ErrorKind::Unavailable | ErrorKind::Lost) =>
            {
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
