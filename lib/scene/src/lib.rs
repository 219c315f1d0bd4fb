//! What stands in front of the camera: meshes, materials, textures, the camera,
//! the proxy geometry that receives shadows, and the BVH that finds them.
mod assembly;
pub mod bvh;
pub mod camera;
pub mod config;
mod depth_buffer;
pub mod description;
pub mod error;
pub mod export;
pub mod exposure;
pub mod features;
mod files;
pub mod foreground;
pub mod ground;
pub mod import;
pub mod light;
pub mod limits;
pub mod material;
pub mod mesh;
pub mod pixels;
pub mod placement;
pub mod plane_of_pixels;
pub mod plausibility;
pub mod printable;
pub mod proxy;
pub mod ray_offset;
mod rebuilding;
pub mod scene;
pub mod surfaces;
mod taken;
pub mod texture;
pub mod triangle;
pub mod undistortion;
pub mod views;
pub mod visibility;

pub use error::Error;
