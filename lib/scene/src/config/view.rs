//! Other photographs of the place, `[[scene.views]]`.
use super::*;
use crate::views::ViewSettings;

/// One `[[scene.views]]` table as written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ViewConfig {
    /// The photograph, encoded as `scene.transfer` says.
    #[schemars(extend("format" = "path"), extend("x-default" = "none; required"), example = &"behind.jpg")]
    pub background: Option<PathBuf>,
    /// How much more than the scene's photograph it is exposed, stops.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = -30, max = 30), extend("x-default" = "what the Exif data of both tell, 0 for EXR and HDR; else what both pictures show"), example = 0.0)]
    pub exposure_stops: Option<f64>,
    /// Where it was taken from: the keys of `[scene.camera]`. Without `file` and direction it is a camera of the scene's
    /// `file`, by `image`, `frame` or the photograph's name. The position may be left out, and the field of view if
    /// Exif data tell it or the scene's camera has the same.
    pub camera: Option<CameraConfig>,
}

impl SceneConfig {
    /// The other photographs of the place; checks their keys, those of `[scene.camera]` and `scene.transfer`.
    pub fn views(&self) -> Result<Vec<ViewSettings>, Error> {
        let of =
            |(k, view): (usize, &ViewConfig)| view.validate(&format!("scene.views[{k}]"), self);
        self.views.iter().enumerate().map(of).collect()
    }
}

impl SceneConfig {
    /// The scene's own photograph, as one of several of the place.
    ///
    /// # Errors
    /// If `scene.background` is missing, or a key of `[scene.camera]` or `scene.transfer` is wrong.
    pub fn own_view(&self) -> Result<ViewSettings, Error> {
        let key = "scene.background";
        let background = self
            .background
            .clone()
            .ok_or_else(|| missing(key, "name the photograph: background = \"photo.jpg\""))?;
        let camera = self.camera.clone().unwrap_or_default();
        Ok(ViewSettings {
            key: key.into(),
            camera: camera.validate(&background)?,
            config: ViewConfig {
                background: Some(background.clone()),
                exposure_stops: None,
                camera: Some(camera),
            },
            background,
            exposure_stops: None,
            is_placed: true,
            transfer: self.transfer()?,
            limits: self.limits,
        })
    }
}

impl ViewConfig {
    fn validate(&self, at: &str, scene: &SceneConfig) -> Result<ViewSettings, Error> {
        let key = format!("{at}.background");
        let background = self.background.clone().ok_or_else(|| {
            missing(
                &key,
                "name another photograph of the place: background = \"behind.jpg\"",
            )
        })?;
        named(&key, &background)?;
        if scene.background.as_ref() == Some(&background) {
            let accepted = "another photograph than scene.background";
            return Err(wrong(
                &key,
                format!("\"{}\"", background.display()),
                accepted,
            ));
        }
        if let Some(stops) = self.exposure_stops
            && !(stops.abs() <= 30.0)
        {
            return Err(wrong(
                &format!("{at}.exposure_stops"),
                stops,
                "stops from -30 to 30, for instance exposure_stops = 1.0",
            ));
        }
        let camera = self.camera(scene, at)?;
        let moved = |e: Error| e.moved("scene.camera", &format!("{at}.camera"));
        let settings = camera.validate(&background).map_err(moved)?;
        Ok(ViewSettings {
            key,
            config: Self {
                camera: Some(camera),
                ..self.clone()
            },
            background,
            exposure_stops: self.exposure_stops,
            is_placed: !self.lacks_position(),
            camera: settings,
            transfer: scene.transfer()?,
            limits: scene.limits,
        })
    }

    /// Whether only the direction of its camera is written.
    fn lacks_position(&self) -> bool {
        let own = self.camera.as_ref();
        own.is_some_and(|own| own.is_turned() && own.file.is_none() && own.position.is_none())
    }

    /// Its camera with what it takes from the scene's.
    fn camera(&self, scene: &SceneConfig, at: &str) -> Result<CameraConfig, Error> {
        let own = self.camera.clone().unwrap_or_default();
        if own.file.is_some() || own.transforms.is_some() || own.look_at.is_some() {
            return Ok(own);
        }
        if own.is_turned() {
            let position = own.position.or(Some([0.0; 3]));
            return Ok(CameraConfig { position, ..own });
        }
        let of_scene = scene.camera.clone().unwrap_or_default();
        let Some(file) = of_scene.file.or(of_scene.transforms) else {
            return Err(missing(
                &format!("{at}.camera"),
                "write where the photograph looks, as in camera = { heading_deg = 90.0, pitch_deg = -5.0 }, or name a file \
                 of cameras",
            ));
        };
        Ok(CameraConfig {
            file: Some(file),
            file_up: own
                .file_up
                .clone()
                .or(of_scene.file_up)
                .or(of_scene.transforms_up),
            file_scale: own.file_scale.or(of_scene.file_scale),
            file_rotation_order: own
                .file_rotation_order
                .clone()
                .or(of_scene.file_rotation_order),
            ..own
        })
    }
}
