//! Importers and whole scenes through the public interface.
mod bad_input;
mod config_table;
mod glb;
mod gltf_import;
mod hostile_input;
mod obj_import;
mod scene_load;
