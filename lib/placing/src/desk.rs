//! A project while it is being arranged.
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use anyhow::{Context, bail};
use dipir_cli::output::json_path;
use dipir_cli::session::Session;
use dipir_imaging::raster::Raster;
use dipir_optimize::settings::LightTable;
use dipir_pipeline::config::Config;
use dipir_pipeline::manifest::plain_reason;
use dipir_preview::arrangement::{Arrangement, Placed};
use dipir_preview::draft::Draft;
use dipir_preview::png;
use dipir_preview::relit::Relit;
use dipir_preview::small::{Props, SmallScene};
use dipir_render::error::RenderError;
use dipir_scene::camera::Camera;
use dipir_scene::config::SceneConfig;
use dipir_scene::pixels::{ground_at, mesh_at};
use dipir_scene::placement::Rest;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::LoadedScene;
use dipir_stages::composite::table::CompositeTable;
use dipir_stages::graph;
use dipir_stages::light::at_hand::{AtHand, at_hand};
use dipir_stages::names::LIGHT;
use glam::DVec2;
use serde_json::{Value, json};

use crate::document::Document;
use crate::drafts::Drafts;
use crate::edit::Edit;
use crate::lens::Lens;
use crate::mask::{MASK_FILE, MaskFile, unwritten};
use crate::readings::Reading;
use crate::relighting::Relighting;
use crate::shown::{description, height_over, view};
use crate::standing::{Grounds, keep_places};
use crate::vanishing::{Lines, Solution, solve};

/// Longest side of the photograph on the page, pixels.
const LONGEST: u32 = 1280;
/// What is said of the project's file then: this page does not know the new text, and must not lose it.
const CHANGED: &str = "was changed by another program: undo that to save what is changed here, or start dipir place \
                       anew to go on from it";

/// The project, its photograph scaled, and what was painted.
pub struct Desk {
    path: PathBuf,
    /// What the command line sets; it holds whatever the page changes, and is not saved.
    overrides: Vec<String>,
    props: Arc<Props>,
    /// The other files of the scene, but the mask that is painted here.
    readings: Vec<Reading>,
    /// The photograph as a PNG, and its size.
    photo: Vec<u8>,
    size: [usize; 2],
    lens: Lens,
    /// The file's text, as it was read or last saved.
    text: Mutex<String>,
    /// Counts texts that were saved; it changes while `text` is held.
    revision: AtomicU64,
    /// What the page painted, row by row; empty if nothing.
    mask: Mutex<Vec<u8>>,
    rendered: Mutex<Rendered>,
    drafts: Drafts,
    /// Counts masks that were painted.
    masks: AtomicU64,
    relighting: Mutex<Relighting>,
}

/// What is rendered: the scene as it is arranged, and its light.
struct Rendered {
    session: Session,
    small: SmallScene,
    /// The mask of the file.
    own_mask: Option<Raster<f32>>,
    /// The light of a configuration, a camera and a ground, onto which a shadow may tell the sun.
    light: Option<(String, AtHand)>,
    /// Why depths hide nothing, where they should.
    left_out: Option<String>,
}

/// A draft that was broken off by a newer one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Superseded;

/// A part of the photograph with objects in it.
pub struct Crop {
    /// 8-bit RGB.
    pub png: Vec<u8>,
    /// First and one past the last column and row of the scaled photograph.
    pub place: [usize; 4],
    /// Where the light comes from, and its sun's azimuth from the view and elevation, degrees.
    pub light: Value,
}

