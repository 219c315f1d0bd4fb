//! The composite stage: the object at full quality, its shadow, and the layers of both.
mod curve;
mod focus;
mod lens;
mod look;
mod sharpness;
pub mod shutter;
pub mod table;

use std::borrow::Cow;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::bail;
use dipir_cli::output::json_path;
use dipir_cli::session::{Session, duration};
use dipir_imaging::composite::{composite, composite_pixel};
use dipir_imaging::file::write_picture;
use dipir_imaging::layer_rows::{LayerRows, Packing};
use dipir_imaging::layers::{Layers, Precision};
use dipir_imaging::raster::{LinearImage, Raster};
use dipir_imaging::tone::ToneCurves;
use dipir_light::environment::EnvironmentSampler;
use dipir_light::map_with_lobes::MapWithLobes;
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::StagePlan;
use dipir_render::adaptive::Stop;
use dipir_render::coarse::divisor_for;
use dipir_render::film::Film;
use dipir_render::gloss;
use dipir_render::light::SceneLight;
use dipir_render::optics::Optics;
use dipir_render::render::{Rendered, Renderer, Settings};
use dipir_scene::proxy::Proxy;
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::interruption;
use crate::known_light::{self, Light};
use crate::light::folder::{self as light_folder, Recovered};
use crate::light::{exposed, materials};
use crate::names::{COMPOSITE, begin};
use crate::presets::{self, CompositePreset, Outlook, Preset};
use crate::scene::folder::{self as scene_folder, SceneFolder};
use crate::written;
use curve::Curve;
pub use look::Matched;
use look::{Hidden, Look, Overlay};
use sharpness::odd_sharpness;
use table::{CompositeTable, MAX_SAMPLES};

/// When to stop, from the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StopArgs {
    /// Stop at this display-referred RMSE.
    pub target_error: Option<f32>,
    /// Stop after about this many seconds.
    pub time_budget_s: Option<f64>,
}

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    samples: u64,
    rays: u64,
    error: f64,
    target: Stop,
    /// Object and shadow were rendered at one over this of the photograph's resolution.
    divisor: u32,
    /// Edges at that resolution are no softer than the photograph's.
    is_sharp_enough: bool,
    matched: Matched,
    /// Nothing tells how soft the photograph is.
    is_blur_unknown: bool,
    /// From the start of the run to its end.
    seconds: f64,
    outlook: Outlook,
}

/// How a render went.
struct Course {
    rendered: Rendered,
    /// Seconds that it took.
    seconds: f64,
}

/// Seconds a pixel to put the layers together and write them. A time budget keeps them back.
const WRITING_S_PER_PIXEL: f64 = 3e-7;

/// Everything that the stage reads.
struct Inputs {
    scene: SceneFolder,
    /// Where the object's and the ground's geometry is. It is read when it is written again.
    gbuffer: PathBuf,
}

/// What is taken over from the scene.
const GEOMETRY: [&str; 7] = [
    "depth.Z", "normal.X", "normal.Y", "normal.Z", "albedo.R", "albedo.G", "albedo.B",
];

/// What lights the object.
enum Source {
    /// The map of `[composite] environment`.
    Map(Light),
    /// The lobes that the light stage recovered.
    Recovered(Box<Recovered>),
}

