//! Sections of a batch as numpy arrays, without a copy.

use std::ffi::c_void;

use endless_gym::batch::{BatchSection, Block, Dtype, Layout, MAX_DIMENSIONS, RowShape, Section, SectionTable};
use endless_gym::envs::view::Picture;
use numpy::npyffi::{NPY_ARRAY_ALIGNED, NPY_ARRAY_C_CONTIGUOUS, NpyTypes, PY_ARRAY_API, PyArrayObject, npy_intp};
use numpy::{PyArray1, PyArrayDescr, PyArrayDescrMethods, PyArrayMethods, dtype, npyffi};
use pyo3::PyClass;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::pyclass::boolean_struct::True;
use pyo3::types::PyTuple;

/// The owner of a batch's memory.
///
/// # Safety
///
/// The memory stays mapped while the owner lives. The engine or pool does not write to it during that time.
pub unsafe trait Owner {
    /// Address of the batch and its number of blocks.
    fn memory(&self) -> (*const Block, usize);
}

/// Whether Python gets a writable copy of a section: one with a few bytes per environment, which Gymnasium's wrappers and trainers
/// modify in place.
fn is_copied(section: BatchSection) -> bool {
    matches!(section, BatchSection::Reward | BatchSection::Terminated | BatchSection::Truncated)
}

/// The sections of a batch in the layout's order: copies of rewards and flags, and otherwise read-only arrays whose base is `owner`.
pub fn sections<'py, T: PyClass<Frozen = True> + Owner + Sync>(
    owner: &Bound<'py, T>,
    layout: &Layout,
) -> PyResult<Bound<'py, PyTuple>> {
    let py = owner.py();
    let (memory, blocks) = owner.get().memory();
    if blocks < layout.blocks() {
        let message = format!("a batch must have {} blocks of 64 bytes, got {blocks}", layout.blocks());
        return Err(PyRuntimeError::new_err(message));
    }
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
            let data = memory.wrapping_byte_add(section.offset());
            let owner = (!is_copied(section.name())).then_some(owner.as_any());
            // SAFETY: a layout is checked when it is made or deserialised, so the section lies within its blocks, at a multiple of
            // 64 bytes, and there are as many blocks. The memory stays mapped and is not written to while the owner lives, which
            // the array keeps alive. Every bit pattern is valid for the dtype: numpy takes any nonzero byte of a boolean array as
            // true.
            unsafe { array(py, descriptor(py, section), shape, data, owner) }
        })
        .collect::<PyResult<Vec<_>>>()?;
    PyTuple::new(py, arrays)
}

fn descriptor<'py>(py: Python<'py>, section: &Section) -> Bound<'py, PyArrayDescr> {
    match (section.dtype(), section.name().row()) {
        // Written as 0 or 1. Rust code reads these arrays as u8, since a `bool` of another value is undefined behaviour.
        (Dtype::Uint8, RowShape::Flag) => dtype::<bool>(py),
        (Dtype::Uint8, _) => dtype::<u8>(py),
        (Dtype::Int32, _) => dtype::<i32>(py),
        (Dtype::Uint64, _) => dtype::<u64>(py),
        (Dtype::Float32, _) => dtype::<f32>(py),
        (Dtype::Float64, _) => dtype::<f64>(py),
    }
}

/// A read-only array over foreign memory, whose base is `owner`; without an owner, an array with a copy of it.
///
/// # Safety
///
/// `data` points to numbers of that type and shape in C order, which stay mapped and unchanged during the call, and for as long as
/// `owner` lives.
unsafe fn array<'py>(
    py: Python<'py>,
    descriptor: Bound<'py, PyArrayDescr>,
    shape: &mut [npy_intp],
    data: *const Block,
    owner: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    let bytes = shape.iter().map(|length| *length as usize).product::<usize>() * descriptor.itemsize();
    let (memory, flags) = match owner {
        Some(_) => (data.cast_mut().cast::<c_void>(), NPY_ARRAY_ALIGNED | NPY_ARRAY_C_CONTIGUOUS),
        // numpy allocates the memory of a writable array in C order.
        None => (std::ptr::null_mut(), 0),
    };
    // SAFETY: the arguments are as numpy's documentation requires; the calls steal a reference, to the descriptor and to the
    // owner, even if they fail. A new array has `bytes` bytes, which nothing else refers to.
    unsafe {
        let array = PY_ARRAY_API.PyArray_NewFromDescr(
            py,
            npyffi::get_type_object(py, NpyTypes::PyArray_Type),
            descriptor.into_dtype_ptr(),
            shape.len() as i32,
            shape.as_mut_ptr(),
            std::ptr::null_mut(),
            memory,
            flags,
            std::ptr::null_mut(),
        );
        let array = Bound::from_owned_ptr_or_err(py, array)?;
        let object = array.as_ptr().cast::<PyArrayObject>();
        match owner {
            None => std::ptr::copy_nonoverlapping(data.cast::<u8>(), (*object).fields.data.cast::<u8>(), bytes),
            Some(owner) if PY_ARRAY_API.PyArray_SetBaseObject(py, object, owner.clone().into_ptr()) < 0 => {
                return Err(PyErr::fetch(py));
            }
            Some(_) => {}
        }
        Ok(array)
    }
}

/// A picture, uint8 (height, width, 3).
pub fn picture(py: Python<'_>, Picture { width, height, pixels }: Picture) -> PyResult<Bound<'_, PyAny>> {
    Ok(PyArray1::from_vec(py, pixels).reshape([height, width, 3])?.into_any())
}
