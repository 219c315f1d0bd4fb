//! Data-parallel gradients: every batch is split into parts of equal size, and each part has one thread. The small
//! convolutions of these networks gain nothing from more.

use std::collections::BTreeMap;

use candle_core::Tensor;
use rayon::prelude::*;

use crate::error::{Error, Result};

/// Parts of a batch. The number is fixed, so that sums and trained weights are the same on any machine.
pub(crate) const PARTS: usize = 2;

/// One thread for every part.
pub(crate) struct Workers {
    pools: Vec<rayon::ThreadPool>,
}

impl Workers {
    /// Starts the threads.
    pub fn new() -> Result<Self> {
        let pools = (0..PARTS)
            .map(|_| rayon::ThreadPoolBuilder::new().num_threads(1).build())
            .collect::<Result<_, _>>()
            .map_err(|e| Error::Argument(format!("cannot start threads: {e}")))?;
        Ok(Self { pools })
    }

    /// Results of `work` for the number of every part.
    pub fn run<T: Send>(&self, work: impl Fn(usize) -> Result<T> + Sync) -> Result<Vec<T>> {
        std::thread::scope(|scope| {
            let work = &work;
            let threads: Vec<_> = self
                .pools
                .iter()
                .enumerate()
                .map(|(part, pool)| scope.spawn(move || pool.install(|| work(part))))
                .collect();
            threads
                .into_iter()
                .map(|t| match t.join() {
                    Ok(result) => result,
                    Err(panic) => std::panic::resume_unwind(panic),
                })
                .collect()
        })
    }
}

/// The mean gradient of every variable; all parts have the same variables.
pub(crate) fn mean_gradients(
    parts: &[BTreeMap<String, Tensor>],
) -> Result<BTreeMap<String, Tensor>> {
    let Some((first, others)) = parts.split_first() else {
        return Ok(BTreeMap::new());
    };
    let names: Vec<&String> = first.keys().collect();
    names
        .into_par_iter()
        .map(|name| {
            let mut sum = first[name].clone();
            for part in others {
                sum = (sum + &part[name])?;
            }
            Ok((name.clone(), (sum * (1.0 / parts.len() as f64))?))
        })
        .collect()
}
