//! Copies of observations that are kept up to date from a batch's changes.

use endless_gym::batch::{Batch, BatchSection, Block, Layout, ObservationUpdater, Section};
use numpy::{PyArray1, PyArrayDyn, PyArrayMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

use crate::arrays::Owner;
use crate::{buffers, connection};

/// Updates arrays of this process to the observations of one group's batches.
#[pyclass(module = "endless_gym._native")]
pub struct ObservationUpdates {
    layout: Layout,
    updater: ObservationUpdater,
    rows: Vec<usize>,
}

#[pymethods]
impl ObservationUpdates {
    /// For batches of the layout with that JSON text.
    #[new]
    fn new(layout: &str) -> PyResult<Self> {
        let layout: Layout = serde_json::from_str(layout).map_err(|error| PyValueError::new_err(error.to_string()))?;
        let updater = ObservationUpdater::new(&layout).map_err(|error| PyValueError::new_err(error.to_string()))?;
        Ok(ObservationUpdates { layout, updater, rows: Vec::new() })
    }

    /// Shape of the observations of all environments.
    fn shape(&self) -> Vec<usize> {
        let section = self.layout.section(BatchSection::Observation);
        let row = section.map_or(&[][..], |section| section.shape());
        [&[self.layout.num_envs()], row].concat()
    }

    /// Bytes of a row.
    fn row_bytes(&self) -> usize {
        self.updater.row_bytes()
    }

    /// Copies everything at the next update.
    fn forget(&mut self) {
        self.updater.forget();
    }

    /// Makes `copy` equal to `observation`, an array of a batch, without the interpreter's lock. Returns the bytes that were copied.
    fn update(
        &mut self,
        py: Python<'_>,
        observation: &Bound<'_, PyUntypedArray>,
        copy: &Bound<'_, PyArrayDyn<u8>>,
    ) -> PyResult<usize> {
        self.run(py, observation, copy, false)
    }

    /// As `update`. Returns also the numbers of the rows that were copied to, as int64 in ascending order.
    fn update_and_list<'py>(
        &mut self,
        py: Python<'py>,
        observation: &Bound<'py, PyUntypedArray>,
        copy: &Bound<'py, PyArrayDyn<u8>>,
    ) -> PyResult<(usize, Bound<'py, PyArray1<i64>>)> {
        let copied = self.run(py, observation, copy, true)?;
        Ok((copied, PyArray1::from_iter(py, self.rows.iter().map(|row| *row as i64))))
    }
}

impl ObservationUpdates {
    fn run(
        &mut self,
        py: Python<'_>,
        observation: &Bound<'_, PyUntypedArray>,
        copy: &Bound<'_, PyArrayDyn<u8>>,
        list: bool,
    ) -> PyResult<usize> {
        let foreign = || {
            PyTypeError::new_err(
                "observation must be the array of a step of these environments, not a part or a copy of it (`copy=True`)",
            )
        };
        let (memory, length, is_exported) = memory_of(observation).ok_or_else(foreign)?;
        let offset = self.layout.section(BatchSection::Observation).map_or(0, Section::offset);
        // SAFETY: the array is borrowed, and its data pointer is only compared.
        let data = unsafe { (*observation.as_array_ptr()).fields.data };
        if data.cast::<u8>().cast_const() != memory.wrapping_byte_add(offset).cast::<u8>()
            || observation.shape() != self.shape()
            || length < self.layout.blocks()
        {
            return Err(foreign());
        }
        // SAFETY: the memory stays mapped and is not written to while the owner lives, which the array keeps alive.
        let blocks: &[Block] = unsafe { std::slice::from_raw_parts(memory, length) };
        let mut copy = copy.try_readwrite().map_err(|error| PyValueError::new_err(error.to_string()))?;
        let copy = copy.as_slice_mut().map_err(|error| PyValueError::new_err(error.to_string()))?;
        if is_exported {
            // Python code may have written to the batch.
            self.updater.forget();
        }
        let ObservationUpdates { layout, updater, rows } = self;
        let batch = Batch::new(layout, blocks);
        let updated = py.detach(|| match list {
            true => updater.update_and_list(&batch, copy, rows),
            false => updater.update(&batch, copy),
        });
        if is_exported {
            self.updater.forget();
        }
        updated.map_err(|error| PyValueError::new_err(error.to_string()))
    }
}

/// Address and length of the batch that `array` is a view of, which it keeps alive, and whether Python code may have written to it.
fn memory_of(array: &Bound<'_, PyUntypedArray>) -> Option<(*const Block, usize, bool)> {
    // SAFETY: an array's base is an object that the array keeps alive, or null.
    let base = unsafe { Bound::from_borrowed_ptr_or_opt(array.py(), (*array.as_array_ptr()).fields.base) }?;
    let ((memory, blocks), is_exported) = if let Ok(lease) = base.cast::<buffers::Lease>() {
        (lease.get().memory(), lease.get().is_exported())
    } else {
        (base.cast::<connection::Lease>().ok()?.get().memory(), false)
    };
    Some((memory, blocks, is_exported))
}