/// Runs the stage.
pub fn run(session: &Session, args: &StopArgs) -> anyhow::Result<Done> {
    let clock = Instant::now();
    let mut table: CompositeTable = session.config.table("composite")?;
    if args.target_error.is_some() || args.time_budget_s.is_some() {
        table.target_error = args.target_error;
        table.time_budget_s = args.time_budget_s;
    }
    table.check(&session.config)?;
    let mut inputs = read(session)?;
    materials::use_recovered(session, &mut inputs.scene)?;
    let glows = table.scale_emission(&mut inputs.scene.loaded.scene);
    table.warn_of_unused(session, glows);
    let proxy = &inputs.scene.loaded.scene.proxy;
    if table.gloss().is_some() && !matches!(proxy, Proxy::Plane(_)) {
        session.warn("composite.ground_roughness: only a plane mirrors the objects, and [scene.proxy] is not one");
    }
    let light = match known_light::known(session, &table)? {
        Some(light) => {
            known_light::warn_of_unused(session)?;
            Source::Map(light)
        }
        None => Source::Recovered(Box::new(light_folder::recovered(
            session,
            &table,
            &inputs.scene.manifest,
        )?)),
    };
    let stop = table.stop(session.pipeline.quality);
    let folder = COMPOSITE.folder(session);
    let reading = clock.elapsed();
    let mut writer = begin(session, plan(session, &table)?)?;
    writer.add_time(reading);
    let curve = Curve::of(table.tone, &light, inputs.scene.loaded.taken());
    if table.shutter_deg.is_some() {
        scene_folder::refuse_other_camera(session, &inputs.scene.manifest)?;
    }
    let optics = table.optics(&session.config, &inputs.scene.loaded)?;
    let (optics, blurs) = shutter::that_blurs(optics, &inputs.scene.loaded);
    let look = Look::of(inputs.scene.loaded.taken(), blurs, &table);
    let resolution = inputs.scene.loaded.scene.camera.resolution;
    let enough = look.enough_pixels(resolution);
    let preset = &presets::of(session.pipeline.quality).composite;
    let wanted = Wanted {
        most_pixels: table.most_pixels(preset, enough),
        stop: within(stop, clock, &inputs),
        tone: curve.curves(),
        optics,
    };
    let course = render(session, &table, wanted, &inputs, &light)?;
    let Course { rendered, .. } = course;
    let effects = inputs.scene.effects.rendered(&rendered);
    writer.write_json("effects", "effects.json", &effects)?;
    let layers = Composite::new(&inputs, rendered.film, rendered.divisor, &curve, &look);
    writer.write_json("look", "look.json", &layers.matched)?;
    let picture = layers.picture()?;
    check_finite(&picture)?;
    let png = writer.output("picture", "composite.png")?;
    write_picture(png, &picture, inputs.scene.loaded.taken())?;
    let in_picture = Precision::of_colour(&picture.0);
    drop(picture);
    let original = inputs.scene.loaded.original.as_ref();
    let mut gbuffer = Layers::read_exr(&inputs.gbuffer)?;
    if let Some(original) = original {
        gbuffer = lens::gbuffer(&gbuffer, &original.undistortion)?;
    }
    let exr = writer.output("layers", "composite.exr")?;
    let rows = layers.to_rows(in_picture, &gbuffer)?;
    rows.packed(packing(stop)).write_exr(exr)?;
    if let Some(original) = original {
        let [distort, undistort] = original.undistortion.st_maps()?;
        distort.write_exr(writer.output("st_distort", "st_distort.exr")?)?;
        undistort.write_exr(writer.output("st_undistort", "st_undistort.exr")?)?;
    }
    writer.set_estimated_error(rendered.error.upper_95);
    let manifest = writer.finish()?;
    let seconds = clock.elapsed().as_secs_f64();
    let error = rendered.error.upper_95;
    // What is not spent on samples stays.
    let foresight = &rendered.foresight;
    let pixels_of = |most: Option<u64>| f64::from(divisor_for(resolution, most)).powi(-2);
    let here = f64::from(rendered.divisor).powi(-2);
    let denoises = |preset: &CompositePreset| table.denoise.unwrap_or(preset.denoise);
    // The same error takes as many samples a pixel at any resolution.
    let with_preset = |preset: &Preset| {
        let preset = &preset.composite;
        let pixels = pixels_of(table.most_pixels(preset, enough)) / here;
        let cost = foresight.cost_with(preset.target_error.into(), denoises(preset));
        seconds + course.seconds * (pixels * cost - 1.0)
    };
    let quality = session.pipeline.quality;
    let outlook = match stop == CompositeTable::default().stop(quality) {
        true => Outlook::beside(quality, |preset| {
            let target = f64::from(preset.composite.target_error);
            Some((with_preset(preset), Some(target)))
        }),
        false => Outlook::around_error(error, with_preset),
    };
    let outlook = outlook.with_guesses(|preset| {
        let preset = &preset.composite;
        foresight.guess(preset.target_error.into(), denoises(preset))
    });
    Ok(Done {
        folder,
        manifest,
        samples: rendered.samples,
        rays: rendered.counts.total(),
        error,
        target: stop,
        divisor: rendered.divisor,
        is_sharp_enough: divisor_for(resolution, enough) >= rendered.divisor,
        matched: layers.matched,
        is_blur_unknown: look.is_blur_unknown(),
        seconds,
        outlook,
    })
}

/// Layers are packed well unless time is short: packing takes longer than everything else there is to write.
fn packing(stop: Stop) -> Packing {
    match stop {
        Stop::TimeBudget(_) => Packing::Quick,
        Stop::Samples(_) | Stop::TargetError(_) => Packing::Small,
    }
}

