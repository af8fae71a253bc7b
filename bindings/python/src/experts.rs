//! Scripted experts for a batch of environments.

use std::sync::{Mutex, PoisonError};

use endless_gym::envs::Expert;
use numpy::{PyArray1, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::environments::environments;

/// One scripted expert for each of `num_envs` environments.
#[pyclass(module = "endless_gym._native")]
pub struct Experts {
    // Python classes must be `Sync`, which experts need not be.
    experts: Mutex<Vec<Box<dyn Expert>>>,
    features: usize,
    vector_observation: usize,
    branches: usize,
}

#[pymethods]
impl Experts {
    #[new]
    fn new(id: &str, num_envs: usize) -> PyResult<Self> {
        let spec = environments().spec(id).map_err(|error| PyValueError::new_err(error.to_string()))?;
        let experts = (0..num_envs).map(|_| environments().expert(id)).collect::<Result<_, _>>();
        Ok(Experts {
            experts: Mutex::new(experts.map_err(|error| PyValueError::new_err(error.to_string()))?),
            features: spec.features.len(),
            vector_observation: spec.vector_observation,
            branches: spec.action_space.width(),
        })
    }

    /// The actions, int64 (n, branches), for features float32 (n, f) and, if the environment has it, the vector observation
    /// float32 (n, v). `turn` has a number for each environment: 0 skips its expert and returns zeros, 1 acts, 2 starts an
    /// episode and acts.
    #[pyo3(signature = (features, vector_observation, turn))]
    fn act<'py>(
        &mut self,
        py: Python<'py>,
        features: PyReadonlyArray2<'py, f32>,
        vector_observation: Option<PyReadonlyArray2<'py, f32>>,
        turn: PyReadonlyArray1<'py, u8>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (branches, columns, vector_columns) = (self.branches, self.features, self.vector_observation);
        let experts = self.experts.get_mut().unwrap_or_else(PoisonError::into_inner);
        let vector_shape = vector_observation.as_ref().map(|array| array.shape());
        let has_vector = match vector_shape {
            Some(shape) => shape == [experts.len(), vector_columns],
            None => vector_columns == 0,
        };
        if features.shape() != [experts.len(), columns] || !has_vector || turn.len() != experts.len() {
            return Err(PyValueError::new_err(format!(
                "features must have the shape ({n}, {columns}), the vector observation ({n}, {vector_columns}) and turn ({n},)",
                n = experts.len()
            )));
        }
        let (features, turn) = (features.as_slice()?, turn.as_slice()?);
        let vectors = vector_observation.as_ref().map(|array| array.as_slice()).transpose()?.unwrap_or(&[]);
        let actions = py.detach(|| {
            let mut actions = vec![0_i32; experts.len() * branches];
            for (env, (expert, action)) in experts.iter_mut().zip(actions.chunks_exact_mut(branches)).enumerate() {
                match turn[env] {
                    0 => continue,
                    1 => {}
                    _ => expert.reset(),
                }
                let vector = &vectors[env * vector_columns..][..vector_columns];
                expert.act(&features[env * columns..][..columns], vector, action);
            }
            actions.into_iter().map(i64::from).collect::<Vec<_>>()
        });
        let rows = actions.len() / branches;
        Ok(PyArray1::from_vec(py, actions).reshape([rows, branches])?.into_any())
    }
}
