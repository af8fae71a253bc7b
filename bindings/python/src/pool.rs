//! Many environments in this process.

use std::sync::Arc;

use endless_gym::batch::{Block, SectionTable, zeroed};
use endless_gym::envs::view::{VIEW, VIEW_BYTES};
use endless_gym::pool::{self as engine, PoolConfig};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyTuple};

use crate::arguments::{self, Reset};
use crate::arrays::{self, Owner};
use crate::errors;

/// A batch that arrays look into. The pool writes to its memory again once they are all gone.
#[pyclass(frozen)]
struct Lent(Arc<Vec<Block>>);

impl Owner for Lent {
    fn blocks(&self) -> &[Block] {
        &self.0
    }
}

/// Threads that step environments: that many, or one for each core if 0. Several pools may share them.
#[pyclass(frozen, module = "endless_gym._native")]
pub struct Threads(engine::Threads);

#[pymethods]
impl Threads {
    #[new]
    fn new(count: usize) -> PyResult<Self> {
        engine::Threads::new(count).map(Threads).map_err(errors::pool)
    }
}

/// Environments of one id in lockstep, and the batches that they write.
///
/// A batch whose arrays are still held is left alone: the pool writes into another one, and makes a new one where all are held.
#[pyclass(module = "endless_gym._native")]
pub struct Pool {
    pool: engine::Pool,
    batches: Vec<Arc<Vec<Block>>>,
    actions: Vec<i32>,
    process: u32,
}

#[pymethods]
impl Pool {
    #[new]
    #[pyo3(signature = (id, num_envs, *, first_env, total_envs, threads, options, autoreset, seed, seed_range, seed_list, frames, features, final_observation))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        id: &str,
        num_envs: usize,
        first_env: usize,
        total_envs: usize,
        threads: &Threads,
        options: &str,
        autoreset: &str,
        seed: Option<u64>,
        seed_range: Option<(u64, u64)>,
        seed_list: Option<Vec<u64>>,
        frames: Option<(bool, bool, bool, usize)>,
        features: bool,
        final_observation: bool,
    ) -> PyResult<Self> {
        let config = PoolConfig {
            options: arguments::pool_options(options)?,
            autoreset: arguments::autoreset(autoreset)?,
            seeding: arguments::seeding(seed, seed_range, seed_list),
            frames: frames.map(arguments::frames),
            features,
            final_observation,
            first_env,
            total_envs,
            ..PoolConfig::new(id, num_envs)
        };
        let pool = engine::Pool::new(&config, &threads.0).map_err(errors::pool)?;
        Ok(Pool { pool, batches: Vec::new(), actions: Vec::new(), process: std::process::id() })
    }

    /// Names of the arrays that `reset` and `step` return.
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
        self.write(py, |pool, batch| pool.reset_with(Reset::request(request.as_ref()), options.as_ref(), batch))
    }

    fn step<'py>(&mut self, py: Python<'py>, actions: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyTuple>> {
        let mut numbers = std::mem::take(&mut self.actions);
        arguments::actions(actions, &mut numbers)?;
        let arrays = self.write(py, |pool, batch| pool.step(&numbers, batch));
        self.actions = numbers;
        arrays
    }

    fn snapshot<'py>(&self, py: Python<'py>, env: usize) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.pool.snapshot(env).map_err(errors::snapshot)?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn restore(&mut self, env: usize, snapshot: &[u8]) -> PyResult<()> {
        self.pool.restore(env, snapshot).map_err(errors::snapshot)
    }

    /// The ground-truth view of one environment, indexed \[row\]\[column\]\[channel\].
    fn ground_truth_view<'py>(&mut self, py: Python<'py>, env: usize) -> PyResult<Bound<'py, PyAny>> {
        let mut view = vec![0; VIEW_BYTES];
        self.pool.ground_truth_view(env, &mut view).map_err(errors::pool)?;
        Ok(PyArray1::from_vec(py, view).reshape([VIEW, VIEW, 3])?.into_any())
    }
}

impl Pool {
    /// Has the pool write into a batch that nobody looks into, without the interpreter.
    fn write<'py>(
        &mut self,
        py: Python<'py>,
        work: impl FnOnce(&mut engine::Pool, &mut [Block]) -> Result<(), engine::PoolError> + Send,
    ) -> PyResult<Bound<'py, PyTuple>> {
        if self.process != std::process::id() {
            return Err(PyRuntimeError::new_err(
                "these environments belong to the process that this one was forked from; make new ones after the fork",
            ));
        }
        let free = self.batches.iter_mut().rposition(|batch| Arc::get_mut(batch).is_some());
        let index = free.unwrap_or_else(|| {
            self.batches.push(Arc::new(zeroed(self.pool.layout().blocks())));
            self.batches.len() - 1
        });
        let pool = &mut self.pool;
        if let Some(batch) = Arc::get_mut(&mut self.batches[index]) {
            py.detach(|| work(pool, batch)).map_err(errors::pool)?;
        }
        let lent = Bound::new(py, Lent(Arc::clone(&self.batches[index])))?;
        arrays::sections(&lent, self.pool.layout())
    }
}
