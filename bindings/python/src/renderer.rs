//! Pictures of environments from their snapshots, which leave the environments as they are.

use endless_gym::batch::{Batch, Block, zeroed};
use endless_gym::envs::view::{VIEW, VIEW_BYTES, rgb_array};
use endless_gym::envs::{FRAME_BYTES, SCREEN};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;

use crate::errors;

/// Draws what the environments of one id show.
#[pyclass(module = "endless_gym._native")]
pub struct Renderer {
    pool: Pool,
    blocks: Vec<Block>,
}

#[pymethods]
impl Renderer {
    #[new]
    fn new(id: &str) -> PyResult<Self> {
        let threads = Threads::new(1).map_err(errors::pool)?;
        let mut pool = Pool::new(&PoolConfig::new(id, 1), &threads).map_err(errors::pool)?;
        let mut blocks = zeroed(pool.layout().blocks());
        // Only environments that were reset can be restored.
        pool.reset(ResetRequest::Seed(0), &mut blocks).map_err(errors::pool)?;
        Ok(Renderer { pool, blocks })
    }

    /// The frame of an environment, uint8 (84, 84, 3), indexed \[row\]\[column\]\[channel\].
    fn frame<'py>(&mut self, py: Python<'py>, snapshot: &[u8]) -> PyResult<Bound<'py, PyAny>> {
        self.pool.restore(0, snapshot).map_err(errors::snapshot)?;
        self.pool.observe(&mut self.blocks).map_err(errors::pool)?;
        let mut picture = vec![0; FRAME_BYTES];
        rgb_array(Batch::new(self.pool.layout(), &self.blocks).observation(), &mut picture);
        Ok(PyArray1::from_vec(py, picture).reshape([SCREEN, SCREEN, 3])?.into_any())
    }

    /// The ground-truth view of its current step, uint8 (336, 336, 3), indexed \[row\]\[column\]\[channel\].
    fn ground_truth_view<'py>(&mut self, py: Python<'py>, snapshot: &[u8]) -> PyResult<Bound<'py, PyAny>> {
        self.pool.restore(0, snapshot).map_err(errors::snapshot)?;
        self.pool.align_ground_truth_view(0).map_err(errors::pool)?;
        let mut view = vec![0; VIEW_BYTES];
        self.pool.ground_truth_view(0, &mut view).map_err(errors::pool)?;
        Ok(PyArray1::from_vec(py, view).reshape([VIEW, VIEW, 3])?.into_any())
    }
}
