//! Points in files of every format that is known.
use std::path::{Path, PathBuf};

use dipir_cameras::{Camera, WorldUp, colmap, kitti, nuscenes};
use glam::{DMat3, DVec3};

use crate::cloud::{Cloud, Collector};
use crate::error::PointsError;
use crate::{depth, pcd, ply};

/// Where points come from, and how their coordinates become the scene's.
#[derive(Clone, Debug, PartialEq)]
pub struct Source<'a> {
    /// `.ply`, `.pcd`, `.bin`, `.exr` or `.png` with depths, COLMAP's folder or project, or its `points3D`.
    pub path: &'a Path,
    /// Which axis of the file points up; by default +z, +y for `.ply`, -y for COLMAP. Depth maps have none.
    pub up: Option<WorldUp>,
    /// Metres of a unit of the file; of depths as PNG, a factor on their millimetres.
    pub scale: f64,
    /// Where the sensor stood, not used by depth maps: KITTI's calibration (`.txt`) or a record of nuScenes (`.json`).
    pub pose: Option<&'a Path>,
    /// The photograph's camera, for depth maps.
    pub camera: &'a Camera,
}

/// The file that [`read`] reads at `path`, which may be COLMAP's folder or project.
pub fn part(path: &Path) -> PathBuf {
    match colmap::Files::at(path).filter(|_| path.is_dir()) {
        Some(files) => files.part("points3D"),
        None => path.into(),
    }
}

/// Whether [`read`] takes the file for depths that the photograph's camera sees.
pub fn is_depth(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    matches!(extension.as_deref(), Some("exr" | "png"))
}

/// Which axis of the file at `path` points up where nobody says it; `None` for depths, whose points the camera tells.
pub fn up_of(path: &Path) -> Option<WorldUp> {
    let path = part(path);
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref() {
        _ if is_depth(&path) => None,
        Some("ply") => Some(WorldUp::Y),
        Some("txt" | "bin") if is_colmap(&path) => Some(WorldUp::MinusY),
        _ => Some(WorldUp::Z),
    }
}

fn is_colmap(path: &Path) -> bool {
    path.file_stem().is_some_and(|s| s == "points3D")
}

/// Whether a path of this name stands for COLMAP's points: its `points3D`, or a folder, which may have a dot in its name.
pub fn is_model(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let is_other = matches!(
        extension.as_deref(),
        Some("ply" | "pcd" | "bin" | "txt" | "exr" | "png")
    );
    !is_other || is_colmap(path)
}

/// Reads points.
///
/// # Errors
/// On files that cannot be read, are damaged, or of a kind that is not known.
pub fn read(source: &Source) -> Result<Cloud, PointsError> {
    let path = part(source.path);
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let extension = extension.as_deref().unwrap_or_default();
    if is_depth(&path) {
        if source.up.is_some() || source.pose.is_some() {
            return Err(PointsError::with_remedy(
                "depth",
                "the photograph's camera says where its points are, and points_up and points_pose do not",
                "leave points_up and points_pose out",
            ));
        }
        let depth = match extension {
            "exr" => depth::read_exr(&path)?,
            _ => depth::read_png(&read_bytes(&path)?)?,
        };
        let cloud = depth::points(&depth.map(|z| z * source.scale as f32), source.camera)?;
        return Ok(cloud.near());
    }
    let bytes = read_bytes(&path)?;
    let cloud = match extension {
        "txt" | "bin" if is_colmap(&path) => {
            let points = colmap::read_points(&bytes, extension == "bin", WorldUp::Y)?;
            Cloud {
                points: Collector::of(points),
                viewpoint: None,
            }
        }
        "ply" => ply::read(&bytes)?,
        "pcd" => pcd::read(&bytes)?,
        "bin" => sweep(&bytes)?,
        _ => {
            return Err(PointsError::with_remedy(
                "points'",
                "it is not a kind of file that is known",
                "use .ply, .pcd, .bin (4 or 5 floats a point), points3D of COLMAP, or depths as .exr \
                 or .png",
            ));
        }
    };
    let (rotation, position) = match source.pose {
        None => {
            let up = source.up.or(up_of(&path)).unwrap_or_default();
            (up.to_ours(), DVec3::ZERO)
        }
        Some(pose) => sensor(pose, source.up)?,
    };
    // How far away a point is shows in metres.
    Ok(cloud.moved(source.scale, rotation, position).near())
}

pub(crate) fn read_bytes(path: &Path) -> Result<Vec<u8>, PointsError> {
    dipir_files::read(path).map_err(|source| PointsError::Read {
        path: path.into(),
        source,
    })
}

/// The sensor's rotation and position in our world.
fn sensor(path: &Path, up: Option<WorldUp>) -> Result<(DMat3, DVec3), PointsError> {
    let bytes = read_bytes(path)?;
    dipir_files::refuse_utf16(&bytes).map_err(|source| PointsError::Read {
        path: path.into(),
        source,
    })?;
    let bytes = dipir_files::without_byte_order_mark(&bytes);
    let is_json = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("json"));
    Ok(match is_json {
        true => nuscenes::sensor(bytes, up.unwrap_or(WorldUp::Z))?,
        false if up.is_some() => {
            return Err(PointsError::with_remedy(
                "KITTI",
                "its scanner stands in the world of its camera 0, of which -y points up",
                "leave points_up out",
            ));
        }
        false => kitti::read_scanner(&String::from_utf8_lossy(bytes))?,
    })
}

/// A sweep of a laser scanner: x, y, z and intensity as floats of 32 bits, as in KITTI, or the ring,
/// too, as in nuScenes.
pub fn sweep(bytes: &[u8]) -> Result<Cloud, PointsError> {
    let values = bytes.len() / 4;
    let at = |i: usize| {
        let value = bytes.get(4 * i..).and_then(|b| b.first_chunk());
        value.map_or(f32::NAN, |b| f32::from_le_bytes(*b))
    };
    // The fifth value is the number of a ring; that of four would be a coordinate by chance.
    let is_ring = |i: usize| {
        let ring = at(5 * i + 4);
        ring.fract() == 0.0 && (0.0..256.0).contains(&ring)
    };
    let rings = (0..(values / 5).min(1000)).all(is_ring);
    let width = match (values % 4, values % 5) {
        (_, 0) if rings => 5,
        (0, _) => 4,
        (_, 0) => 5,
        _ => 0,
    };
    if !bytes.len().is_multiple_of(4) || width == 0 || values == 0 {
        return Err(PointsError::new(
            "sweep's",
            format!("{} bytes are no points of four or five floats", bytes.len()),
        ));
    }
    let count = values / width;
    let mut found = Collector::new(count);
    for i in 0..count {
        let [x, y, z] = [0, 1, 2].map(|k| f64::from(at(width * i + k)));
        found.add(DVec3::new(x, y, z));
    }
    Ok(Cloud {
        points: found.points(),
        viewpoint: Some(DVec3::ZERO),
    })
}

/// Points out of the bytes of a PLY file.
///
/// # Errors
/// If they are no PLY file with points.
pub fn ply(bytes: &[u8]) -> Result<Cloud, PointsError> {
    ply::read(bytes)
}

/// Points out of the bytes of a PCD file.
///
/// # Errors
/// If they are no PCD file with points.
pub fn pcd(bytes: &[u8]) -> Result<Cloud, PointsError> {
    pcd::read(bytes)
}

/// The depths in the bytes of a PNG, metres.
///
/// # Errors
/// If they are no grey PNG of 16 bits.
pub fn depth_png(bytes: &[u8]) -> Result<dipir_imaging::raster::Raster<f32>, PointsError> {
    depth::read_png(bytes)
}