fn held<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What a request that failed left is whole: it is replaced as one.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Desk {
    /// Reads the session's project.
    ///
    /// # Errors
    /// On a configuration or files that cannot be used.
    pub fn open(session: Session) -> anyhow::Result<Self> {
        let path = session.config.path().to_owned();
        let text = dipir_files::read_to_string(&path)
            .with_context(|| format!("cannot read \"{}\"", path.display()))?;
        Document::parse(&text)?.refuse_other_objects(&session.config.table("scene")?)?;
        let (small, arrangement) = SmallScene::load(&session, LONGEST)?;
        for warning in &arrangement.warnings {
            session.warn(warning);
        }
        let painted = path.with_file_name(MASK_FILE);
        let read = small.loaded.inputs.iter().chain(&small.loaded.missing);
        let others = read.map(|i| &i.location).filter(|i| **i != painted);
        let readings = others.map(|i| Reading::new(i)).collect();
        let photo = &small.loaded.photo;
        let picture = photo.transfer.encode(&photo.image);
        let size = [picture.0.width(), picture.0.height()];
        let values = png::values(&picture, [0, 0, size[0], size[1]]);
        Ok(Self {
            path,
            overrides: session.config.overrides().to_vec(),
            props: small.props.clone(),
            readings,
            photo: png::encode(png::Kind::Preview, size[0], size[1], &values)?,
            size,
            lens: Lens(small.loaded.original.as_ref().map(|o| o.undistortion)),
            text: Mutex::new(text),
            revision: AtomicU64::new(0),
            mask: Mutex::default(),
            rendered: Mutex::new(Rendered {
                session,
                own_mask: small.loaded.mask().cloned(),
                small,
                light: None,
                left_out: None,
            }),
            drafts: Drafts::default(),
            masks: AtomicU64::new(0),
            relighting: Mutex::default(),
        })
    }

    /// The photograph as it is shown.
    pub fn photo(&self) -> &[u8] {
        &self.photo
    }

    /// Bytes of a mask: one a pixel of the photograph as it is shown.
    pub fn mask_bytes(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// The mask of the file, as it is shown; nothing if there is none.
    pub fn own_mask(&self) -> Vec<u8> {
        let rendered = held(&self.rendered);
        let mask = rendered.own_mask.as_ref();
        let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        mask.map_or_else(Vec::new, |m| m.pixels().iter().map(byte).collect())
    }

    /// Takes what the page painted.
    ///
    /// # Errors
    /// If it has another size.
    pub fn paint(&self, mask: Vec<u8>) -> anyhow::Result<()> {
        if mask.len() != self.mask_bytes() {
            bail!("a mask has a byte for each of {} pixels", self.mask_bytes());
        }
        *held(&self.mask) = mask;
        self.masks.fetch_add(1, Ordering::SeqCst);
        Ok(())
    }

    /// The file's text with `edit`, and what it means.
    fn edited(&self, edit: &Edit) -> anyhow::Result<(String, Config, Arrangement)> {
        edit.check()?;
        self.check_revision(edit)?;
        let mut document = Document::parse(&held(&self.text))?;
        document.order_objects(&edit.objects)?;
        document.apply_light(&self.lens.light(edit)?)?;
        if (0..edit.objects.len()).any(|i| document.is_looked_for(i).unwrap_or(false)) {
            let (_, before) = self.arranged(&held(&self.text))?;
            keep_places(&mut document, edit, &before)?;
        }
        for (i, object) in edit.objects.iter().enumerate() {
            document.shape(i, object)?;
        }
        if edit.turn.is_some() || edit.height_m.is_some() {
            self.move_camera(&mut document, edit)?;
        }
        if edit.objects.iter().any(|o| o.at.is_some()) {
            self.put_objects(&mut document, edit)?;
        }
        let text = document.text();
        let (config, arrangement) = self.arranged(&text)?;
        Ok((text, config, arrangement))
    }

    /// Refuses an edit of a text that was replaced.
    fn check_revision(&self, edit: &Edit) -> anyhow::Result<()> {
        if edit.revision != self.revision.load(Ordering::SeqCst) {
            bail!(
                "the file was saved since this page read it, as from another tab; reload the page"
            );
        }
        Ok(())
    }

    /// A text of the file with what the command line sets.
    fn config(&self, text: &str) -> anyhow::Result<Config> {
        Ok(Config::parse(&self.path, text, &self.overrides)?)
    }

    fn arranged(&self, text: &str) -> anyhow::Result<(Config, Arrangement)> {
        let config = self.config(text)?;
        let scene: SceneConfig = config.table("scene")?;
        let arrangement = self.props.arranged(&scene)?;
        Ok((config, arrangement))
    }

    /// Turns the camera, then lifts it.
    fn move_camera(&self, document: &mut Document, edit: &Edit) -> anyhow::Result<()> {
        document.refuse_ground_of_depths()?;
        // The camera alone: a turn may leave objects above the horizon that are put elsewhere.
        let camera_of = |document: &Document| -> anyhow::Result<(Camera, Plane)> {
            let (_, arranged) = self.arranged(&held(&self.text))?;
            let config = self.config(&document.text())?;
            let scene: SceneConfig = config.table("scene")?;
            let camera = self.props.camera(&scene)?;
            Ok((camera, arranged.ground()))
        };
        if let Some(turn) = &edit.turn {
            let (camera, _) = camera_of(document)?;
            document.turn(turn, self.lens.fov_deg(turn, &camera)?, &camera)?;
        }
        if let Some(height) = edit.height_m
            && !document.height_over_ground(height)?
        {
            let (camera, ground) = camera_of(document)?;
            let normal = ground.normal.as_dvec3();
            let lift = height - height_over(&camera, &ground);
            document.shift_camera(&camera, normal * lift)?;
        }
        Ok(())
    }

    fn put_objects(&self, document: &mut Document, edit: &Edit) -> anyhow::Result<()> {
        let config = self.config(&document.text())?;
        let scene: SceneConfig = config.table("scene")?;
        let camera = self.props.camera(&scene)?;
        let objects = scene.validate()?.objects;
        let (_, before) = self.arranged(&held(&self.text))?;
        let after = match self.props.plane(&scene)? {
            Some(plane) => Proxy::Plane(plane),
            None => before.proxy.clone(),
        };
        let grounds = Grounds {
            before: &before.proxy,
            after: &after,
        };
        for (i, object) in edit.objects.iter().enumerate() {
            let Some(at) = object.at else { continue };
            let pixel = DVec2::from_array(at);
            let none = match after {
                Proxy::Mesh(_) => "no ground is seen there",
                _ => "no ground is seen there: it is above the horizon",
            };
            if document.is_by_position(i)? {
                let (placed, rest) = (&before.objects[object.of], objects[i].placement.rest);
                let point = grounds.point_at(&camera, placed, rest, pixel);
                document.put_at(i, point.context(none)?)?;
                continue;
            }
            let is_seen = match &after {
                Proxy::Mesh(mesh) => mesh_at(&camera, mesh, pixel).is_some(),
                Proxy::Plane(plane) => ground_at(&camera, plane, pixel).is_some(),
                // What the file lacks is said where it is read.
                Proxy::None => true,
            };
            let rests = objects[i].placement.rest == Some(Rest::Surface);
            if !(is_seen || rests && self.props.shows_surface(&camera, pixel)) {
                bail!(none);
            }
            document.put_at_pixel(i, self.lens.to_photo(at)?)?;
        }
        Ok(())
    }

    /// What the page shows before anything is changed.
    ///
    /// # Errors
    /// If the file cannot be used any more.
    pub fn state(&self) -> anyhow::Result<Value> {
        let (text, revision) = {
            let text = held(&self.text);
            (text.clone(), self.revision.load(Ordering::SeqCst))
        };
        let (config, arrangement) = self.arranged(&text)?;
        let exposure = config.table::<CompositeTable>("composite")?;
        // What is wrong with it, the picture says.
        let light = config.table::<LightTable>("light");
        let models = &self.props.models;
        let name = |o: &Placed| {
            let name = models[o.model].path.file_stem().unwrap_or_default();
            name.to_string_lossy().into_owned()
        };
        let edit = Edit {
            revision,
            ..Edit::none(arrangement.objects.len())
        };
        Ok(json!({
            "file": json_path(&self.path),
            "size": arrangement.camera.resolution,
            "shown": self.size,
            "border": self.lens.border(&arrangement.camera),
            "names": arrangement.objects.iter().map(name).collect::<Vec<_>>(),
            "exposure_ev": exposure.exposure_ev,
            "shadow": light.is_ok_and(|l| l.shadow.is_some()),
            "edit": edit,
            "view": self.shown(&arrangement, true),
        }))
    }

    fn shown(&self, arrangement: &Arrangement, grid: bool) -> Value {
        let mut shown = view(arrangement, grid);
        shown["undistorted"] = self.lens.bends().into();
        if let Some(warnings) = shown["warnings"].as_array_mut() {
            warnings.extend(self.changes().into_iter().map(Value::from));
        }
        shown
    }

    /// What became of the files that were read, one sentence each.
    fn changes(&self) -> Vec<String> {
        let name = self.path.display();
        let text = match dipir_files::read_to_string(&self.path) {
            Ok(text) if text == *held(&self.text) => None,
            Ok(_) => Some(format!("\"{name}\" {CHANGED}")),
            Err(e) => Some(format!("cannot read \"{name}\": {}", plain_reason(&e))),
        };
        let others = self.readings.iter().filter_map(Reading::change);
        text.into_iter().chain(others).collect()
    }

    /// Lines and numbers of an edit; with `grid`, the ground's, too.
    ///
    /// # Errors
    /// If it cannot be.
    pub fn view(&self, edit: &Edit, grid: bool) -> anyhow::Result<Value> {
        let (_, _, arrangement) = self.edited(edit)?;
        Ok(self.shown(&arrangement, grid))
    }

    /// The camera that sees `lines`.
    ///
    /// # Errors
    /// If there is none.
    pub fn solve(&self, edit: &Edit, lines: &Lines) -> anyhow::Result<Solution> {
        let (_, _, arrangement) = self.edited(edit)?;
        solve(lines, &arrangement.camera, self.lens.focal())
    }

    /// The height of the camera at which two pixels of the ground are `length_m` apart.
    ///
    /// # Errors
    /// If no ground is seen at one of the pixels, or both show the same point.
    pub fn measure(&self, edit: &Edit, ends: [[f64; 2]; 2], length_m: f64) -> anyhow::Result<f64> {
        if !(length_m > 0.0 && length_m.is_finite()) {
            bail!("a length is above 0 m");
        }
        let (_, _, arrangement) = self.edited(edit)?;
        let (camera, ground) = (&arrangement.camera, arrangement.ground());
        let point = |p| ground_at(camera, &ground, DVec2::from_array(p));
        let [a, b] = ends.map(point);
        let (Some(a), Some(b)) = (a, b) else {
            bail!("both ends lie on the ground, below the horizon");
        };
        let found = a.distance(b);
        if found < 1e-6 {
            bail!("both ends are the same");
        }
        Ok(height_over(camera, &ground) * length_m / found)
    }

    /// Renders the objects; `None` if they change nothing. A newer call of the same `tab` breaks an
    /// older one off.
    ///
    /// # Errors
    /// If it cannot be, and [`Superseded`].
    pub fn draft(
        &self,
        edit: &Edit,
        samples: u32,
        tab: u32,
    ) -> anyhow::Result<Result<Option<Crop>, Superseded>> {
        let go_on = self.drafts.newest(tab);
        let (_, config, arrangement) = self.edited(edit)?;
        let mut rendered = held(&self.rendered);
        if go_on().is_break() {
            return Ok(Err(Superseded));
        }
        let (loaded, light, words) = self.arrange(&mut rendered, edit, &arrangement, config)?;
        let draft = match Draft::render(loaded, light, samples, &mut || go_on()) {
            Err(RenderError::Interrupted) => return Ok(Err(Superseded)),
            other => other?,
        };
        let mut light = description(light, words, &arrangement.camera);
        if let Some(why) = &rendered.left_out {
            light["origin"] = format!("{words}. {why}").into();
        }
        let Some(place) = draft.touched else {
            return Ok(Ok(None));
        };
        let [x0, y0, x1, y1] = place;
        let values = png::values(&draft.picture, place);
        Ok(Ok(Some(Crop {
            png: png::encode(png::Kind::Preview, x1 - x0, y1 - y0, &values)?,
            place,
            light,
        })))
    }

    /// The objects as `edit` places them, their light and where it comes from.
    fn arrange<'a>(
        &self,
        to: &'a mut Rendered,
        edit: &Edit,
        arrangement: &Arrangement,
        config: Config,
    ) -> anyhow::Result<(&'a LoadedScene, &'a AtHand, &'static str)> {
        to.left_out = None;
        to.small.arrange(arrangement);
        to.session.config = config;
        let mask = self.occluders(edit, to.own_mask.as_ref());
        to.left_out = to.small.loaded.hide_if_known(mask);
        // A light that a run refuses is not shown first and refused when it is saved.
        if edit.sun.is_some() || edit.shadow.is_some() {
            assess(&to.session, LIGHT.name)?;
        }
        to.light_up()
    }

    /// The objects under another sun or exposure, at a low resolution and many times a second: they are
    /// recorded first, unless they stand as they did the last time. `None` if they change nothing.
    /// A newer draft of the same `tab` breaks it off, and it breaks off older ones.
    ///
    /// # Errors
    /// If it cannot be, and [`Superseded`].
    pub fn relight(
        &self,
        edit: &Edit,
        tab: u32,
    ) -> anyhow::Result<Result<Option<Crop>, Superseded>> {
        let go_on = self.drafts.newest(tab);
        let mut relighting = held(&self.relighting);
        let masks = self.masks.load(Ordering::SeqCst);
        let key = format!("{masks} {:?} {}", edit.without_light(), held(&self.text));
        if !relighting.is_recorded(&key) || !relighting.is_lit(&key, edit) {
            let (_, config, arrangement) = self.edited(edit)?;
            let mut rendered = held(&self.rendered);
            if go_on().is_break() {
                return Ok(Err(Superseded));
            }
            let (loaded, light, words) = self.arrange(&mut rendered, edit, &arrangement, config)?;
            if !relighting.is_recorded(&key) {
                // Two records are never held at once.
                relighting.keep(None);
                let normal = arrangement.ground().normal;
                match Relit::record(loaded, normal, light, go_on) {
                    Err(RenderError::Interrupted) => return Ok(Err(Superseded)),
                    other => relighting.keep(Some((key.clone(), other?, arrangement.camera))),
                }
            }
            let text = held(&self.text).clone();
            let said: CompositeTable = self.config(&text)?.table("composite")?;
            let said_ev = f64::from(said.exposure_ev);
            relighting.light_up(&key, edit, said_ev, (light, words));
        }
        let Some((piece, light)) = relighting.picture(edit)? else {
            return Ok(Ok(None));
        };
        let place = piece.place;
        let [w, h] = [place[2] - place[0], place[3] - place[1]];
        let values = png::values(&piece.picture, [0, 0, w, h]);
        Ok(Ok(Some(Crop {
            png: png::encode(png::Kind::Preview, w, h, &values)?,
            place,
            light,
        })))
    }

    fn occluders(&self, edit: &Edit, own: Option<&Raster<f32>>) -> Option<Raster<f32>> {
        let painted = held(&self.mask);
        match edit.mask && !painted.is_empty() {
            true => Some(self.raster(&painted)),
            false => own.cloned(),
        }
    }

    fn raster(&self, painted: &[u8]) -> Raster<f32> {
        let values = painted.iter().map(|&b| f32::from(b) / 255.0);
        Raster::from_pixels(self.size[0], self.size[1], values.collect())
    }

    /// Writes the file and, if one was painted, the mask; what was written, one line each.
    ///
    /// # Errors
    /// If it cannot be, or the file was changed by another program or saved since it was read. The
    /// file stays as it is then, and an earlier mask too.
    pub fn save(&self, edit: &Edit) -> anyhow::Result<Vec<String>> {
        let (text, _, arrangement) = self.edited(edit)?;
        let mut document = Document::parse(&text)?;
        let painted = held(&self.mask).clone();
        let wanted = edit.mask && !painted.is_empty();
        let mut mask = match wanted {
            true => Some(MaskFile::beside(&self.path)?),
            false => None,
        };
        if wanted {
            document.occluders(MASK_FILE)?;
        }
        let text = document.text();
        // What is saved is to be right without the command line, too.
        let alone = Config::parse(&self.path, &text, &[])?;
        alone.table::<SceneConfig>("scene")?.validate()?;
        let config = self.config(&text)?;
        let mut rendered = held(&self.rendered);
        let mut base = held(&self.text);
        // Another save may have come between.
        self.check_revision(edit)?;
        let found = dipir_files::read_to_string(&self.path)
            .with_context(|| format!("cannot read \"{}\"", self.path.display()))?;
        if found != *base {
            bail!("\"{}\" {CHANGED}", self.path.display());
        }
        // Every table is read once more, and the light found, as a run would.
        self.arrange(&mut rendered, edit, &arrangement, config)?;
        if let Some(why) = &rendered.left_out {
            bail!("{why}");
        }
        assess(&rendered.session, graph::LAST)?;
        let mut written = Vec::new();
        if let Some(mask) = &mut mask {
            let size = arrangement.camera.resolution;
            mask.write(&self.lens.mask(&self.raster(&painted), size))?;
            written.push(mask.path.display().to_string());
        }
        if let Err(e) = dipir_files::rewrite(&self.path, base.as_bytes(), text.as_bytes()) {
            // The file as it is goes with the mask as it was.
            if let Some(mask) = &mask {
                mask.restore()?;
            }
            return Err(unwritten(&self.path, &e));
        }
        if mask.is_some() {
            rendered.own_mask = Some(self.raster(&painted));
        }
        written.push(self.path.display().to_string());
        if text != *base {
            self.revision.fetch_add(1, Ordering::SeqCst);
        }
        *base = text;
        Ok(written)
    }
}

impl Rendered {
    /// The objects, their light and where it comes from. It is found unless it is that of the same camera, ground and keys
    /// as before.
    fn light_up(&mut self) -> anyhow::Result<(&LoadedScene, &AtHand, &'static str)> {
        let config = &self.session.config;
        let light: LightTable = config.table("light")?;
        let composite: CompositeTable = config.table("composite")?;
        let (camera, plane) = (self.small.loaded.scene.camera, self.small.plane());
        let key = format!("{light:?} {composite:?} {camera:?} {plane:?}");
        let known = self.light.take().filter(|(known, _)| *known == key);
        let light = match known {
            Some((_, light)) => light,
            None => at_hand(&self.session, &self.small.loaded)?,
        };
        let (_, light) = self.light.insert((key, light));
        let words = light.origin.words_of(&self.session)?;
        Ok((&self.small.loaded, light, words))
    }
}

/// Errors on what a run up to `stage` refuses.
fn assess(session: &Session, stage: &str) -> anyhow::Result<()> {
    let graph = graph::graph(session)?;
    graph::assess(session, &graph, &graph.up_to(stage))?;
    Ok(())
}
