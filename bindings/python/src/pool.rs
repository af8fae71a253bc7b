//! The groups of environments in this process.
//!
//! [`Pools`] has the same methods as a connection to an engine, and raises the same errors.

use std::sync::{Mutex, MutexGuard, PoisonError};

use endless_gym::batch::Block;
use endless_gym::pool::{NextOptions, OptionMap, Pool, PoolConfig, PoolError, Threads};
use endless_gym::service::ServiceError;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use pyo3::types::{PyBytes, PyList, PyTuple};

use crate::arguments::{self, ActionShape, Episode, Reset};
use crate::buffers::Buffers;
use crate::connection::{Kept, lock};
use crate::environments::environments;
use crate::{arrays, errors};

/// Checks the configuration of a group, from JSON text, without making environments.
#[pyfunction]
pub fn check_pool_config(config: &str) -> PyResult<()> {
    let config: PoolConfig = arguments::json(config)?;
    let spec = environments().spec(&config.id).map_err(|error| errors::pool(error.into()))?;
    config.validate(spec).map_err(errors::pool)
}

/// The environments of one group, and the buffers of its batches.
///
/// A buffer is not written to while arrays of it exist. A new one is allocated if all are in use.
struct Group {
    pool: Pool,
    buffers: Buffers,
    /// The actions of the last step, or of the pending one.
    actions: Vec<i32>,
}

/// What `receive` executes.
enum Message {
    /// A step with the group's `actions`.
    Step,
    /// A reset.
    Reset { request: Option<Reset>, options: Option<OptionMap> },
}

/// Groups of environments of one id; each group is stepped in lockstep. Threads may call it at the same time; one after the other
/// is served.
#[pyclass(frozen, module = "endless_gym._native")]
pub struct Pools {
    state: Mutex<State>,
    groups: usize,
    action_shape: ActionShape,
    /// Memory for actions that have not been checked yet, taken while they are copied.
    unchecked: Mutex<Vec<i32>>,
    /// As for a connection.
    kept: Kept,
    process: u32,
}

/// Number of CPU cores that this process may use: those of its affinity, at most as many as its control group's quota allows.
#[pyfunction]
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// The groups, and what was sent to them.
struct State {
    /// Empty after `close`.
    pools: Vec<Group>,
    /// Messages that were sent but not yet received, in order; at most one for each group.
    pending: Vec<(usize, Message)>,
}

#[pymethods]
impl Pools {
    /// Makes one group for each configuration, which is JSON text. There must be at least one, and all must have the same id and
    /// number of environments. They share `num_threads` threads, one per core for 0. `allocate` is that of [`Buffers::new`].
    #[new]
    #[pyo3(signature = (configs, num_threads, allocate=None))]
    fn new(py: Python<'_>, configs: Vec<String>, num_threads: usize, allocate: Option<Py<PyAny>>) -> PyResult<Self> {
        let threads = Threads::new(num_threads).map_err(errors::pool)?;
        let group = |config: &String| {
            let pool = Pool::new(environments(), &arguments::json(config)?, &threads).map_err(errors::pool)?;
            let buffers = Buffers::new(allocate.as_ref().map(|allocate| allocate.clone_ref(py)));
            Ok(Group { pool, buffers, actions: Vec::new() })
        };
        let pools: Vec<Group> = configs.iter().map(group).collect::<PyResult<_>>()?;
        let first = &pools.first().ok_or_else(errors::closed)?.pool;
        Ok(Pools {
            action_shape: ActionShape::new(&first.spec().action_space, Some(first.layout().num_envs())),
            groups: pools.len(),
            kept: Kept::new(py, pools.len())?,
            state: Mutex::new(State { pools, pending: Vec::new() }),
            unchecked: Mutex::default(),
            process: std::process::id(),
        })
    }

    /// Number of groups.
    #[getter]
    fn groups(&self) -> usize {
        self.groups
    }

