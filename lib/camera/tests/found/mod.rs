//! What is found in a file of several cameras.
use dipir_cameras::file::{self, Wanted, Which};

/// Where the camera stands that is found in a file of this name.
pub fn found_x(name: &str, text: &str, which: Which) -> Result<f64, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, text).unwrap();
    let wanted = Wanted {
        size: [600.0, 400.0],
        which,
        up: None,
        fov_deg: None,
        turns: None,
    };
    let found = file::read(&path, &wanted).map_err(|e| e.to_string())?;
    Ok(found.pose.unwrap().position.x)
}
