//! Parts of a batch that are worked on side by side, each by one thread of its own: small convolutions gain nothing
//! from more.
use std::collections::BTreeMap;

use candle_core::Tensor;
use rayon::prelude::*;

use crate::error::{Error, Result};

/// Parts of a batch. Fixed, so that sums and with them weights are the same on any machine.
pub(crate) const SHARDS: usize = 2;

/// A thread for each part.
pub(crate) struct Shards {
    pools: Vec<rayon::ThreadPool>,
}

impl Shards {
    /// Starts the threads.
    pub fn new() -> Result<Self> {
        let pools = (0..SHARDS)
            .map(|_| rayon::ThreadPoolBuilder::new().num_threads(1).build())
            .collect::<Result<_, _>>()
            .map_err(|e| Error::Argument(format!("cannot start threads: {e}")))?;
        Ok(Self { pools })
    }

    /// What `work` makes of the number of each part.
    pub fn run<T: Send>(&self, work: impl Fn(usize) -> Result<T> + Sync) -> Result<Vec<T>> {
        std::thread::scope(|scope| {
            let work = &work;
            let threads: Vec<_> = self
                .pools
                .iter()
                .enumerate()
                .map(|(shard, pool)| scope.spawn(move || pool.install(|| work(shard))))
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

/// The means of gradients that have the same names.
pub(crate) fn mean_gradients(
    shards: &[BTreeMap<String, Tensor>],
) -> Result<BTreeMap<String, Tensor>> {
    let Some((first, others)) = shards.split_first() else {
        return Ok(BTreeMap::new());
    };
    let names: Vec<&String> = first.keys().collect();
    names
        .into_par_iter()
        .map(|name| {
            let mut sum = first[name].clone();
            for shard in others {
                sum = (sum + &shard[name])?;
            }
            Ok((name.clone(), (sum * (1.0 / shards.len() as f64))?))
        })
        .collect()
}
