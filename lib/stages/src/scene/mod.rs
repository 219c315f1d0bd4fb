//! The scene stage: reads everything once, says what of it can be simulated, and writes down both.
pub mod background;
pub mod folder;
pub mod transport;

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use dipir_cli::exit::Usage;
use dipir_cli::interrupt;
use dipir_cli::output::json_path;
use dipir_cli::session::{Session, duration, size};
use dipir_optimize::settings::{LightTable, Settings as RecoverySettings};
use dipir_pipeline::config::Config;
use dipir_pipeline::manifest::{Artifact, Manifest};
use dipir_pipeline::stage::{MISSING, StagePlan};
use dipir_points::Ground;
use dipir_render::effects::EffectsPlan;
use dipir_render::gbuffer::GBuffer;
use dipir_render::render::{Renderer, Settings};
use dipir_render::transport::Transport;
use dipir_scene::camera::parts;
use dipir_scene::config::{EffectSwitch, SceneConfig};
use dipir_scene::description::{ProxyRecord, SceneDescription};
use dipir_scene::foreground::DepthFit;
use dipir_scene::ground::points_parts;
use dipir_scene::plausibility::implausible;
use dipir_scene::scene::{LoadedScene, Scene};
use serde_json::{Value, json};

use crate::composite::table::CompositeTable;
use crate::keys::defaults;
use crate::light::method::Method;
use crate::names::{SCENE, begin};
use crate::presets::Outlook;
use crate::scene::transport::Frame;
use crate::upstream::hashes;
use crate::written;

/// What the stage did.
pub struct Done {
    folder: PathBuf,
    manifest: Manifest,
    effects: EffectsPlan,
    triangles: usize,
    materials: usize,
    resolution: [u32; 2],
    /// Of the ground, where it was found in points.
    ground: Option<Ground>,
    /// Of the depths that tell what is in front.
    depth_fit: Option<DepthFit>,
    /// Whether what they show beside the proxy catches shadows.
    catches: bool,
    /// Absent where the light is given.
    record: Option<Record>,
    /// Other qualities differ in the record alone.
    outlook: Outlook,
}

/// The light transport that was recorded.
struct Record {
    size: [usize; 2],
    environment: [usize; 2],
    samples: u32,
    bytes: usize,
    seconds: f64,
}

impl Record {
    fn of(transport: &Transport, seconds: f64) -> Self {
        let (object, shadow) = transport.bytes();
        Self {
            size: transport.size(),
            environment: transport.environment_size(),
            samples: transport.header().samples,
            bytes: object + shadow,
            seconds,
        }
    }
}

/// Runs the stage.
pub fn run(session: &Session) -> anyhow::Result<Done> {
    let clock = Instant::now();
    let config: SceneConfig = session.config.table("scene")?;
    let composite: CompositeTable = session.config.table("composite")?;
    composite.check(&session.config)?;
    let mut loaded = load(session, &config)?.map_err(|e| with_place(e, &session.config))?;
    // What the composite needs to know of the photograph is missed here, before anything long runs.
    composite.lens(&session.config, &loaded)?;
    for warning in loaded.warnings.iter().chain(&implausible(&loaded)) {
        session.warn(warning);
    }
    let table: LightTable = session.config.table("light")?;
    let recovery = transport::settings(session, &table)?;
    let recorded = Method::of(session)?.replays().then_some(&recovery);
    let read = loaded.inputs.iter();
    let mut plan_of_this = plan_with(
        session,
        read.map(|i| (i.role.as_str(), i.path.as_path(), i.location.as_path())),
    )?;
    for part in &loaded.missing {
        plan_of_this.missing(&part.role, &part.path);
    }
    let folder = SCENE.folder(session);
    let reading = clock.elapsed();
    let mut writer = begin(session, plan_of_this)?;
    writer.add_time(reading);

    let settings = Settings {
        seed: session.pipeline.seed,
        ..Settings::of_scene(&loaded)
    };
    let renderer = Renderer::new(&loaded.scene);
    warn_of_slow_rays(session, &renderer);
    let effects = EffectsPlan::new(&renderer, &config.effects, &settings);
    writer.write_json("effects", "effects.json", &effects)?;
    loaded.description.seed = session.pipeline.seed;
    writer.write_json("scene", "scene.json", &loaded.description)?;
    let gbuffer = GBuffer::new(&renderer, session.pipeline.seed).map_err(crate::render_error)?;
    interrupt::check()?;
    let path = writer.output("gbuffer", "gbuffer.exr")?;
    gbuffer.to_rows()?.write_exr(path)?;
    drop(gbuffer);
    let record = match recorded {
        Some(settings) => {
            let clock = Instant::now();
            let record = record(session, &loaded, &renderer, &effects, settings)?;
            record.save(writer.output(transport::ROLE, transport::FILE)?)?;
            let seconds = clock.elapsed().as_secs_f64();
            writer.set_timing("transport", seconds);
            Some(Record::of(&record, seconds))
        }
        None => None,
    };
    let manifest = writer.finish()?;
    let resolution = loaded.scene.camera.resolution;
    let outlook = record
        .as_ref()
        .map(|r| outlook(session, &table, r, resolution, &manifest));
    Ok(Done {
        folder,
        manifest,
        effects,
        triangles: loaded.scene.mesh.indices.len(),
        materials: loaded.scene.materials.len(),
        resolution,
        catches: loaded.catching().is_some(),
        ground: match loaded.description.proxy {
            ProxyRecord::Ground(ground) => Some(*ground),
            _ => None,
        },
        depth_fit: loaded.depth_fit,
        record,
        outlook: outlook.unwrap_or_default(),
    })
}

