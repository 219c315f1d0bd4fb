//! CPU kernels on plain f32 slices: the fast paths behind the layers.
//!
//! Work is cut into jobs by shape alone, never by the number of threads, and
//! sums run in a fixed order: the same inputs give the same bytes on any
//! number of threads.

pub(crate) mod attention;
pub(crate) mod conv;
pub(crate) mod joining;
mod lanes;
pub(crate) mod matmul;
pub(crate) mod norm;
mod packed;
pub(crate) mod pointwise;
pub(crate) mod simd;
pub(crate) mod tensor;
pub(crate) mod tiles;
mod winograd;

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

/// Buffers that kernels left behind: fresh pages cost as much time as the
/// arithmetic on them.
static POOL: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());
/// Buffers that are kept, their floats in all (512 MiB) and those of the largest.
const POOL_BUFFERS: usize = 6;
const POOL_FLOATS: usize = 128 << 20;
const BUFFER_FLOATS: usize = 64 << 20;

/// Floats of a cache line: loads of a vector register that cross one take twice as long.
const LINE: usize = 16;

/// Runs `f` on a buffer of `len` floats of unspecified content, which starts with a cache line.
pub(crate) fn with_scratch<R>(len: usize, f: impl FnOnce(&mut [f32]) -> R) -> R {
    let needed = len + LINE - 1;
    let pool = || POOL.lock().unwrap_or_else(PoisonError::into_inner);
    let mut buffer = {
        let mut pool = pool();
        // The smallest that is large enough, else a new one.
        let fitting = (0..pool.len())
            .filter(|&i| pool[i].len() >= needed)
            .min_by_key(|&i| pool[i].len());
        fitting.map(|i| pool.swap_remove(i)).unwrap_or_default()
    };
    if buffer.len() < needed {
        buffer = vec![0.0; needed];
    }
    let start = buffer.as_ptr().align_offset(size_of::<f32>() * LINE);
    let result = f(&mut buffer[start..start + len]);
    if buffer.len() <= BUFFER_FLOATS {
        let mut pool = pool();
        pool.push(buffer);
        while pool.len() > POOL_BUFFERS || pool.iter().map(Vec::len).sum::<usize>() > POOL_FLOATS {
            let smallest = (0..pool.len()).min_by_key(|&i| pool[i].len()).unwrap_or(0);
            pool.swap_remove(smallest);
        }
    }
    result
}

/// A new vector of `len` floats that `write` gets the pointer to.
///
/// # Safety
/// `write` writes all of them.
pub(crate) unsafe fn written(len: usize, write: impl FnOnce(*mut f32)) -> Vec<f32> {
    let mut values = Vec::with_capacity(len);
    write(values.as_mut_ptr());
    // SAFETY: there is room for `len`, and by the caller's contract all have been written.
    unsafe { values.set_len(len) };
    values
}

/// A new vector of `len` floats, and what the jobs return that fill its chunks of `chunk`, at least `batch` of them on one
/// thread. Each job gets its number and zeros, which are written only then, into the cache: zeros ahead of all jobs cost a
/// pass over the memory.
pub(crate) fn filled<T: Send>(
    len: usize,
    chunk: usize,
    batch: usize,
    job: impl Fn(usize, &mut [f32]) -> T + Sync,
) -> (Vec<f32>, Vec<T>) {
    assert!(chunk > 0 || len == 0, "chunks of nothing");
    let mut results = vec![];
    let write = |values: *mut f32| {
        let target = SharedMut(values);
        let jobs = (0..len.div_ceil(chunk.max(1))).into_par_iter();
        let run = |index: usize| {
            let first = index * chunk;
            let count = chunk.min(len - first);
            // SAFETY: jobs write disjoint ranges of what `values` has room for, and each is written before it is lent.
            let part = unsafe {
                let start = target.at(first);
                start.write_bytes(0, count);
                std::slice::from_raw_parts_mut(start, count)
            };
            job(index, part)
        };
        jobs.with_min_len(batch)
            .map(run)
            .collect_into_vec(&mut results);
    };
    // SAFETY: the chunks are all of it.
    let values = unsafe { written(len, write) };
    (values, results)
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_are_zeros_of_their_own_and_follow_one_another() {
        for (len, chunk) in [(0, 0), (0, 3), (1, 1), (10, 4), (12, 4), (3, 100)] {
            for batch in [1, 5] {
                // What a buffer held before is not seen.
                drop(vec![f32::NAN; len]);
                let (values, sizes) = filled(len, chunk, batch, |index, part| {
                    assert!(part.iter().all(|&v| v == 0.0));
                    part.fill(index as f32 + 1.0);
                    part.len()
                });
                let wanted: Vec<f32> = (0..len).map(|i| (i / chunk) as f32 + 1.0).collect();
                assert_eq!(values, wanted, "{len} by {chunk}");
                assert_eq!(sizes.iter().sum::<usize>(), len);
            }
        }
    }
}
