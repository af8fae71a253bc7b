//! Sections of a batch as numpy arrays, without a copy.

use std::ffi::c_void;

use endless_gym::batch::{Block, Dtype, Layout, MAX_DIMENSIONS, RowShape, Section, SectionTable};
use numpy::npyffi::{NPY_ARRAY_ALIGNED, NPY_ARRAY_C_CONTIGUOUS, NpyTypes, PY_ARRAY_API, PyArrayObject, npy_intp};
use numpy::{PyArrayDescr, PyArrayDescrMethods, dtype, npyffi};
use pyo3::PyClass;
use pyo3::prelude::*;
use pyo3::pyclass::boolean_struct::True;
use pyo3::types::PyTuple;

/// What keeps a batch's memory as it is: for as long as the owner lives, nobody writes to the blocks that it hands out.
pub trait Owner {
    fn blocks(&self) -> &[Block];
}

/// The sections of a batch in the layout's order, each a read-only array whose base is `owner`.
pub fn sections<'py, T: PyClass<Frozen = True> + Owner + Sync>(
    owner: &Bound<'py, T>,
    layout: &Layout,
) -> PyResult<Bound<'py, PyTuple>> {
    let py = owner.py();
    let blocks = owner.get().blocks();
    // What the arrays below rely on: no section reaches beyond the blocks.
    assert!(blocks.len() >= layout.blocks());
    let arrays = layout
        .sections()
        .iter()
        .map(|section| {
            let mut shape = [0; MAX_DIMENSIONS];
            shape[0] = layout.num_envs() as npy_intp;
            for (to, from) in shape[1..].iter_mut().zip(section.shape()) {
                *to = *from as npy_intp;
            }
            let shape = &mut shape[..=section.shape().len()];
            let data = blocks.as_ptr().wrapping_byte_add(section.offset());
            // SAFETY: the section's numbers lie within the blocks, as asserted, at a multiple of 64 bytes. The blocks stay where
            // they are and as they are while the owner lives, which the array keeps alive and does not write to.
            unsafe { array(py, descriptor(py, section), shape, data, owner.as_any()) }
        })
        .collect::<PyResult<Vec<_>>>()?;
    PyTuple::new(py, arrays)
}

fn descriptor<'py>(py: Python<'py>, section: &Section) -> Bound<'py, PyArrayDescr> {
    match (section.dtype(), section.name().row()) {
        // Zeros and ones.
        (Dtype::Uint8, RowShape::Flag) => dtype::<bool>(py),
        (Dtype::Uint8, _) => dtype::<u8>(py),
        (Dtype::Int32, _) => dtype::<i32>(py),
        (Dtype::Uint64, _) => dtype::<u64>(py),
        (Dtype::Float32, _) => dtype::<f32>(py),
        (Dtype::Float64, _) => dtype::<f64>(py),
    }
}

/// A read-only array over foreign memory.
///
/// # Safety
///
/// `data` points to numbers of that type and shape in C order, which stay as they are for as long as `owner` lives.
unsafe fn array<'py>(
    py: Python<'py>,
    descriptor: Bound<'py, PyArrayDescr>,
    shape: &mut [npy_intp],
    data: *const Block,
    owner: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    // SAFETY: the arguments are what numpy's documentation asks for; both calls take over a reference to the descriptor and to
    // the owner respectively, also where they fail.
    unsafe {
        let array = PY_ARRAY_API.PyArray_NewFromDescr(
            py,
            npyffi::get_type_object(py, NpyTypes::PyArray_Type),
            descriptor.into_dtype_ptr(),
            shape.len() as i32,
            shape.as_mut_ptr(),
            std::ptr::null_mut(),
            data.cast_mut().cast::<c_void>(),
            NPY_ARRAY_ALIGNED | NPY_ARRAY_C_CONTIGUOUS,
            std::ptr::null_mut(),
        );
        let array = Bound::from_owned_ptr_or_err(py, array)?;
        let base = owner.clone().into_ptr();
        if PY_ARRAY_API.PyArray_SetBaseObject(py, array.as_ptr().cast::<PyArrayObject>(), base) < 0 {
            return Err(PyErr::fetch(py));
        }
        Ok(array)
    }
}
