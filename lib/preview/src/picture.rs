//! The preview as one picture.
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use dipir_cli::interrupt::{self, Interrupted};
use dipir_cli::session::Session;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_render::error::RenderError;
use dipir_stages::light::at_hand::{Origin, at_hand};
use glam::{DVec2, Vec2, Vec3};

use crate::arrangement::Arrangement;
use crate::canvas::{Layer, Pen};
use crate::draft::{Draft, SAMPLES};
use crate::lines::Kind;
use crate::marks::Marks;
use crate::png;
use crate::small::SmallScene;

/// Longest side of the preview, pixels.
pub const LONGEST: u32 = 1280;

/// What a preview shows.
pub struct Preview {
    /// The photograph with everything drawn over it.
    pub picture: DisplayImage,
    /// What stands where.
    pub arrangement: Arrangement,
    /// Between two lines of the grid, metres.
    pub spacing_m: f64,
    /// Where the draft's light comes from; `None` without a draft.
    pub light: Option<Origin>,
    /// Seconds that it took.
    pub seconds: f64,
}

impl Preview {
    /// Reads the session's project and draws it; with `draft` the objects are rendered.
    ///
    /// # Errors
    /// On a configuration or files that cannot be used, and if the user breaks it off.
    pub fn new(session: &Session, draft: bool) -> anyhow::Result<Self> {
        let clock = Instant::now();
        let (small, arrangement) = SmallScene::load(session, LONGEST)?;
        let photo = &small.loaded.photo;
        let (mut picture, mut alpha, mut light) = (None, None, None);
        if draft {
            let found = at_hand(session, &small.loaded)?;
            let mut go_on = || match interrupt::asked() {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            };
            let drawn = Draft::render(&small.loaded, &found, SAMPLES, &mut go_on);
            let drawn = drawn.map_err(|e| match e {
                RenderError::Interrupted => Interrupted.into(),
                other => anyhow::Error::new(other),
            })?;
            light = Some(found.origin);
            picture = Some(drawn.picture);
            alpha = Some(drawn.alpha);
        }
        let mut picture = picture.unwrap_or_else(|| photo.transfer.encode(&photo.image));
        let marks = Marks::of(&arrangement);
        let scale = picture.0.width() as f64 / f64::from(arrangement.camera.resolution[0]);
        draw(&mut picture, &marks, scale, alpha.as_ref());
        Ok(Self {
            picture,
            arrangement,
            spacing_m: marks.spacing_m,
            light,
            seconds: clock.elapsed().as_secs_f64(),
        })
    }

    /// Writes the picture; a file that this program did not make is not touched.
    ///
    /// # Errors
    /// On such a file, and those of the system.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let (width, height) = (self.picture.0.width(), self.picture.0.height());
        let values = png::values(&self.picture, [0, 0, width, height]);
        let kind = png::Kind::Preview;
        let write = || png::write(path, &png::encode(kind, width, height, &values)?, kind);
        write().with_context(|| format!("cannot write \"{}\"", path.display()))
    }
}

/// How lines look in a picture of 1280 pixels.
fn pen(kind: Kind) -> Pen {
    let pen = |color: [f32; 3], width, opacity| Pen {
        color: Vec3::from_array(color),
        width,
        opacity,
    };
    match kind {
        Kind::Grid => pen([1.0, 1.0, 1.0], 0.8, 0.5),
        Kind::MainGrid => pen([1.0, 1.0, 1.0], 1.3, 0.75),
        Kind::Horizon => pen([1.0, 0.82, 0.25], 1.3, 0.9),
        Kind::Box => pen([0.35, 0.85, 1.0], 1.2, 0.9),
        Kind::Front => pen([1.0, 0.5, 0.1], 2.0, 1.0),
        Kind::Stick => pen([1.0, 1.0, 1.0], 1.6, 1.0),
    }
}

/// Draws `marks`, of a photograph that is one over `scale` as large. The ground's lines are hidden
/// behind what `alpha` covers.
fn draw(picture: &mut DisplayImage, marks: &Marks, scale: f64, alpha: Option<&Raster<f32>>) {
    let (width, height) = (picture.0.width(), picture.0.height());
    let thick = (width.max(height) as f32 / LONGEST as f32).max(0.5);
    let place = |p: DVec2| (p * scale).as_vec2();
    for kind in Kind::ALL {
        let pen = pen(kind);
        let mut layer = Layer::new(width, height);
        for piece in marks.pieces.iter().filter(|p| p.kind == kind) {
            layer.line(
                place(piece.from),
                place(piece.to),
                pen.width * thick,
                piece.opacity,
            );
        }
        let capital = 9.0 * thick;
        if kind == Kind::Stick {
            for label in &marks.labels {
                layer.text(place(label.at), capital, &label.text);
            }
            let text = match marks.spacing_m {
                m if m < 1.0 => "grid 10 cm".into(),
                m => format!("grid {m:.0} m"),
            };
            let at = Vec2::new(5.0 * capital, height as f32 - 1.2 * capital);
            layer.text(at, capital, &text);
        }
        let on_ground = matches!(kind, Kind::Grid | Kind::MainGrid | Kind::Horizon);
        layer.blend(picture, &pen, alpha.filter(|_| on_ground));
    }
}
