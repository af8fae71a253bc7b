//! One environment with the interface of the original. Every step returns newly allocated arrays.

use endless_gym::batch::{Batch, BatchSection, Block, zeroed};
use endless_gym::envs::ActionSpace;
use endless_gym::envs::view::rgb_array;
use endless_gym::pool::{OptionMap, Pool, PoolError, ResetRequest, SavedEnv, Threads};
use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::arguments::{self, ActionShape};
use crate::environments::environments;
use crate::{arrays, errors};

/// Frames, features, vector observation and ground truth; `None` for those that the environment does not have.
type Arrays<'py> = [Option<Bound<'py, PyAny>>; 4];

/// One environment without auto-reset.
#[pyclass(module = "endless_gym._native")]
pub struct Single {
    pool: Pool,
    blocks: Vec<Block>,
    action_shape: ActionShape,
    action: Vec<i32>,
}

#[pymethods]
impl Single {
    /// `config` is JSON text, with one environment.
    #[new]
    fn new(config: &str) -> PyResult<Self> {
        let threads = Threads::new(1).map_err(errors::pool)?;
        let pool = Pool::new(environments(), &arguments::json(config)?, &threads).map_err(errors::pool)?;
        let blocks = zeroed(pool.layout().blocks());
        let action_shape = ActionShape::new(&pool.spec().action_space, None);
        Ok(Single { pool, blocks, action_shape, action: Vec::new() })
    }

    fn reset<'py>(&mut self, py: Python<'py>, seed: Option<u64>, options: &str) -> PyResult<Arrays<'py>> {
        let options: OptionMap = arguments::options(options)?;
        let request = seed.map_or(ResetRequest::All, ResetRequest::Seed);
        self.pool.reset_with(request, Some(&options), &mut self.blocks).map_err(errors::pool)?;
        self.arrays(py)
    }

    /// The arrays, the reward, and whether the episode terminated and was truncated; if it ended, its return, its length and the info columns.
    #[allow(clippy::type_complexity)]
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        action: &Bound<'py, PyAny>,
    ) -> PyResult<(Arrays<'py>, f64, bool, bool, Option<(f64, i32, Vec<f64>)>)> {
        match (&self.pool.spec().action_space, action.extract::<i64>()) {
            (ActionSpace::Discrete(_), Ok(action)) => {
                self.action.clear();
                self.action.push(arguments::action(action)?);
            }
            _ => self.action_shape.copy(action, &mut self.action)?,
        }
        self.pool.step(&self.action, &mut self.blocks).map_err(errors::pool)?;
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        let (terminated, truncated) = (batch.terminated()[0] != 0, batch.truncated()[0] != 0);
        let end = (terminated || truncated)
            .then(|| (batch.episode_return()[0], batch.episode_length()[0], batch.info().to_vec()));
        Ok((self.arrays(py)?, batch.reward()[0], terminated, truncated, end))
    }

    /// The last frame of the original's format, or the picture of an environment without frames, indexed \[row\]\[column\]\[channel\].
    fn rgb_array<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let spec = self.pool.spec();
        let shape = spec.shown().ok_or_else(|| errors::pool(PoolError::NoFrame { id: spec.id }))?;
        if spec.frame.is_none() {
            return arrays::picture(py, rgb_array(&self.pool.frame(0).map_err(errors::pool)?, shape));
        }
        arrays::picture(py, rgb_array(Batch::new(self.pool.layout(), &self.blocks).observation(), shape))
    }

    /// The features as text.
    fn text(&self) -> String {
        self.pool.spec().text(Batch::new(self.pool.layout(), &self.blocks).features())
    }

    /// The ground-truth view, indexed \[row\]\[column\]\[channel\]: the one after the last view, as in the original, or that of the
    /// current step.
    fn ground_truth_view<'py>(&mut self, py: Python<'py>, of_current_step: bool) -> PyResult<Bound<'py, PyAny>> {
        if of_current_step {
            self.pool.align_ground_truth_view(0).map_err(errors::pool)?;
        }
        arrays::picture(py, self.pool.ground_truth_view(0).map_err(errors::pool)?)
    }

    /// The Markov state; `None` if the environment does not tell it.
    fn state<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyAny>> {
        row(py, Batch::new(self.pool.layout(), &self.blocks).state())
    }

    /// The progress of the episode: for each quantity its name, its value, and the value at which the task is complete.
    fn progress(&self) -> PyResult<Vec<(&'static str, f64, Option<f64>)>> {
        let progress = self.pool.progress(0).map_err(errors::pool)?;
        Ok(progress.iter().map(|shown| (shown.name, shown.value, shown.of)).collect())
    }

    fn snapshot<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.pool.snapshot(0).map_err(errors::snapshot)?))
    }

    fn restore<'py>(&mut self, py: Python<'py>, snapshot: &[u8]) -> PyResult<Arrays<'py>> {
        self.pool.restore(0, snapshot).map_err(errors::snapshot)?;
        self.pool.observe(&mut self.blocks).map_err(errors::pool)?;
        self.arrays(py)
    }

    /// The complete state: a snapshot, and the earlier frames of a stacked observation; `None` before the first reset.
    fn save<'py>(&self, py: Python<'py>) -> PyResult<Option<(Bound<'py, PyBytes>, Bound<'py, PyBytes>)>> {
        let saved = self.pool.save().map_err(errors::snapshot)?.and_then(|mut saved| saved.pop());
        Ok(saved.map(|saved| (PyBytes::new(py, &saved.snapshot), PyBytes::new(py, &saved.earlier_frames))))
    }

    /// Continues from what `save` returned.
    fn resume(&mut self, snapshot: Vec<u8>, earlier_frames: Vec<u8>) -> PyResult<()> {
        let saved = [SavedEnv { snapshot, earlier_frames }];
        self.pool.resume(&saved).map_err(|error| PyValueError::new_err(error.to_string()))?;
        self.pool.observe(&mut self.blocks).map_err(errors::pool)
    }
}

impl Single {
    fn arrays<'py>(&self, py: Python<'py>) -> PyResult<Arrays<'py>> {
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        let shape = self.pool.layout().section(BatchSection::Observation).map(|section| section.shape().to_vec());
        let frames = shape.map(|shape| PyArray1::from_slice(py, batch.observation()).reshape(shape)).transpose()?;
        Ok([
            frames.map(Bound::into_any),
            row(py, batch.features()),
            row(py, batch.vector_observation()),
            row(py, batch.ground_truth()),
        ])
    }
}

/// The only row of a section; `None` if the batch does not have it.
fn row<'py, T: Element>(py: Python<'py>, numbers: &[T]) -> Option<Bound<'py, PyAny>> {
    (!numbers.is_empty()).then(|| PyArray1::from_slice(py, numbers).into_any())
}
