//! Arrays for tensor libraries, by DLPack's protocol.
//!
//! DLPack's unversioned structure cannot mark memory as read-only; version 1.0 can, by a flag. So a read-only array is exported with
//! the flag, or as writable memory of a pool in this process, which then draws its next frames into it in full. Memory of another
//! process is mapped read-only, and is never exported without the flag.

use std::ffi::{CStr, c_void};

use numpy::{PyArrayDescrMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyBufferError, PyTypeError, PyValueError};
use pyo3::ffi;
use pyo3::prelude::*;

use crate::buffers;

const NAME: &CStr = c"dltensor";
const VERSIONED_NAME: &CStr = c"dltensor_versioned";

/// `kDLCPU`.
const CPU: i32 = 1;

/// `DLPACK_FLAG_BITMASK_READ_ONLY`.
const READ_ONLY: u64 = 1;

/// numpy's flag of writable arrays.
const WRITABLE: i32 = numpy::npyffi::NPY_ARRAY_WRITEABLE;

/// DLPack's `DLTensor`.
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

/// DLPack's `DLManagedTensor`, which every library reads.
#[repr(C)]
struct DLManagedTensor {
    tensor: DLTensor,
    manager: *mut Manager,
    deleter: Option<unsafe extern "C" fn(*mut DLManagedTensor)>,
}

/// DLPack's `DLManagedTensorVersioned`, since version 1.0.
#[repr(C)]
struct DLManagedTensorVersioned {
    version: (u32, u32),
    manager: *mut Manager,
    deleter: Option<unsafe extern "C" fn(*mut DLManagedTensorVersioned)>,
    flags: u64,
    tensor: DLTensor,
}

/// What a tensor keeps alive: the array, and the numbers that the structures point to.
struct Manager {
    _array: Py<PyUntypedArray>,
    shape: Vec<i64>,
    strides: Vec<i64>,
}

impl Manager {
    /// Releases the array.
    ///
    /// # Safety
    ///
    /// `manager` was made by `Box::into_raw`, and is not used afterwards.
    unsafe fn release(manager: *mut Manager) {
        // SAFETY: as above.
        let manager = unsafe { Box::from_raw(manager) };
        // SAFETY: the function may be called at any time.
        if unsafe { ffi::Py_IsInitialized() } == 0 {
            // After the interpreter's end, no reference can be released.
            std::mem::forget(manager);
        } else {
            Python::attach(|_| drop(manager));
        }
    }
}

/// Called by the library when its tensor is freed.
unsafe extern "C" fn delete(managed: *mut DLManagedTensor) {
    // SAFETY: both boxes were made by `unversioned`, and are freed here, once.
    unsafe { Manager::release(Box::from_raw(managed).manager) }
}

/// Called by the library when its tensor is freed.
unsafe extern "C" fn delete_versioned(managed: *mut DLManagedTensorVersioned) {
    // SAFETY: both boxes were made by `versioned`, and are freed here, once.
    unsafe { Manager::release(Box::from_raw(managed).manager) }
}

/// Called when a capsule is freed. A library that takes the tensor renames the capsule.
unsafe extern "C" fn destroy(capsule: *mut ffi::PyObject) {
    // SAFETY: a capsule of either name holds the pointer that `unversioned` or `versioned` stored.
    unsafe {
        if ffi::PyCapsule_IsValid(capsule, NAME.as_ptr()) == 1 {
            delete(ffi::PyCapsule_GetPointer(capsule, NAME.as_ptr()).cast());
        } else if ffi::PyCapsule_IsValid(capsule, VERSIONED_NAME.as_ptr()) == 1 {
            delete_versioned(ffi::PyCapsule_GetPointer(capsule, VERSIONED_NAME.as_ptr()).cast());
        }
    }
}

/// A DLPack capsule that shares the array's memory. With `read_only_flag`, it is a versioned capsule that marks a read-only array.
///
/// Without the flag, only writable arrays and views of a pool's buffers can be exported.
#[pyfunction]
pub fn dlpack<'py>(array: &Bound<'py, PyUntypedArray>, read_only_flag: bool) -> PyResult<Bound<'py, PyAny>> {
    // SAFETY: an array object is as numpy describes it.
    let is_writable = unsafe { (*array.as_array_ptr()).fields.flags } & WRITABLE != 0;
    if read_only_flag {
        return versioned(array, if is_writable { 0 } else { READ_ONLY });
    }
    let (tensor, manager) = describe(array)?;
    if !is_writable && !buffers::note_export(array) {
        return Err(PyBufferError::new_err(
            "the array is read-only, and the consumer does not support DLPack's read-only flag; export a copy: array.copy()",
        ));
    }
    unversioned(array.py(), tensor, manager)
}

/// A DLPack capsule that shares the array's memory, and does not mark it as read-only. The caller must not write to the tensor.
#[pyfunction]
pub fn dlpack_unchecked<'py>(array: &Bound<'py, PyUntypedArray>) -> PyResult<Bound<'py, PyAny>> {
    let (tensor, manager) = describe(array)?;
    unversioned(array.py(), tensor, manager)
}

fn unversioned(py: Python<'_>, tensor: DLTensor, manager: Box<Manager>) -> PyResult<Bound<'_, PyAny>> {
    let manager = Box::into_raw(manager);
    let managed = Box::into_raw(Box::new(DLManagedTensor { tensor, manager, deleter: Some(delete) }));
    // SAFETY: the capsule owns what `managed` points to; without a capsule, it is freed here.
    unsafe {
        let capsule = ffi::PyCapsule_New(managed.cast(), NAME.as_ptr(), Some(destroy));
        if capsule.is_null() {
            delete(managed);
        }
        Bound::from_owned_ptr_or_err(py, capsule)
    }
}

fn versioned<'py>(array: &Bound<'py, PyUntypedArray>, flags: u64) -> PyResult<Bound<'py, PyAny>> {
    let (tensor, manager) = describe(array)?;
    let manager = Box::into_raw(manager);
    let deleter = Some(delete_versioned as unsafe extern "C" fn(*mut DLManagedTensorVersioned));
    let managed = DLManagedTensorVersioned { version: (1, 0), manager, deleter, flags, tensor };
    let managed = Box::into_raw(Box::new(managed));
    // SAFETY: the capsule owns what `managed` points to; without a capsule, it is freed here.
    unsafe {
        let capsule = ffi::PyCapsule_New(managed.cast(), VERSIONED_NAME.as_ptr(), Some(destroy));
        if capsule.is_null() {
            delete_versioned(managed);
        }
        Bound::from_owned_ptr_or_err(array.py(), capsule)
    }
}

/// The array as a tensor, with pointers into the manager.
fn describe(array: &Bound<'_, PyUntypedArray>) -> PyResult<(DLTensor, Box<Manager>)> {
    let descriptor = array.dtype();
    let code = match descriptor.kind() {
        b'i' => 0,
        b'u' => 1,
        b'f' => 2,
        b'b' => 6,
        _ => return Err(PyTypeError::new_err(format!("DLPack does not support arrays of {descriptor}"))),
    };
    let size = descriptor.itemsize() as isize;
    if array.strides().iter().any(|stride| stride % size != 0) {
        return Err(PyValueError::new_err("DLPack requires strides that are multiples of the item size"));
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
    Ok((tensor, manager))
}
