//! Buffers of a pool in this process, and which of them Python code may have written to.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use endless_gym::batch::{BLOCK_BYTES, BatchBuffer, Block, Layout};
use numpy::npyffi::NPY_ARRAY_WRITEABLE;
use numpy::{PyArray1, PyArrayMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arrays::Owner;

/// The memory of one batch.
pub struct Buffer {
    address: *mut Block,
    blocks: usize,
    /// Whether a writable tensor of this memory was exported since the pool last wrote to it.
    exported: AtomicBool,
    /// What keeps the memory, which only this buffer uses.
    _memory: Box<dyn Send + Sync>,
}

// SAFETY: arrays and tensors use the memory under Python's rules; Rust code only while no array exists.
unsafe impl Send for Buffer {}
// SAFETY: as for `Send`; a shared reference gives access to the address and to an atomic flag.
unsafe impl Sync for Buffer {}

impl Buffer {
    fn new(blocks: usize) -> Self {
        let mut memory = BatchBuffer::new(blocks);
        let address = memory.as_mut_ptr();
        Buffer { address, blocks, exported: AtomicBool::new(false), _memory: Box::new(memory) }
    }

    /// A buffer in the tensor of bytes that `allocate` returns for a number of bytes; see [`Buffers::new`].
    fn allocated(blocks: usize, allocate: &Bound<'_, PyAny>) -> PyResult<Self> {
        let bytes = blocks * BLOCK_BYTES;
        let array = allocate.call1((bytes,))?.call_method0("numpy")?.cast_into::<PyArray1<u8>>()?;
        let address = array.data().cast::<Block>();
        if array.len() < bytes || !array.is_c_contiguous() || !address.is_aligned() {
            return Err(PyValueError::new_err(format!(
                "the memory of a batch must have {bytes} contiguous bytes at a multiple of {BLOCK_BYTES}, got {} bytes at {address:p}",
                array.len()
            )));
        }
        Ok(Buffer { address, blocks, exported: AtomicBool::new(false), _memory: Box::new(array.unbind()) })
    }
}

/// The owner of the arrays of one batch. The pool writes to the buffer again once all arrays are gone.
#[pyclass(frozen)]
pub struct Lease(Arc<Buffer>);

// SAFETY: the buffer is shared with this value, and `Buffers::free` hands out unshared ones only.
unsafe impl Owner for Lease {
    fn memory(&self) -> (*const Block, usize) {
        (self.0.address, self.0.blocks)
    }
}

#[pymethods]
impl Lease {
    /// See the function of the same name, which may be that of another extension module.
    fn note_export(&self) {
        self.0.exported.store(true, Ordering::Relaxed);
    }
}

/// The buffers of a pool. A new one is allocated if all are in use.
pub struct Buffers {
    buffers: Vec<Arc<Buffer>>,
    allocate: Option<Py<PyAny>>,
}

impl Buffers {
    /// `allocate` returns, for a number of bytes, a tensor of zeroed memory that nothing else uses; it must not run Python code,
    /// where a signal handler could call the pool. `None` for memory of this library.
    pub fn new(allocate: Option<Py<PyAny>>) -> Self {
        Buffers { buffers: Vec::new(), allocate }
    }

    /// A buffer without arrays, and its index. Its frames are forgotten if Python code may have written to them.
    pub fn free(&mut self, py: Python<'_>, layout: &Layout) -> PyResult<(usize, &mut [Block])> {
        let free = self.buffers.iter_mut().rposition(|buffer| Arc::get_mut(buffer).is_some());
        let index = match free {
            Some(index) => index,
            None => {
                let blocks = layout.blocks();
                self.buffers.push(Arc::new(match &self.allocate {
                    Some(allocate) => Buffer::allocated(blocks, allocate.bind(py))?,
                    None => Buffer::new(blocks),
                }));
                self.buffers.len() - 1
            }
        };
        let Some(buffer) = Arc::get_mut(&mut self.buffers[index]) else { return Ok((index, &mut [])) };
        // SAFETY: the memory has that many initialised blocks, lives as long as the buffer, and is used by nothing else, since no
        // array exists.
        let blocks = unsafe { std::slice::from_raw_parts_mut(buffer.address, buffer.blocks) };
        if std::mem::take(buffer.exported.get_mut()) {
            layout.forget_frames(blocks);
        }
        Ok((index, blocks))
    }

    /// The owner of the arrays of the buffer with that index.
    pub fn lease(&self, index: usize) -> Lease {
        Lease(Arc::clone(&self.buffers[index]))
    }
}

/// Notes that Python code may write to the buffer that `array` is a view of; the pool then draws its frames in full when it next
/// writes to it. Returns whether `array` is a view of such a buffer.
#[pyfunction]
pub fn note_export(array: &Bound<'_, PyUntypedArray>) -> PyResult<bool> {
    let py = array.py();
    let mut object = array.clone().into_any();
    loop {
        let view = match object.cast_into::<PyUntypedArray>() {
            Ok(view) => view,
            Err(other) => {
                let Some(note) = other.into_inner().getattr_opt("note_export")? else { return Ok(false) };
                return note.call0().map(|_| true);
            }
        };
        // SAFETY: an array's base is an object that the array keeps alive, or null.
        let base = unsafe { Bound::from_borrowed_ptr_or_opt(py, (*view.as_array_ptr()).fields.base) };
        let Some(base) = base else { return Ok(false) };
        object = base;
    }
}

/// A writable view of an array, for libraries that accept no others. Whoever writes to it must own the memory, or have noted the
/// export.
#[pyfunction]
pub fn writable_view<'py>(array: &Bound<'py, PyUntypedArray>) -> PyResult<Bound<'py, PyUntypedArray>> {
    let view = array.call_method0("view")?.cast_into::<PyUntypedArray>()?;
    // SAFETY: the view is a new object, which nothing else refers to.
    unsafe { (*view.as_array_ptr()).fields.flags |= NPY_ARRAY_WRITEABLE };
    Ok(view)
}
