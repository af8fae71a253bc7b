//! Many environments in this process.

use endless_gym::batch::{Block, SectionTable};
use endless_gym::envs::view::{VIEW, VIEW_BYTES};
use endless_gym::pool::{self as engine, PoolError};
use endless_gym::service::ServiceError;
use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyTuple};
use serde_json::{Map, Value as Json};

use crate::arguments::{self, ActionShape, Episode, Reset};
use crate::buffers::Buffers;
use crate::{arrays, errors};

/// Threads that step environments: `count` of them, or one per core for 0. Several pools may share them.
#[pyclass(frozen, module = "endless_gym._native")]
pub struct Threads(engine::Threads);

#[pymethods]
impl Threads {
    #[new]
    fn new(count: usize) -> PyResult<Self> {
        engine::Threads::new(count).map(Threads).map_err(errors::pool)
    }
}

/// The checked configuration of a pool, in this process or in an engine.
#[pyclass(frozen, module = "endless_gym._native")]
pub struct PoolConfig(engine::PoolConfig);

#[pymethods]
impl PoolConfig {
    #[new]
    #[pyo3(signature = (id, num_envs, *, first_env, total_envs, options, autoreset, seed, seed_range, seed_list, frames, features, final_observation, independent_episodes=false))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        id: &str,
        num_envs: usize,
        first_env: usize,
        total_envs: usize,
        options: &str,
        autoreset: &str,
        seed: Option<u64>,
        seed_range: Option<(u64, u64, u64)>,
        seed_list: Option<Vec<u64>>,
        frames: Option<(bool, bool, bool, usize)>,
        features: bool,
        final_observation: bool,
        independent_episodes: bool,
    ) -> PyResult<Self> {
        let config = engine::PoolConfig {
            options: arguments::pool_options(options)?,
            autoreset: arguments::autoreset(autoreset)?,
            seeding: arguments::seeding(seed, seed_range, seed_list),
            frames: frames.map(arguments::frames),
            features,
            final_observation,
            independent_episodes,
            first_env,
            total_envs,
            ..engine::PoolConfig::new(id, num_envs)
        };
        config.validate().map_err(errors::pool)?;
        Ok(PoolConfig(config))
    }
}

/// A group of environments of one id that are stepped in lockstep, and the buffers of its batches.
///
/// A buffer is not written to while arrays of it exist. A new one is allocated if arrays of all buffers exist.
#[pyclass(module = "endless_gym._native")]
pub struct Pool {
    pool: engine::Pool,
    /// Number of the group, for messages.
    group: usize,
    buffers: Buffers,
    /// The message that `receive` has not answered yet.
    pending: Option<Message>,
    action_shape: ActionShape,
    /// The actions of the last `step`, or of the pending one.
    actions: Vec<i32>,
    /// Memory for actions that are not checked yet.
    unchecked: Vec<i32>,
    process: u32,
}

/// What `receive` executes.
enum Message {
    /// A step with `Pool::actions`.
    Step,
    /// A reset.
    Reset { request: Option<Reset>, options: Option<Map<String, Json>> },
}

#[pymethods]
impl Pool {
    #[new]
    fn new(config: &PoolConfig, group: usize, threads: &Threads) -> PyResult<Self> {
        let pool = engine::Pool::new(&config.0, &threads.0).map_err(errors::pool)?;
        Ok(Pool {
            action_shape: ActionShape::group(&pool.spec().action_space, config.0.num_envs),
            pool,
            group,
            buffers: Buffers::default(),
            pending: None,
            actions: Vec::new(),
            unchecked: Vec::new(),
            process: std::process::id(),
        })
    }