/// Reads the scene; that of a frame has the objects and the ground of its shot's photograph.
fn load(
    session: &Session,
    config: &SceneConfig,
) -> anyhow::Result<Result<LoadedScene, dipir_scene::Error>> {
    let base_dir = session.config.base_dir();
    Ok(match &session.placed {
        None => Scene::load(config, &base_dir),
        Some(folder) => {
            let photo = Manifest::read(folder, SCENE.executable)?.output(folder, "scene")?;
            Scene::load_frame(config, &base_dir, &SceneDescription::read(&photo)?)
        }
    })
}

/// Where a ray takes long, the render will want patience.
fn warn_of_slow_rays(session: &Session, renderer: &Renderer) {
    let bvh = &renderer.geometry().bvh;
    if bvh.affordable_share() < 1.0 {
        session.warn(&format!(
            "a ray through the objects meets about {:.0} groups of triangles, where 20 are usual, so that rendering takes \
             long: large triangles lie close above one another, as in shells within shells; remove those that cannot be \
             seen, or set composite.time_budget_s",
            bvh.expected_visits()
        ));
    }
}

/// What the presets beside this one would have cost: recording takes time in proportion to paths.
fn outlook(
    session: &Session,
    table: &LightTable,
    record: &Record,
    resolution: [u32; 2],
    manifest: &Manifest,
) -> Outlook {
    let longest = resolution[0].max(resolution[1]) as usize;
    let paths = |samples: u32, side: usize| f64::from(samples) * (side.min(longest) as f64).powi(2);
    let here = paths(record.samples, record.size[0].max(record.size[1]));
    Outlook::beside(session.pipeline.quality, |p| {
        let light = p.light_with(table);
        let there = paths(light.samples, light.size);
        let rest_s = manifest.elapsed_s - record.seconds;
        (there != here).then(|| (rest_s + record.seconds * there / here, None))
    })
}

/// Traces how light reaches the picture, for the light stage.
fn record(
    session: &Session,
    loaded: &LoadedScene,
    renderer: &Renderer,
    effects: &EffectsPlan,
    settings: &RecoverySettings,
) -> anyhow::Result<Transport> {
    let frame = Frame::new(loaded, settings.size);
    let simulation = effects.simulation();
    let hash = transport::scene_hash(loaded, &simulation)?;
    let renderer = renderer.with_camera(frame.camera);
    let record_settings = frame.record_settings(settings, simulation, hash);
    transport::record(session, &renderer, &record_settings)
}

/// What begins the role of a file that an object consists of.
const PART_OF: &str = "part of ";

/// What a run would be. The files that an object consists of, and those of them that are missing, are known only once it has
/// been read. They are taken from the manifest of the last run: the same object has the same files.
pub fn plan(session: &Session) -> anyhow::Result<StagePlan> {
    let config: SceneConfig = session.config.table("scene")?;
    config
        .validate()
        .map_err(|e| with_place(e, &session.config))?;
    let recorded = match SCENE.manifest(session) {
        Ok(manifest) => manifest.inputs,
        Err(_) => Vec::new(),
    };
    let is_part = |a: &&Artifact| a.role.starts_with(PART_OF) || is_missing(a);
    let parts: Vec<&Artifact> = recorded.iter().filter(is_part).collect();
    let whole = plan_with_parts(session, &parts);
    if whole.is_ok() {
        return whole;
    }
    // Another object has other files.
    let is_there = |p: &&Artifact| is_missing(p) || session.resolve(&p.path).exists();
    let (there, gone): (Vec<_>, Vec<_>) = parts.into_iter().partition(is_there);
    let is_of_another = |part: &&Artifact, now: &StagePlan| {
        let object = unnumbered(&part.role).trim_start_matches(PART_OF);
        hashes(&recorded, object) != hashes(&now.inputs, object)
    };
    match plan_with_parts(session, &there) {
        Ok(now)
            if gone
                .iter()
                .all(|p| is_dispensable(p) || is_of_another(p, &now)) =>
        {
            Ok(now)
        }
        _ => whole,
    }
}

