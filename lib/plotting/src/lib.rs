//! Charts as SVG, for pages and as files of their own, and as pixels. Nothing here knows what the
//! numbers mean.
mod axis;
pub mod chart;
pub mod drawing;
pub mod glyphs;
mod pixels;

pub use axis::number;
pub use drawing::STYLE;
pub use pixels::distance_to_segment;
