//! Where the sun is: from time and place, from a shadow in the photograph, or as the user states it.
//!
//! Azimuths are degrees clockwise as seen from above. From north, they are a compass bearing. In the
//! world, which knows no north, they count from -z, where a camera looks that is not turned; +x is at
//! 90 degrees.
pub mod direction;
pub mod error;
pub mod position;
pub mod shadow;
pub mod table;
pub mod time;

pub use error::SunError;
