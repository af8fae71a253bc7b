//! The threads that act and learn. What they compute does not depend on their number: rows of a batch have the same numbers in every
//! batch, and gradients are summed over a division of a minibatch that depends on its sequences only.

use std::ops::Range;

use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::error::Error;

/// Threads for parts of a computation.
pub struct Threads {
    /// Without one, this thread computes all parts.
    pool: Option<ThreadPool>,
    /// Number of threads, at least 1.
    pub count: usize,
}

impl Threads {
    /// So many threads; 0 for one per core. Fails with [`Error::Threads`] if they cannot be started.
    pub fn new(count: usize) -> Result<Self, Error> {
        let count = if count == 0 { std::thread::available_parallelism().map_or(1, usize::from) } else { count };
        let build = || ThreadPoolBuilder::new().num_threads(count).thread_name(|i| format!("learner {i}")).build();
        let pool = (count > 1).then(build).transpose().map_err(|source| Error::Threads { count, source })?;
        Ok(Threads { pool, count })
    }

    /// Calls `work` with the number of each part and the part.
    pub fn for_each<T: Send>(&self, parts: &mut [T], work: impl Fn(usize, &mut T) + Sync) {
        match &self.pool {
            Some(pool) if parts.len() > 1 => {
                pool.install(|| parts.par_iter_mut().enumerate().for_each(|(i, part)| work(i, part)));
            }
            _ => parts.iter_mut().enumerate().for_each(|(i, part)| work(i, part)),
        }
    }
}

/// The part `i` of `count` parts of about the same size of `0..length`.
pub fn part(length: usize, i: usize, count: usize) -> Range<usize> {
    i * length / count..(i + 1) * length / count
}
