//! Read-only arrays for tensor libraries.
//!
//! numpy does not export read-only arrays to libraries that do not know DLPack's flag for them, and PyTorch warns of each. This
//! exports them as they are: the library's tensors look writeable, and whoever writes to one changes the batch.

use std::ffi::{CStr, c_void};

use numpy::{PyArrayDescrMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::ffi;
use pyo3::prelude::*;

const NAME: &CStr = c"dltensor";
const CPU: i32 = 1;

/// The structures of DLPack 0.8, which every library reads.
#[repr(C)]
struct DLTensor {
    data: *mut c_void,
    device: (i32, i32),
    ndim: i32,
    code: u8,
    bits: u8,
    lanes: u16,
    shape: *mut i64,
    strides: *mut i64,
    byte_offset: u64,
}

#[repr(C)]
struct DLManagedTensor {
    tensor: DLTensor,
    manager: *mut c_void,
    deleter: Option<unsafe extern "C" fn(*mut DLManagedTensor)>,
}

/// What a tensor keeps alive: the array, and the numbers that the tensor points to.
struct Manager {
    _array: Py<PyUntypedArray>,
    shape: Vec<i64>,
    strides: Vec<i64>,
}

/// Called by the library when its tensor dies.
unsafe extern "C" fn delete(managed: *mut DLManagedTensor) {
    // SAFETY: both boxes were made by `dlpack` and are given up here, once.
    unsafe {
        let managed = Box::from_raw(managed);
        let manager = Box::from_raw(managed.manager.cast::<Manager>());
        // After the interpreter's end there is nobody to give the array back to.
        if ffi::Py_IsInitialized() == 0 {
            std::mem::forget(manager);
        } else {
            Python::attach(|_| drop(manager));
        }
    }
}

/// Called for a capsule that dies; one that a library took has another name.
unsafe extern "C" fn destroy(capsule: *mut ffi::PyObject) {
    // SAFETY: a capsule of this name holds the pointer that `dlpack` put there.
    unsafe {
        if ffi::PyCapsule_IsValid(capsule, NAME.as_ptr()) == 1 {
            delete(ffi::PyCapsule_GetPointer(capsule, NAME.as_ptr()).cast());
        }
    }
}

/// A DLPack capsule that shares the array's memory, whether it is read-only or not.
#[pyfunction]
pub fn dlpack<'py>(array: &Bound<'py, PyUntypedArray>) -> PyResult<Bound<'py, PyAny>> {
    let descriptor = array.dtype();
    let code = match descriptor.kind() {
        b'i' => 0,
        b'u' => 1,
        b'f' => 2,
        b'b' => 6,
        _ => return Err(PyTypeError::new_err(format!("arrays of {descriptor} have no place in DLPack"))),
    };
    let size = descriptor.itemsize() as isize;
    if array.strides().iter().any(|stride| stride % size != 0) {
        return Err(PyValueError::new_err("the array's strides are no multiples of its items"));
    }
    let mut manager = Box::new(Manager {
        shape: array.shape().iter().map(|length| *length as i64).collect(),
        strides: array.strides().iter().map(|stride| (stride / size) as i64).collect(),
        _array: array.clone().unbind(),
    });
    // SAFETY: an array object is as numpy describes it.
    let data = unsafe { (*array.as_array_ptr()).fields.data.cast::<c_void>() };
    let tensor = DLTensor {
        data,
        device: (CPU, 0),
        ndim: array.ndim() as i32,
        code,
        bits: (size * 8) as u8,
        lanes: 1,
        shape: manager.shape.as_mut_ptr(),
        strides: manager.strides.as_mut_ptr(),
        byte_offset: 0,
    };
    let manager = Box::into_raw(manager).cast();
    let managed = Box::into_raw(Box::new(DLManagedTensor { tensor, manager, deleter: Some(delete) }));
    // SAFETY: the capsule takes over what `managed` points to; if there is none, it is given up here.
    unsafe {
        let capsule = ffi::PyCapsule_New(managed.cast(), NAME.as_ptr(), Some(destroy));
        if capsule.is_null() {
            delete(managed);
        }
        Bound::from_owned_ptr_or_err(array.py(), capsule)
    }
}
