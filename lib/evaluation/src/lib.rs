//! What measurements say: how far pictures and lights are from the truth, what accuracy costs, and
//! what people prefer. Nothing here renders or starts programs; it is told numbers and pictures.
pub mod front;
pub mod lpips;
pub mod scores;
pub mod study;
pub mod summary;
