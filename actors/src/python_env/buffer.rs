//! Accesses arrays that Python allocates.

use std::ptr::NonNull;

use pyo3::{
    buffer::{Element, PyBuffer},
    prelude::*,
};

use super::PythonError;

/// A C-contiguous array, accessed through the buffer protocol.
///
/// The protocol is part of Python, and pyo3 checks type and layout. The `numpy` crate would be
/// another dependency, whose versions depend on pyo3's.
///
/// While the buffer is held, Python cannot move or resize the memory, so the pointer stays valid.
/// Python writes only during the calls of [`super::PythonEnvironments`], which take `&mut self`.
/// Slices borrow from that struct, so no slice exists during a call. A thread of an environment
/// that keeps an array and writes into it between calls would break this, which nothing can
/// prevent; `segment_env.SegmentBuffers` forbids it.
pub(super) struct SharedBuffer<T> {
    slice: NonNull<[T]>,
    _owner: PyBuffer<T>,
}

// SAFETY: the memory belongs to the Python object that `_owner` (itself Send and Sync) keeps
// alive; access follows the borrow of this struct. T is a plain number.
unsafe impl<T: Send> Send for SharedBuffer<T> {}
// SAFETY: as above; `&self` only reads.
unsafe impl<T: Sync> Sync for SharedBuffer<T> {}

impl<T: Element> SharedBuffer<T> {
    /// Acquires the buffer of attribute `name` of `buffers`, which must have `len` elements.
    pub(super) fn new(
        buffers: &Bound<'_, PyAny>,
        name: &'static str,
        len: usize,
        task_id: &str,
    ) -> Result<Self, PythonError> {
        let wrong = |reason| PythonError::Interface { task_id: task_id.to_owned(), name, reason };
        let owner: PyBuffer<T> = buffers
            .getattr(name)
            .and_then(|array| PyBuffer::get(&array))
            .map_err(|error| wrong(error.to_string()))?;
        if owner.readonly() {
            return Err(wrong("it is read-only".to_owned()));
        }
        let slice = owner.as_slice_ptr().ok_or_else(|| wrong("it is not contiguous".to_owned()))?;
        if slice.len() != len {
            return Err(PythonError::Length {
                task_id: task_id.to_owned(),
                name,
                expected: len,
                got: slice.len(),
            });
        }
        Ok(Self { slice, _owner: owner })
    }

    pub(super) fn get(&self) -> &[T] {
        // SAFETY: the memory is aligned and initialised (NumPy allocated it, pyo3 checked the
        // type), lives as long as `_owner`, and is written only through `&mut` of the struct that
        // owns this one.
        unsafe { self.slice.as_ref() }
    }

    pub(super) fn get_mut(&mut self) -> &mut [T] {
        // SAFETY: as `get`; `&mut self` excludes every other slice.
        unsafe { self.slice.as_mut() }
    }
}