    /// The results that the caller does not have yet; see `Connection`.
    #[getter]
    fn kept<'py>(&self, py: Python<'py>) -> Bound<'py, PyList> {
        self.kept.list(py)
    }

    /// The layout of a batch, as JSON text.
    fn layout(&self, py: Python<'_>) -> PyResult<String> {
        let state = self.state(py)?;
        serde_json::to_string(state.pools[0].pool.layout()).map_err(|error| PyRuntimeError::new_err(error.to_string()))
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
        let options: Option<OptionMap> = options.map(arguments::options).transpose()?;
        let arrays = self.state(py)?.idle(group)?.reset(py, request.as_ref(), options.as_ref())?;
        self.kept.set(py, group, Some(&arrays))?;
        Ok(arrays)
    }

    /// Steps group 0.
    fn step<'py>(&self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyTuple>> {
        let mut unchecked = self.copied(py, actions)?;
        let mut state = self.state(py)?;
        if state.is_pending(0) {
            state.check_message(0, &unchecked)?;
        }
        let group = &mut state.pools[0];
        std::mem::swap(&mut group.actions, &mut unchecked);
        *lock(&self.unchecked) = unchecked;
        let arrays = group.step(py)?;
        self.kept.set(py, 0, Some(&arrays))?;
        Ok(arrays)
    }

    /// Queues a step, which `receive` executes. The actions are copied.
    fn send(&self, py: Python<'_>, actions: &Bound<'_, PyAny>, group: usize) -> PyResult<()> {
        self.state(py)?.check(group)?;
        let mut unchecked = self.copied(py, actions)?;
        let mut state = self.state(py)?;
        state.check_message(group, &unchecked)?;
        std::mem::swap(&mut state.pools[group].actions, &mut unchecked);
        *lock(&self.unchecked) = unchecked;
        state.pending.push((group, Message::Step));
        self.kept.set(py, group, None)
    }

    /// Queues a reset, which `receive` executes.
    #[pyo3(signature = (group, request=None, options=None))]
    fn send_reset(&self, py: Python<'_>, group: usize, request: Option<Reset>, options: Option<&str>) -> PyResult<()> {
        let options = options.map(arguments::options).transpose()?;
        let mut state = self.state(py)?;
        state.idle(group)?;
        state.pending.push((group, Message::Reset { request, options }));
        self.kept.set(py, group, None)
    }

    /// Executes the message sent to a group, or for `None` the first one sent. Returns the group's number and its arrays.
    fn receive<'py>(&self, py: Python<'py>, group: Option<usize>) -> PyResult<(usize, Bound<'py, PyTuple>)> {
        let mut state = self.state(py)?;
        state.check(group.unwrap_or(0))?;
        let place = state.pending.iter().position(|(number, _)| group.is_none_or(|group| group == *number));
        let Some(place) = place else {
            return Err(errors::service(ServiceError::NothingSent { group: group.unwrap_or(0) }));
        };
        let (number, message) = state.pending.remove(place);
        let group = &mut state.pools[number];
        let arrays = match message {
            Message::Step => group.step(py)?,
            Message::Reset { request, options } => group.reset(py, request.as_ref(), options.as_ref())?,
        };
        self.kept.set(py, number, Some(&arrays))?;
        Ok((number, arrays))
    }

    fn snapshot<'py>(&self, py: Python<'py>, group: usize, env: usize) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.state(py)?.idle(group)?.pool.snapshot(env).map_err(errors::snapshot)?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn restore(&self, py: Python<'_>, group: usize, env: usize, snapshot: &[u8]) -> PyResult<()> {
        self.state(py)?.idle(group)?.pool.restore(env, snapshot).map_err(errors::snapshot)
    }

    /// Sets the options of next episodes; see `arguments::options`.
    fn set_options(&self, py: Python<'_>, group: usize, sets: &str) -> PyResult<()> {
        let sets: Vec<NextOptions> = arguments::options(sets)?;
        self.state(py)?.idle(group)?.pool.set_options(&sets).map_err(errors::pool)
    }

    /// Seeds and options of the running episodes.
    fn running_episodes(&self, py: Python<'_>, group: usize, envs: Vec<usize>) -> PyResult<Vec<Episode>> {
        let mut state = self.state(py)?;
        let pool = &state.idle(group)?.pool;
        let episodes = envs.into_iter().map(|env| pool.running_episode(env).map(arguments::episode));
        episodes.collect::<Result<_, _>>().map_err(errors::pool)
    }

    /// The ground-truth view of an environment of group 0, indexed \[row\]\[column\]\[channel\].
    fn ground_truth_view<'py>(&self, py: Python<'py>, env: usize) -> PyResult<Bound<'py, PyAny>> {
        arrays::picture(py, self.state(py)?.pools[0].pool.ground_truth_view(env).map_err(errors::pool)?)
    }

    /// Releases the environments, after the step of another thread. Arrays remain valid.
    fn close(&self, py: Python<'_>) {
        if self.process == std::process::id() {
            let mut state = self.state.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner);
            state.pools.clear();
            state.pending.clear();
        }
    }
}