/// Errors on a picture whose light is beyond all numbers.
fn check_finite(picture: &LinearImage) -> anyhow::Result<()> {
    let Some(at) = picture.0.pixels().iter().position(|p| !p.is_finite()) else {
        return Ok(());
    };
    let width = picture.0.width();
    bail!(
        "the light in column {}, row {} of the picture is beyond what 32-bit numbers hold: lower \
         composite.exposure_ev or emission_ev, or the radiance of the light or of what the object emits",
        at % width,
        at / width
    )
}

/// The rest of a time budget, for sampling: less what has passed since `clock` began, and less the
/// time that writing the result takes.
fn within(stop: Stop, clock: Instant, inputs: &Inputs) -> Stop {
    let Stop::TimeBudget(budget) = stop else {
        return stop;
    };
    let pixels = inputs.scene.loaded.taken().image.0.pixels().len();
    let writing = Duration::from_secs_f64(WRITING_S_PER_PIXEL * pixels as f64);
    Stop::TimeBudget(budget.saturating_sub(clock.elapsed() + writing))
}

/// Reads what the scene stage wrote and the files that it names.
fn read(session: &Session) -> anyhow::Result<Inputs> {
    let scene = SceneFolder::read(session)?;
    let gbuffer = scene.manifest.output(&scene.folder, "gbuffer")?;
    Ok(Inputs { scene, gbuffer })
}

/// What a run would be, from the configuration and the manifests of the stages that it reads.
pub fn plan_of(session: &Session) -> anyhow::Result<StagePlan> {
    plan(session, &session.config.table("composite")?)
}

/// What a run with `table` would be.
fn plan(session: &Session, table: &CompositeTable) -> anyhow::Result<StagePlan> {
    table.check(&session.config)?;
    let shutter = table.shutter_params(&session.config)?;
    let scene = scene_folder::manifest(session)?;
    let known = known_light::known_params(table);
    let mut params = json!({
        "light": known.as_ref().map_or_else(|| light_folder::recovered_params(table), |k| k.0.clone()),
        "tone": table.tone,
        "max_samples": table.max_samples.unwrap_or(MAX_SAMPLES),
        "denoise": table.denoise(session.pipeline.quality),
        "match_blur": table.matches_blur(),
        "match_grain": table.matches_grain(),
        "blur_caustics": table.blur_caustics(session.pipeline.quality),
        "most_pixels": table.most_pixels(&presets::of(session.pipeline.quality).composite, None),
        "stop": match table.stop(session.pipeline.quality) {
            Stop::Samples(n) => json!({"samples": n}),
            Stop::TargetError(e) => json!({"target_error": e}),
            Stop::TimeBudget(t) => json!({"time_budget_s": t.as_secs_f64()}),
        },
    });
    if let Some(gloss) = table.gloss() {
        params["ground"] = json!([gloss.roughness, gloss.reflectance]);
    }
    if let Some(focus) = table.focus_params() {
        params["focus"] = focus;
    }
    if let Some(shutter) = shutter {
        params["shutter"] = shutter;
    }
    if let Some(emission) = table.emission_params() {
        params["emission"] = emission;
    }
    if let Some(follows) = odd_sharpness(table, session.pipeline.quality) {
        params["follow_sharpness"] = follows.into();
    }
    let mut plan = COMPOSITE.plan(session, params);
    scene_folder::add_inputs(&mut plan, &scene, &["scene", "effects", "gbuffer"])?;
    match known {
        Some((_, path)) => plan.input("environment", path, &session.resolve(path))?,
        None => light_folder::add_inputs(session, &mut plan)?,
    }
    materials::add_input(session, &mut plan)?;
    Ok(plan)
}

/// What a render is asked for, beside what the table says itself.
#[derive(Clone, Copy)]
struct Wanted<'a> {
    most_pixels: Option<u64>,
    stop: Stop,
    tone: Option<&'a ToneCurves>,
    optics: Optics,
}

