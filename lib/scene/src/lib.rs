//! What stands in front of the camera: meshes, materials, textures, the camera,
//! the proxy geometry that receives shadows, and the BVH that finds them.
pub mod camera;
pub mod config;
pub mod error;
pub mod import;
pub mod material;
pub mod mesh;
pub mod proxy;
pub mod scene;
pub mod texture;

pub use error::Error;
