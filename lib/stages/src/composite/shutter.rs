//! Motion blur, as `[composite]` and the cameras of the shot say.
use dipir_cameras::neighbours::Neighbour;
use dipir_imaging::facts::Facts;
use dipir_pipeline::config::Config;
use dipir_pipeline::error::ConfigError;
use dipir_render::optics::Optics;
use dipir_render::shutter::{CameraPose, Shutter};
use dipir_scene::config::SceneConfig;
use dipir_scene::scene::LoadedScene;
use serde_json::{Value, json};

use super::focus;
use super::look::Blurs;
use super::table::CompositeTable;
use crate::scene::with_place;

/// Least length of a line that is seen as one, pixels.
const LEAST_PX: f32 = 0.5;
/// Degrees of a shutter that is open from frame to frame.
const WHOLE_DEG: f32 = 360.0;

impl CompositeTable {
    pub(super) fn check_shutter(&self, config: &Config) -> Result<(), ConfigError> {
        match self.shutter_deg {
            Some(deg) if !(deg > 0.0 && deg <= WHOLE_DEG) => {
                let accepted = "degrees above 0, at most 360, as in 180";
                Err(config.out_of_range("composite.shutter_deg", format!("{deg:?}"), accepted))
            }
            _ => Ok(()),
        }
    }

    /// How the photograph was taken, as far as the table says it.
    ///
    /// # Errors
    /// Where nothing is seen at the pixel that is in focus, where nothing tells how wide the lens was open, and where the
    /// camera's file cannot be read.
    pub fn optics(&self, config: &Config, loaded: &LoadedScene) -> anyhow::Result<Optics> {
        Ok(Optics {
            lens: self.lens(config, loaded)?,
            shutter: self.shutter(config, loaded)?,
        })
    }

    /// What says how the camera moved, as files have it; `None` if nothing does.
    ///
    /// # Errors
    /// Where the camera's file does not tell it.
    pub(crate) fn shutter_params(&self, config: &Config) -> anyhow::Result<Option<Value>> {
        let Some(shutter_deg) = self.shutter_deg else {
            return Ok(None);
        };
        let beside = neighbours(config, None)?;
        if beside == [None; 2] {
            let message = "nothing tells how the camera moves: scene.camera.file has no frame before or after the photograph's. Name \
                           the shot's .chan, glTF, transforms.json or COLMAP model, with numbers at the ends of the pictures' \
                           names, or remove the key";
            return Err(config.invalid("composite.shutter_deg", message).into());
        }
        let told = |n: Neighbour| {
            let (position, rotation) = (n.pose.position, n.pose.rotation);
            json!({"frames": n.frames, "position": position, "rotation": rotation})
        };
        let [before, after] = beside.map(|n| n.map(told));
        Ok(Some(
            json!({"deg": shutter_deg, "before": before, "after": after}),
        ))
    }

    /// The way of the camera while the photograph was taken.
    fn shutter(&self, config: &Config, loaded: &LoadedScene) -> anyhow::Result<Option<Shutter>> {
        let Some(shutter_deg) = self.shutter_deg else {
            return Ok(None);
        };
        let beside = neighbours(config, Some(&loaded.taken().facts))?;
        let middle = CameraPose::of(&loaded.scene.camera);
        let half = 0.5 * shutter_deg / WHOLE_DEG;
        // The way of half of the exposure, towards the neighbour or, by a negative sign, away from it.
        let along = |n: &Neighbour, share: f32| {
            middle.towards(&pose_of(n), share * half / n.frames.unsigned_abs() as f32)
        };
        let (opens, closes) = match &beside {
            [Some(before), Some(after)] => (along(before, 1.0), along(after, 1.0)),
            [Some(before), None] => (along(before, 1.0), along(before, -1.0)),
            [None, Some(after)] => (along(after, -1.0), along(after, 1.0)),
            [None, None] => return Ok(None),
        };
        Ok(Some(Shutter {
            opens,
            middle,
            closes,
        }))
    }
}

/// Where the camera stands in the frames before and after the photograph, of which `facts` are known.
fn neighbours(config: &Config, facts: Option<&Facts>) -> anyhow::Result<[Option<Neighbour>; 2]> {
    let scene: SceneConfig = config.table("scene")?;
    let found = scene.neighbours(facts, &config.base_dir());
    found.map_err(|e| with_place(e, config))
}

fn pose_of(neighbour: &Neighbour) -> CameraPose {
    CameraPose {
        position: neighbour.pose.position.as_vec3(),
        rotation: glam::DQuat::from_mat3(&neighbour.pose.rotation)
            .as_quat()
            .normalize(),
    }
}

/// What of `optics` blurs any object visibly, and how wide it blurs them.
pub fn that_blurs(optics: Optics, loaded: &LoadedScene) -> (Optics, Blurs) {
    let blurs = Blurs {
        out_of_focus_px: optics.lens.map(|lens| focus::blur_px(&lens, loaded)),
        moving_px: (optics.shutter).and_then(|shutter| lines_px(&shutter, loaded)),
    };
    let is_wide = |px: Option<[f32; 2]>, least: f32| px.is_none_or(|[_, most]| most >= least);
    let optics = Optics {
        lens: (optics.lens).filter(|_| is_wide(blurs.out_of_focus_px, focus::LEAST_PX)),
        shutter: (optics.shutter).filter(|_| is_wide(blurs.moving_px, LEAST_PX)),
    };
    (optics, blurs)
}

/// Least and greatest length of the lines that points of the objects are seen as, pixels; `None` if none is before the camera all
/// the time.
fn lines_px(shutter: &Shutter, loaded: &LoadedScene) -> Option<[f32; 2]> {
    let camera = &loaded.scene.camera;
    let [opens, closes] = [-1.0, 1.0].map(|time| shutter.camera(camera, time));
    let length = |p: &glam::Vec3| {
        let middle = camera.project(*p)?;
        let ends = [opens.project(*p)?, closes.project(*p)?];
        Some(ends[0].distance(middle) + middle.distance(ends[1]))
    };
    let lengths = loaded.scene.mesh.positions.iter().filter_map(length);
    let [least, most] = lengths.fold([f32::INFINITY, 0.0], |[least, most], px| {
        [least.min(px), most.max(px)]
    });
    (least <= most).then_some([least, most])
}