fn render(
    session: &Session,
    table: &CompositeTable,
    wanted: Wanted,
    inputs: &Inputs,
    light: &Source,
) -> anyhow::Result<Course> {
    let light = match light {
        Source::Map(light) => {
            let map = EnvironmentSampler::new(light.map.clone());
            return render_under(session, table, wanted, inputs, &map);
        }
        Source::Recovered(light) => light,
    };
    match &light.surroundings {
        Some(map) => {
            let map = EnvironmentSampler::new(Arc::new(map.clone()));
            let light = MapWithLobes::new(map, light.lobes.clone());
            render_under(session, table, wanted, inputs, &light)
        }
        None => render_under(session, table, wanted, inputs, &light.lobes),
    }
}

fn render_under<L: SceneLight>(
    session: &Session,
    table: &CompositeTable,
    wanted: Wanted,
    inputs: &Inputs,
    light: &L,
) -> anyhow::Result<Course> {
    let clock = Instant::now();
    let mut round = 0;
    let loaded = &inputs.scene.loaded;
    let effects = &inputs.scene.effects;
    let settings = Settings {
        seed: session.pipeline.seed,
        stop: wanted.stop,
        max_samples: table.max_samples.unwrap_or(MAX_SAMPLES),
        denoise: table.denoise(session.pipeline.quality),
        blur_caustics: table.blur_caustics(session.pipeline.quality),
        most_pixels: wanted.most_pixels,
        leave_out: effects.leave_out(loaded.description.effects()),
        tone: wanted.tone,
        gloss: table.gloss(),
        optics: wanted.optics,
        gain: exposed::gain(loaded.taken(), &loaded.photo.image),
        ..Settings::of_scene(loaded)
    };
    let renderer = Renderer::new(&loaded.scene);
    let progress = session.progress("composite");
    let rendered = renderer
        .render(light, &effects.simulation(), &settings, &mut |state| {
            progress.set(state.fraction);
            if state.round == round {
                return interruption();
            }
            round = state.round;
            let goal = match wanted.stop {
                Stop::TargetError(target) => format!(" -> {target}"),
                _ => String::new(),
            };
            progress.say(format!("error {:.5}{goal}", state.error.upper_95));
            session.remark(|| {
                format!(
                    "round {}: error {:.5} (95% bound {:.5}), {} samples, {} rays, {}",
                    state.round,
                    state.error.rmse,
                    state.error.upper_95,
                    state.samples,
                    state.rays,
                    duration(state.elapsed.as_secs_f64())
                )
            });
            interruption()
        })
        .map_err(crate::render_error)?;
    progress.done();
    let seconds = clock.elapsed().as_secs_f64();
    Ok(Course { rendered, seconds })
}

/// The layers of the picture, linear.
struct Composite<'a> {
    background: &'a LinearImage,
    object: LinearImage,
    alpha: Raster<f32>,
    shadow: LinearImage,
    /// How the object's and the shadow's colours are stored.
    precision: [Precision; 2],
    matched: Matched,
}

impl<'a> Composite<'a> {
    fn new(inputs: &'a Inputs, film: Film, divisor: u32, curve: &Curve, look: &Look) -> Self {
        let loaded = &inputs.scene.loaded;
        let background = &loaded.taken().image;
        let film = match &loaded.original {
            Some(original) => lens::film(film, &original.undistortion),
            None => film,
        };
        let Film {
            object,
            alpha,
            shadow,
            mirrored,
            ..
        } = film;
        let (mut object, shadow) = curve.apply(object, &alpha, shadow);
        if let Some(mirrored) = mirrored {
            gloss::add(&mut object, &mirrored, curve.curves());
        }
        let mut layers = Overlay {
            object,
            alpha,
            shadow,
        };
        let hidden = loaded.occluders.as_ref();
        let bent = |mask| match &loaded.original {
            Some(original) => Cow::Owned(original.undistortion.distort(mask, 0.0)),
            None => Cow::Borrowed(mask),
        };
        let hidden = hidden.map(|mask| Hidden {
            object: bent(mask),
            shadow: bent(loaded.shadow_mask.as_ref().unwrap_or(mask)),
        });
        let matched = look.apply(&mut layers, background, hidden.as_ref(), divisor);
        let Overlay {
            mut object,
            mut alpha,
            mut shadow,
        } = layers;
        // Rounded to what the file stores before they are put together, so that whoever does it
        // again from the file gets the same picture. Light beyond half precision is stored in full.
        let precision = [Precision::of_colour(&object), Precision::of_colour(&shadow)];
        for (layer, precision) in [(&mut object, precision[0]), (&mut shadow, precision[1])] {
            let pixels = layer.pixels_mut().par_iter_mut();
            pixels.for_each(|v| *v = precision.round_colour(*v));
        }
        let pixels = alpha.pixels_mut().par_iter_mut();
        pixels.for_each(|a| *a = Precision::Half.round(*a));
        Self {
            background,
            object: LinearImage(object),
            alpha,
            shadow: LinearImage(shadow),
            precision,
            matched,
        }
    }