    /// Names of the arrays that `reset`, `step` and `receive` return.
    fn sections(&self) -> Vec<&'static str> {
        self.pool.layout().sections().iter().map(|section| section.name().name()).collect()
    }

    #[pyo3(signature = (request=None, options=None))]
    fn reset<'py>(
        &mut self,
        py: Python<'py>,
        request: Option<Reset>,
        options: Option<&str>,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let options = options.map(arguments::options).transpose()?;
        self.check_process()?;
        self.check_idle()?;
        self.write_reset(py, request.as_ref(), options.as_ref())
    }

    fn step<'py>(&mut self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyTuple>> {
        self.check_process()?;
        self.action_shape.copy(actions, &mut self.unchecked)?;
        if self.pending.is_some() {
            self.check_message()?;
        }
        std::mem::swap(&mut self.actions, &mut self.unchecked);
        self.write_step(py)
    }

    /// Queues a step, which `receive` executes. The actions are copied.
    fn send(&mut self, actions: &Bound<'_, PyAny>) -> PyResult<()> {
        self.check_process()?;
        self.action_shape.copy(actions, &mut self.unchecked)?;
        self.check_message()?;
        std::mem::swap(&mut self.actions, &mut self.unchecked);
        self.pending = Some(Message::Step);
        Ok(())
    }

    /// Queues a reset, which `receive` executes.
    #[pyo3(signature = (request=None, options=None))]
    fn send_reset(&mut self, request: Option<Reset>, options: Option<&str>) -> PyResult<()> {
        let options = options.map(arguments::options).transpose()?;
        self.check_process()?;
        self.check_idle()?;
        self.pending = Some(Message::Reset { request, options });
        Ok(())
    }

    /// Executes what was sent.
    fn receive<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        self.check_process()?;
        match self.pending.take() {
            None => Err(errors::service(ServiceError::NothingSent { group: self.group })),
            Some(Message::Step) => self.write_step(py),
            Some(Message::Reset { request, options }) => self.write_reset(py, request.as_ref(), options.as_ref()),
        }
    }

    fn snapshot<'py>(&self, py: Python<'py>, env: usize) -> PyResult<Bound<'py, PyBytes>> {
        self.check_process()?;
        self.check_idle()?;
        let bytes = self.pool.snapshot(env).map_err(errors::snapshot)?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn restore(&mut self, env: usize, snapshot: &[u8]) -> PyResult<()> {
        self.check_process()?;
        self.check_idle()?;
        self.pool.restore(env, snapshot).map_err(errors::snapshot)
    }

    /// Sets the options of next episodes; see `arguments::next_options`.
    fn set_options(&mut self, sets: &str) -> PyResult<()> {
        let sets = arguments::next_options(sets)?;
        self.check_process()?;
        self.check_idle()?;
        self.pool.set_options(&sets).map_err(errors::pool)
    }

    /// What the running episodes of environments follow from.
    fn running_episodes(&self, envs: Vec<usize>) -> PyResult<Vec<Episode>> {
        self.check_process()?;
        self.check_idle()?;
        let episodes = envs.into_iter().map(|env| self.pool.running_episode(env).map(arguments::episode));
        episodes.collect::<Result<_, _>>().map_err(errors::pool)
    }

    /// The ground-truth view of one environment, indexed \[row\]\[column\]\[channel\].
    fn ground_truth_view<'py>(&mut self, py: Python<'py>, env: usize) -> PyResult<Bound<'py, PyAny>> {
        self.check_process()?;
        let mut view = vec![0; VIEW_BYTES];
        self.pool.ground_truth_view(env, &mut view).map_err(errors::pool)?;
        Ok(PyArray1::from_vec(py, view).reshape([VIEW, VIEW, 3])?.into_any())
    }
}

impl Pool {
    fn check_process(&self) -> PyResult<()> {
        if self.process == std::process::id() {
            return Ok(());
        }
        Err(PyRuntimeError::new_err(
            "these environments belong to the process that this process was forked from; make new ones after the fork",
        ))
    }

    /// An error if a message is pending: the error of an engine.
    fn check_idle(&self) -> PyResult<()> {
        match self.pending {
            None => Ok(()),
            Some(_) => Err(errors::service(ServiceError::AnswerPending { group: self.group })),
        }
    }

    /// The checks of a step with the actions in `unchecked`, in the order in which a trainer makes them for an engine.
    fn check_message(&self) -> PyResult<()> {
        self.check_idle()?;
        check_actions(&self.pool, &self.unchecked).map_err(errors::pool)
    }

    fn write_step<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let actions = std::mem::take(&mut self.actions);
        let arrays = self.write(py, |pool, batch| match pool.step(&actions, batch) {
            // An engine's trainer checks the actions first.
            Err(PoolError::NotReset) => check_actions(pool, &actions).and(Err(PoolError::NotReset)),
            stepped => stepped,
        });
        self.actions = actions;
        arrays
    }

    fn write_reset<'py>(
        &mut self,
        py: Python<'py>,
        request: Option<&Reset>,
        options: Option<&Map<String, Json>>,
    ) -> PyResult<Bound<'py, PyTuple>> {
        self.write(py, |pool, batch| pool.reset_with(Reset::request(request), options, batch))
    }

    /// Writes a batch into a free buffer, without the interpreter's lock.
    fn write<'py>(
        &mut self,
        py: Python<'py>,
        work: impl FnOnce(&mut engine::Pool, &mut [Block]) -> Result<(), PoolError> + Send,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let pool = &mut self.pool;
        let (index, batch) = self.buffers.free(pool.layout());
        py.detach(|| work(pool, batch)).map_err(errors::pool)?;
        arrays::sections(&Bound::new(py, self.buffers.lease(index))?, self.pool.layout())
    }
}

fn check_actions(pool: &engine::Pool, actions: &[i32]) -> Result<(), PoolError> {
    Ok(pool.spec().action_space.check(pool.layout().num_envs(), actions)?)
}
