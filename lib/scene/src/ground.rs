//! The ground through points, and places on it, for a photograph's camera.
use std::path::{Path, PathBuf};

use dipir_cameras::{Camera as LensCamera, Lens, Pose, WorldUp};
use dipir_imaging::raster::Raster;
use dipir_points::file::Source;
use dipir_points::ground::{Search, Shape};
use dipir_points::place::{self, Body};
use dipir_points::{Cloud, Ground, PointsError};
use glam::{DVec2, DVec3};

use crate::camera::{Camera, named};
use crate::error::Error;
use crate::mesh::TriangleMesh;
use crate::plane_of_pixels::PixelPlane;
use crate::proxy::{Plane, Proxy};
use crate::undistortion::Undistortion;

/// Where points come from.
#[derive(Clone, Debug, PartialEq)]
pub struct PointsSettings {
    /// Their file or folder.
    pub path: PathBuf,
    /// Which axis of it points up; `None` as its format has it.
    pub up: Option<WorldUp>,
    /// Metres of a unit.
    pub scale: f32,
    /// Where the sensor stood.
    pub pose: Option<PathBuf>,
    /// Whether the ground may be other than a plane.
    pub shape: Shape,
}

impl PointsSettings {
    /// The files that are read, as the configuration would name them.
    pub fn parts(&self, base_dir: &Path) -> Vec<PathBuf> {
        points_parts(&self.path, self.pose.as_deref(), base_dir)
    }

    /// Which of several models is read, as a warning.
    pub fn choice(&self, base_dir: &Path) -> Option<String> {
        dipir_cameras::file::choice(&base_dir.join(&self.path))
    }

    /// Which axis of `cloud`, the points as they were read, seems to point up instead of the one that is taken where
    /// nobody says it, as a sentence.
    pub fn doubt(&self, base_dir: &Path, view: &LensCamera, cloud: &Cloud) -> Option<String> {
        let own = dipir_points::file::up_of(&base_dir.join(&self.path))?;
        // COLMAP's points are turned with its cameras.
        if self.up.is_some() || self.pose.is_some() || own == WorldUp::MinusY {
            return None;
        }
        let other = dipir_points::ground::other_up(cloud, &self.search(view), own)?;
        let (own, other) = (own.word(), other.word());
        Some(format!(
            "the camera sees the ground of the points if {other} of their world points up, and {own} is taken: write \
             points_up = {other:?} into [scene.proxy] (dipir init: --points-up), or points_up = {own:?} if that is right"
        ))
    }

    fn search<'a>(&self, view: &'a LensCamera) -> Search<'a> {
        Search {
            camera: view,
            up: DVec3::Y,
            shape: self.shape,
            seed: 0,
        }
    }

    /// Reads the points and finds the ground that `view` sees.
    ///
    /// # Errors
    /// If a file cannot be used, or has no ground.
    pub fn read(&self, base_dir: &Path, view: &LensCamera) -> Result<(Cloud, Ground), Error> {
        let path = base_dir.join(&self.path);
        let pose = self.pose.as_ref().map(|p| base_dir.join(p));
        let source = Source {
            path: &path,
            up: self.up,
            scale: f64::from(self.scale),
            pose: pose.as_deref(),
            camera: view,
        };
        let wrong = |e: PointsError| match e {
            read @ PointsError::Read { .. } => Error::Points(read),
            other => Error::Points(other).in_file(&path),
        };
        let cloud = dipir_points::file::read(&source).map_err(wrong)?;
        let ground = dipir_points::ground(&cloud, &self.search(view));
        let ground = ground.map_err(|e| match e {
            PointsError::NoGround { detail, remedy } => PointsError::NoGround {
                detail,
                remedy: match dipir_points::file::up_of(&path) {
                    Some(WorldUp::MinusY) => LEVEL.into(),
                    _ => self
                        .doubt(base_dir, view, &cloud)
                        .map_or(remedy, Into::into),
                },
            },
            other => other,
        });
        Ok((cloud, ground.map_err(wrong)?))
    }
}

/// What to do about points of COLMAP's without a ground.
const LEVEL: &str = "see whether file_up of the camera or points_up is right; a world that is tilted is levelled by \
                     `colmap model_orientation_aligner`; or write plane";

/// The files that `points` and `points_pose` stand for, as the configuration would name them.
pub fn points_parts(path: &Path, pose: Option<&Path>, base_dir: &Path) -> Vec<PathBuf> {
    let part = dipir_points::file::part(&base_dir.join(path));
    [Some(named(&part, path, base_dir)), pose.map(Into::into)]
        .into_iter()
        .flatten()
        .collect()
}

