//! Pixels of the page and of the photograph. Of a lens that bends lines the page shows the undistorted photograph;
//! `pipeline.toml` and the mask have the pixels of the photograph as it was taken.
use anyhow::bail;
use dipir_imaging::raster::Raster;
use dipir_imaging::resize::{Filter, resize};
use dipir_scene::camera::Camera;
use dipir_scene::undistortion::Undistortion;
use glam::DVec2;

use crate::edit::{Edit, Turn};
use crate::vanishing::{Focal, turn_of_camera};

/// Pieces of a side of the photograph's border.
const STEPS: usize = 64;

/// What the page undoes: nothing of a lens that bends no lines.
pub(crate) struct Lens(pub(crate) Option<Undistortion>);

impl Lens {
    /// Whether the page shows another picture than the photograph.
    pub(crate) fn bends(&self) -> bool {
        self.0.is_some()
    }

    /// Coefficients hold for the focal length that they were measured with.
    pub(crate) fn focal(&self) -> Focal {
        match self.bends() {
            true => Focal::Known,
            false => Focal::Unsure,
        }
    }

    /// The pixel of the photograph that shows what is shown at `pixel`, to a tenth of a pixel as the file has it, if the
    /// lens bends lines.
    ///
    /// # Errors
    /// If the photograph does not show it.
    pub(crate) fn to_photo(&self, pixel: [f64; 2]) -> anyhow::Result<[f64; 2]> {
        let Some(way) = &self.0 else {
            return Ok(pixel);
        };
        let [w, h] = way.lens().size;
        let found = way.to_photo(DVec2::from_array(pixel));
        let found = found.map(|p| (p * 10.0).round() / 10.0);
        match found {
            Some(p)
                if (0.0..=w).contains(&p.x)
                    && (0.0..=h).contains(&p.y)
                    // A run goes the other way.
                    && way.to_working(p).is_some() =>
            {
                Ok(p.to_array())
            }
            _ => bail!(
                "the photograph does not show this place: without its lens's distortion the picture reaches farther"
            ),
        }
    }

    /// The photograph's border as `camera`, the one that is shown, sees it, pixels; beyond it nothing is known. Nothing of
    /// a lens that bends no lines.
    pub(crate) fn border(&self, camera: &Camera) -> Vec<[f64; 2]> {
        let Some(way) = &self.0 else {
            return Vec::new();
        };
        let size = DVec2::from_array(way.lens().size);
        let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(DVec2::from_array);
        let shown = |i: usize| {
            let (side, share) = (i / STEPS, (i % STEPS) as f64 / STEPS as f64);
            let pixel = size * corners[side].lerp(corners[(side + 1) % 4], share);
            // What is not shown lies far away in the same direction.
            let beyond =
                || camera.principal_px.as_dvec2() + (pixel - way.lens().principal_px) * 1e3;
            way.to_working(pixel).unwrap_or_else(beyond).to_array()
        };
        (0..4 * STEPS).map(shown).collect()
    }

    /// `edit` with its shadow in pixels of the photograph.
    ///
    /// # Errors
    /// If the photograph does not show an end of the shadow.
    pub(crate) fn light(&self, edit: &Edit) -> anyhow::Result<Edit> {
        let mut edit = edit.clone();
        if let Some(shadow) = &mut edit.shadow {
            shadow.foot = self.to_photo(shadow.foot)?;
            shadow.tip = self.to_photo(shadow.tip)?;
        }
        Ok(edit)
    }

    /// The field of view that the file is to say; `None` if it says the lens, whose coefficients hold for one alone.
    ///
    /// # Errors
    /// If `turn` changes that one; `camera` is the one that is shown.
    pub(crate) fn fov_deg(&self, turn: &Turn, camera: &Camera) -> anyhow::Result<Option<f64>> {
        if !self.bends() {
            return Ok(Some(turn.fov_deg));
        }
        // Up to what JSON rounds.
        if (turn.fov_deg - turn_of_camera(camera).fov_deg).abs() > 1e-6 {
            bail!(
                "the coefficients of the lens hold for its field of view, which is not changed here"
            );
        }
        Ok(None)
    }

    /// A mask of the page in the photograph's pixels; the picture that is shown has `size` of them, scaled down.
    pub(crate) fn mask(&self, mask: &Raster<f32>, size: [u32; 2]) -> Raster<f32> {
        let [w, h] = size.map(|n| n as usize);
        let whole = resize(mask, w, h, Filter::Tent);
        match &self.0 {
            Some(way) => way.distort(&whole, 0.0),
            None => whole,
        }
    }
}
