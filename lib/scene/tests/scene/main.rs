//! Importers and whole scenes through the public interface.
mod bad_input;
mod cameras_and_ground;
mod compressed;
mod config_table;
mod exports;
mod glb;
mod gltf_import;
mod gltf_materials;
mod hostile_input;
mod left_out;
mod limits;
mod obj_import;
mod obj_reference;
mod ply_and_stl;
mod scene_load;
mod views;
mod visibility;