/// The photograph's camera with its lens.
pub fn view(camera: &Camera, undistortion: Option<&Undistortion>) -> LensCamera {
    let pinhole = Lens {
        principal_px: camera.principal_px.as_dvec2(),
        ..Lens::pinhole(camera.resolution.map(f64::from), camera.focal_px.as_dvec2())
    };
    LensCamera {
        pose: Pose {
            position: camera.position.as_dvec3(),
            rotation: camera.rotation.as_dmat3(),
        },
        lens: undistortion.map_or(pinhole, |u| *u.lens()),
    }
}

/// The proxy that stands for `ground`.
pub(crate) fn proxy(ground: &Ground) -> Proxy {
    let plane = Plane {
        point: ground.point.as_vec3(),
        normal: ground.normal.as_vec3().normalize(),
    };
    let Some(relief) = ground.relief.as_ref().filter(|r| r.is_whole()) else {
        return Proxy::Plane(plane);
    };
    let (corners, indices) = relief.triangles();
    Proxy::Mesh(TriangleMesh {
        positions: corners.into_iter().map(|p| p.as_vec3()).collect(),
        materials: vec![0; indices.len()],
        indices,
        ..TriangleMesh::default()
    })
}

/// The plane that pixels of the photograph lie on, and a warning if their lengths disagree.
///
/// # Errors
/// If the lens shows nothing at a pixel, or no plane below the camera goes through them.
pub fn plane_of(pixels: &PixelPlane, view: &LensCamera) -> Result<(Plane, Option<String>), Error> {
    let mut rays = Vec::new();
    for pixel in &pixels.pixels {
        let ray = view.ray(pixel.as_dvec2());
        rays.push(ray.ok_or_else(|| Error::Config {
            key: "scene.proxy.pixels".into(),
            value: format!("[{:?}, {:?}]", pixel.x, pixel.y),
            accepted: "pixels that the lens shows".into(),
        })?);
    }
    let found = pixels.found(&rays)?;
    let point = view.pose.position - found.height_m * found.normal;
    let warning = (found.misfit > MOST_MISFIT).then(|| {
        format!(
            "scene.proxy.lengths_m: the lengths are off by {:.0}% on the plane that fits them best",
            100.0 * found.misfit
        )
    });
    let plane = Plane {
        point: point.as_vec3(),
        normal: found.normal.as_vec3(),
    };
    Ok((plane, warning))
}

/// Disagreement of known lengths beyond which there is a warning.
const MOST_MISFIT: f64 = 0.05;

/// Finds places for objects.
pub(crate) struct Places<'a> {
    pub(crate) view: LensCamera,
    pub(crate) ground: Option<Ground>,
    pub(crate) cloud: Option<Cloud>,
    pub(crate) occluders: Option<&'a Raster<f32>>,
    pub(crate) undistortion: Option<&'a Undistortion>,
    pub(crate) taken: Vec<(DVec3, Body)>,
    /// What may be wrong with the points.
    pub(crate) doubt: Option<String>,
}

impl Places<'_> {
    /// A foot for `body`; `key` names the object's table.
    pub(crate) fn find(&mut self, body: Body, draw: u32, key: &str) -> Result<DVec3, Error> {
        let Some(ground) = &self.ground else {
            return Err(Error::Missing {
                key: "scene.proxy.points".into(),
                remedy: format!(
                    "{key}.place is looked for on points or a plane: write one of them"
                ),
            });
        };
        let hidden = |pixel: DVec2| {
            let moved = match self.undistortion {
                Some(way) => way.to_working(pixel),
                None => Some(pixel),
            };
            let (Some(mask), Some(p)) = (self.occluders, moved) else {
                return false;
            };
            let (x, y) = (p.x as usize, p.y as usize);
            x < mask.width() && y < mask.height() && *mask.get(x, y) > 0.5
        };
        let search = place::Search {
            camera: &self.view,
            ground,
            cloud: self.cloud.as_ref(),
            taken: &self.taken,
            hidden: &hidden,
            draw,
        };
        let foot = search.place(&body).ok_or_else(|| Error::Config {
            key: format!("{key}.place"),
            value: "\"auto\", and no place is free, seen and whole in the picture".into(),
            accepted: match &self.doubt {
                Some(doubt) => format!("points with their axes as the camera's: {doubt}"),
                None => "a position or at_pixel instead, or a smaller object".into(),
            },
        })?;
        self.taken.push((foot, body));
        Ok(foot)
    }
}

/// A plane as ground.
pub(crate) fn of_plane(plane: &Plane) -> Ground {
    Ground {
        point: plane.point.as_dvec3(),
        normal: plane.normal.as_dvec3().normalize(),
        points: 0,
        inliers: 0,
        residual_m: 0.0,
        relief: None,
    }
}
