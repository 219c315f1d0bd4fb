//! Scores of pictures and lights, medians with intervals, Pareto fronts, files of results, and the counts of a user
//! study. Nothing here renders or starts programs, and nothing of the pipeline imports it.
pub mod front;
pub mod lpips;
pub mod results;
pub mod scores;
pub mod study;
pub mod summary;