    /// What they show together.
    fn picture(&self) -> anyhow::Result<LinearImage> {
        let picture = composite(self.background, &self.object, &self.alpha, &self.shadow)?;
        Ok(picture)
    }

    /// All layers, the picture stored with `in_picture`.
    fn to_rows<'b>(
        &'b self,
        in_picture: Precision,
        gbuffer: &'b Layers,
    ) -> anyhow::Result<LayerRows<'b>> {
        let colours = [self.background, &self.object, &self.shadow];
        let [background, object, shadow] = colours.map(|image| image.0.pixels());
        let alpha = self.alpha.pixels();
        let picture = |i: usize| composite_pixel(background[i], object[i], alpha[i], shadow[i]);
        let half = Precision::Half;
        let in_background = Precision::of_colour(&self.background.0);
        let mut rows = LayerRows::new(self.alpha.width(), self.alpha.height());
        rows.insert_pixels(["R", "G", "B"], in_picture, picture)?;
        rows.insert_constant("A", half, 1.0)?;
        let names = ["object.R", "object.G", "object.B"];
        rows.insert_pixels(names, self.precision[0], |i| object[i])?;
        rows.insert("object.A", half, &self.alpha)?;
        let names = ["shadow.R", "shadow.G", "shadow.B"];
        rows.insert_pixels(names, self.precision[1], |i| shadow[i])?;
        let names = ["background.R", "background.G", "background.B"];
        rows.insert_pixels(names, in_background, |i| background[i])?;
        for name in GEOMETRY {
            let precision = match name {
                "depth.Z" => Precision::Full,
                _ => half,
            };
            rows.insert(name, precision, gbuffer.channel(name)?)?;
        }
        Ok(rows)
    }
}

impl Done {
    /// For programs.
    pub fn to_json(&self) -> Value {
        json!({
            "folder": json_path(&self.folder),
            "picture": json_path(self.folder.join("composite.png")),
            "layers": json_path(self.folder.join("composite.exr")),
            "estimated_error": self.error,
            "matched": self.matched,
            "samples": self.samples,
            "rays": self.rays,
            "elapsed_s": self.manifest.elapsed_s,
            "seconds": self.seconds,
            "other_presets": self.outlook.to_json(),
            "peak_rss_bytes": self.manifest.peak_rss_bytes,
        })
    }

    fn missed_target(&self) -> Option<f32> {
        match self.target {
            Stop::TargetError(target) if self.error > f64::from(target) => Some(target),
            _ => None,
        }
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.folder, &self.manifest)?;
        write!(
            f,
            "\n  estimated error {:.5} (display-referred RMSE, 95% bound), {:.1} million rays",
            self.error,
            self.rays as f64 * 1e-6
        )?;
        if self.divisor > 1 {
            let edges = match self.is_sharp_enough {
                true => "no softer than the photograph is",
                false => "edges are soft, which the error does not count",
            };
            write!(
                f,
                "\n  object and shadow at 1/{} of the photograph's resolution, enlarged: {edges}",
                self.divisor
            )?;
        }
        if let Some(matched) = self.matched.text() {
            write!(
                f,
                "\n  {matched} (composite.match_blur, composite.match_grain)"
            )?;
        }
        for [what, text] in self.matched.blurs_texts() {
            write!(f, "\n  {}: {text}", what.to_lowercase())?;
        }
        if self.is_blur_unknown {
            f.write_str("\n  the photograph has too few clear edges to tell how soft it is: the object is sharp")?;
        }
        if let Stop::TimeBudget(budget) = self.target {
            let (budget, share) = (budget.as_secs_f64(), self.seconds / budget.as_secs_f64());
            write!(
                f,
                "\n  {} in all, {:.0}% of the budget of {}",
                duration(self.seconds),
                100.0 * share,
                duration(budget)
            )?;
        }
        if !self.outlook.0.is_empty() {
            write!(f, "\n  {}", self.outlook.text())?;
        }
        if let Some(target) = self.missed_target() {
            write!(
                f,
                "\n  the target of {target} was not reached: raise composite.max_samples"
            )?;
        }
        Ok(())
    }
}
