//! What measurements say: how far pictures and lights are from the truth, what accuracy costs, and
//! what people prefer. Nothing here renders or starts programs; it is told numbers and pictures.
pub mod chart;
pub mod drawing;
pub mod front;
mod glyphs;
pub mod lpips;
pub mod scores;
pub mod study;
pub mod summary;