impl Pools {
    /// The groups; an error if the environments are closed or belong to another process.
    fn state(&self, py: Python<'_>) -> PyResult<MutexGuard<'_, State>> {
        if self.process != std::process::id() {
            return Err(PyRuntimeError::new_err(
                "these environments belong to the process that this process was forked from; make new ones after the fork",
            ));
        }
        let state = self.state.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner);
        if state.pools.is_empty() { Err(errors::closed()) } else { Ok(state) }
    }

    /// The actions as the engine's numbers. Reading them may call any Python code, so the groups must not be locked.
    fn copied(&self, py: Python<'_>, actions: &Bound<'_, PyAny>) -> PyResult<Vec<i32>> {
        drop(self.state(py)?);
        let mut numbers = std::mem::take(&mut *lock(&self.unchecked));
        self.action_shape.copy(actions, &mut numbers)?;
        Ok(numbers)
    }
}

impl State {
    /// An error if there is no such group.
    fn check(&self, group: usize) -> PyResult<()> {
        if group < self.pools.len() {
            Ok(())
        } else {
            Err(PyValueError::new_err(format!("group must be 0 to {}, got {group}", self.pools.len() - 1)))
        }
    }

    fn is_pending(&self, group: usize) -> bool {
        self.pending.iter().any(|(number, _)| *number == group)
    }

    /// The group, or the same error as for an engine if a message to it is pending.
    fn idle(&mut self, group: usize) -> PyResult<&mut Group> {
        self.check(group)?;
        if self.is_pending(group) {
            return Err(errors::service(ServiceError::AnswerPending { group }));
        }
        Ok(&mut self.pools[group])
    }

    /// The checks of a step with these actions, in the order in which a trainer makes them for an engine.
    fn check_message(&mut self, group: usize, actions: &[i32]) -> PyResult<()> {
        check_actions(&self.idle(group)?.pool, actions).map_err(errors::pool)
    }
}

impl Group {
    fn step<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let actions = std::mem::take(&mut self.actions);
        let arrays = self.write(py, |pool, batch| match pool.step(&actions, batch) {
            // An engine's trainer checks the actions first.
            Err(PoolError::NotReset) => check_actions(pool, &actions).and(Err(PoolError::NotReset)),
            stepped => stepped,
        });
        self.actions = actions;
        arrays
    }

    fn reset<'py>(
        &mut self,
        py: Python<'py>,
        request: Option<&Reset>,
        options: Option<&OptionMap>,
    ) -> PyResult<Bound<'py, PyTuple>> {
        self.write(py, |pool, batch| pool.reset_with(Reset::request(request), options, batch))
    }

    /// Writes a batch into a free buffer, without the interpreter's lock.
    fn write<'py>(
        &mut self,
        py: Python<'py>,
        work: impl FnOnce(&mut Pool, &mut [Block]) -> Result<(), PoolError> + Send,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let pool = &mut self.pool;
        let (index, batch) = self.buffers.free(py, pool.layout())?;
        py.detach(|| work(pool, batch)).map_err(errors::pool)?;
        arrays::sections(&Bound::new(py, self.buffers.lease(index))?, self.pool.layout())
    }
}

fn check_actions(pool: &Pool, actions: &[i32]) -> Result<(), PoolError> {
    Ok(pool.spec().action_space.check(pool.layout().num_envs(), actions)?)
}