/// Whether an object is read, with a warning, though this part of it is gone: its materials and textures, but not the buffers
/// of a glTF file.
fn is_dispensable(part: &Artifact) -> bool {
    part.path.extension().is_some_and(|e| e != "bin")
}

/// Whether the last run looked for this in vain.
fn is_missing(part: &Artifact) -> bool {
    part.role.starts_with(MISSING)
}

/// The plan with the files that the configuration names and these `parts` of objects, missing ones among them.
fn plan_with_parts(session: &Session, parts: &[&Artifact]) -> anyhow::Result<StagePlan> {
    let config: SceneConfig = session.config.table("scene")?;
    let mut named = named_files(&config, &session.config.base_dir());
    if session.placed.is_some() {
        // A frame has the ground that its shot's scene.json tells.
        named.retain(|(role, _)| *role != "points");
    }
    let (missing, parts): (Vec<&Artifact>, Vec<&Artifact>) =
        parts.iter().partition(|p| is_missing(p));
    let parts = parts.iter();
    let files = named
        .iter()
        .map(|(role, path)| (*role, path.as_path()))
        .chain(parts.map(|a| (unnumbered(&a.role), a.path.as_path())));
    let files: Vec<_> = files
        .map(|(role, path)| (role, path, session.resolve(path)))
        .collect();
    let mut plan = plan_with(
        session,
        files
            .iter()
            .map(|(role, path, at)| (*role, *path, at.as_path())),
    )?;
    for part in missing {
        let (role, path) = (unnumbered(&part.role), &part.path);
        if plan.input(role, path, &session.resolve(path)).is_err() {
            plan.missing(&role[MISSING.len()..], path);
        }
    }
    Ok(plan)
}

/// Parameters of the stage with the keys of `[scene]` that decide what it writes, defaults filled in. Left out are `class`,
/// which only stages that ask a model use, `views`, which only the light's estimate uses, and limits that only refuse.
pub(crate) fn deciding(mut params: Value) -> Value {
    if let Some(scene) = params.get_mut("scene") {
        defaults::fill("scene", scene);
    }
    if let Some(keys) = params.get_mut("scene").and_then(Value::as_object_mut) {
        keys.retain(|key, _| key != "class" && key != "views");
        if let Some(limits) = keys.get_mut("limits") {
            let outside = limits["allow_outside"].as_bool();
            *limits = json!({"allow_outside": outside.unwrap_or_default()});
        }
    }
    params
}

/// The files that the configuration itself names, every one once.
fn named_files(config: &SceneConfig, base_dir: &Path) -> Vec<(&'static str, PathBuf)> {
    let camera = config.camera.as_ref();
    let camera = camera.and_then(|c| c.transforms.as_ref().or(c.file.as_ref()));
    let camera = camera.map_or(Vec::new(), |path| parts(path, base_dir));
    let proxy = config.proxy.as_ref().and_then(|p| p.mesh.clone());
    // Switched off, mask and depths are not read.
    let is_read = config.effects.occluders != Some(EffectSwitch::Off);
    let read = |path: &Option<PathBuf>| path.clone().filter(|_| is_read);
    let single = [
        ("background", config.background.clone()),
        ("occluders", read(&config.occluders)),
        ("depth", read(&config.depth)),
        ("proxy", proxy),
    ];
    let camera = camera.into_iter().map(|path| ("camera", Some(path)));
    let points = config.proxy.as_ref().and_then(|p| {
        let path = p.points.as_deref()?;
        Some(points_parts(path, p.points_pose.as_deref(), base_dir))
    });
    let points = points.into_iter().flatten();
    let points = points.map(|path| ("points", Some(path)));
    let objects = config.objects.iter().map(|o| ("object", o.path.clone()));
    let mut files: Vec<(&str, PathBuf)> = Vec::new();
    for (role, path) in single
        .into_iter()
        .chain(camera)
        .chain(points)
        .chain(objects)
    {
        if let Some(path) = path
            && !files.contains(&(role, path.clone()))
        {
            files.push((role, path));
        }
    }
    files
}

/// A role without its number: `part of object` for `part of object 2`.
pub(crate) fn unnumbered(role: &str) -> &str {
    role.trim_end_matches(|c: char| c.is_ascii_digit())
        .trim_end()
}

