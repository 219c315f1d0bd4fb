//! CPU kernels on plain f32 slices: the fast paths behind the layers.
//!
//! Work is cut into jobs by shape alone, never by the number of threads, and
//! sums run in a fixed order: the same inputs give the same bytes on any
//! number of threads.

pub(crate) mod attention;
pub(crate) mod conv;
pub(crate) mod matmul;
pub(crate) mod norm;
pub(crate) mod pointwise;
pub(crate) mod simd;
pub(crate) mod tensor;

/// A pointer that may cross threads: every user writes disjoint elements.
#[derive(Clone, Copy)]
pub(crate) struct SharedMut(pub *mut f32);

// SAFETY: the kernels that share it write disjoint ranges from their jobs.
unsafe impl Send for SharedMut {}
// SAFETY: as above.
unsafe impl Sync for SharedMut {}

impl SharedMut {
    pub(crate) fn new(values: &mut [f32]) -> Self {
        Self(values.as_mut_ptr())
    }

    /// The pointer to element `offset`.
    ///
    /// # Safety
    /// `offset` lies inside the slice that this was made from.
    pub(crate) unsafe fn at(self, offset: usize) -> *mut f32 {
        // SAFETY: by the caller's contract.
        unsafe { self.0.add(offset) }
    }
}
