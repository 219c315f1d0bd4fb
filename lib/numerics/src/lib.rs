//! Numerical tools: guarded functions, counter-based random numbers and
//! low-discrepancy samples, warps, deterministic reductions, statistics.
pub mod gradcheck;
pub mod guarded;
pub mod hashing;
pub mod resample;
pub mod sampler;
pub mod stats;
pub mod sum;
pub mod warp;