fn plan_with<'a>(
    session: &Session,
    files: impl Iterator<Item = (&'a str, &'a Path, &'a Path)>,
) -> anyhow::Result<StagePlan> {
    let config: SceneConfig = session.config.table("scene")?;
    let table: LightTable = session.config.table("light")?;
    let recovery = transport::settings(session, &table)?;
    // Where nothing is optimised, nothing reads the record.
    let transport = Method::of(session)?.replays().then(|| {
        json!({
            "size": recovery.size, "environment": recovery.environment,
            "samples": recovery.samples, "precision": recovery.precision,
            "seed": recovery.seed,
        })
    });
    let mut params = deciding(json!({"scene": config, "transport": transport}));
    if let Some(frame) = config.shown_frame(&session.config.base_dir()) {
        params["camera_frame"] = frame.into();
    }
    let mut plan = SCENE.plan(session, params);
    plan.comparable = deciding;
    for (role, path, location) in files {
        plan.input(role, path, location)?;
    }
    if let Some(folder) = &session.placed {
        let path = folder.join("scene.json");
        plan.input("photograph of the shot", &path, &path)?;
    }
    Ok(plan)
}

/// Makes an error about a key one of usage that says where the key stands.
pub fn with_place(error: dipir_scene::Error, config: &Config) -> anyhow::Error {
    use dipir_scene::Error::{Conflict, Missing};
    let key = match &error {
        dipir_scene::Error::Config { key, .. } | Missing { key, .. } => key,
        Conflict { first, .. } => first,
        _ => return anyhow::Error::new(error).context("the scene cannot be set up"),
    };
    let dotted = key.replace('[', ".").replace(']', "");
    Usage(format!("{}: {error}", config.nearest_place(&dotted))).into()
}

impl Done {
    /// For programs.
    pub fn to_json(&self) -> Value {
        json!({
            "folder": json_path(&self.folder),
            "triangles": self.triangles,
            "materials": self.materials,
            "resolution": self.resolution,
            "ground": self.ground.as_ref().map(|g| json!({
                "point": g.point, "normal": g.normal, "points": g.points, "inliers": g.inliers,
                "residual_m": g.residual_m, "relief": g.relief.is_some(),
            })),
            "depth": self.depth_fit.map(|d| json!({
                "kind": d.fitted.map(|f| f.scale.measure), "factor": d.fitted.map(|f| f.scale.factor),
                "shift": d.fitted.map(|f| f.scale.shift), "agreeing": d.fitted.map(|f| f.agreeing),
                "deviation": d.fitted.map(|f| f.deviation), "margin": d.margin, "ground_margin": d.ground_margin,
                "surfaces": self.catches,
            })),
            "effects": self.effects.effects,
            "max_depth": self.effects.max_depth,
            "transport": self.record.as_ref().map(|r| json!({
                "size": r.size, "environment": r.environment, "samples": r.samples,
                "bytes": r.bytes, "seconds": r.seconds,
            })),
            "elapsed_s": self.manifest.elapsed_s,
            "peak_rss_bytes": self.manifest.peak_rss_bytes,
            "estimated_error": self.manifest.estimated_error,
            "other_presets": self.outlook.to_json(),
        })
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let on: Vec<&str> = self
            .effects
            .effects
            .iter()
            .filter(|e| e.enabled)
            .map(|e| e.name.name())
            .collect();
        let [width, height] = self.resolution;
        written(f, &self.folder, &self.manifest)?;
        writeln!(
            f,
            "\n  {} triangles, {} materials, {width} x {height} pixels",
            self.triangles, self.materials
        )?;
        if let Some(ground) = &self.ground {
            writeln!(f, "  ground: {}", ground.words())?;
        }
        if let Some(fit) = &self.depth_fit {
            writeln!(f, "  depth: {}", fit.words(self.catches))?;
        }
        write!(
            f,
            "  effects: {} (depth {})",
            match on.is_empty() {
                true => "none".into(),
                false => on.join(", "),
            },
            self.effects.max_depth
        )?;
        if !self.outlook.0.is_empty() {
            write!(f, "\n  {}", self.outlook.text())?;
        }
        match &self.record {
            Some(r) => write!(
                f,
                "\n  light transport: {} x {} pixels, {} x {} texels, {} paths a pixel, {} in {}",
                r.size[0],
                r.size[1],
                r.environment[0],
                r.environment[1],
                r.samples,
                size(r.bytes as u64),
                duration(r.seconds)
            ),
            None => write!(
                f,
                "\n  light transport: not recorded, for no light is optimised"
            ),
        }
    }
}

#[cfg(test)]
mod tests;
