//! How far apart two images are.
use glam::Vec3;

/// Rec.709 luma weights.
pub const LUMA: Vec3 = Vec3::new(0.2126, 0.7152, 0.0722);
