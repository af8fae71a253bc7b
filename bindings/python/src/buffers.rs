//! Buffers of a pool in this process, and which of them Python code may have written to.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use endless_gym::batch::{BatchBuffer, Block, Layout};
use numpy::npyffi::NPY_ARRAY_WRITEABLE;
use numpy::{PyUntypedArray, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::arrays::Owner;

/// The memory of one batch.
pub struct Buffer {
    blocks: BatchBuffer,
    /// The address of `blocks`, which arrays and tensors use.
    address: *mut Block,
    /// Whether a writable tensor of this memory was exported since the pool last wrote to it.
    exported: AtomicBool,
}

// SAFETY: `address` is used only by arrays and tensors, which numpy and tensor libraries access under Python's rules; Rust code goes
// through `blocks`, and only while no array exists.
unsafe impl Send for Buffer {}
// SAFETY: as for `Send`; a shared reference gives access to the address and to an atomic flag.
unsafe impl Sync for Buffer {}

impl Buffer {
    fn new(blocks: usize) -> Self {
        let mut blocks = BatchBuffer::new(blocks);
        let address = blocks.as_mut_ptr();
        Buffer { blocks, address, exported: AtomicBool::new(false) }
    }
}

/// The owner of the arrays of one batch. The pool writes to the buffer again once all arrays are gone.
#[pyclass(frozen)]
pub struct Lease(Arc<Buffer>);

// SAFETY: the buffer is shared with this value, and `Buffers::free` hands out unshared ones only.
unsafe impl Owner for Lease {
    fn memory(&self) -> (*const Block, usize) {
        (self.0.address, self.0.blocks.len())
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
#[derive(Default)]
pub struct Buffers(Vec<Arc<Buffer>>);

impl Buffers {
    /// A buffer without arrays, and its index. Its frames are forgotten if Python code may have written to them.
    pub fn free(&mut self, layout: &Layout) -> (usize, &mut [Block]) {
        let free = self.0.iter_mut().rposition(|buffer| Arc::get_mut(buffer).is_some());
        let index = free.unwrap_or_else(|| {
            self.0.push(Arc::new(Buffer::new(layout.blocks())));
            self.0.len() - 1
        });
        let Some(buffer) = Arc::get_mut(&mut self.0[index]) else { return (index, &mut []) };
        if std::mem::take(buffer.exported.get_mut()) {
            layout.forget_frames(&mut buffer.blocks);
        }
        (index, &mut buffer.blocks)
    }

    /// The owner of the arrays of the buffer with that index.
    pub fn lease(&self, index: usize) -> Lease {
        Lease(Arc::clone(&self.0[index]))
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
