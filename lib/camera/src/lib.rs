//! Cameras that other programs know.
