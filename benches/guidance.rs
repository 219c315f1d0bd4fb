//! What personalisation and guidance find out about light: scenes that training never showed,
//! nothing given but the photograph, the camera, the plane and the object.
//!
//! A photograph of a place with several objects is rendered under a sun and a sky; another object
//! is to be inserted. Its composite under the true light is the reference; methods are the start
//! of the pipeline without a model, the light encoder, the inversion, and guidance on top of it.
//!
//! Run with `cargo test --bench guidance -- --bench [MODEL] [key=value...]`: `scenes` and `first`
//! choose the scenes, `places` is open, street or yard, `iterations = 0` leaves guidance out, `ablations = 1` adds guidance with one
//! ingredient less each, `rate` scales the learning rates, `noise` is the draws of
//! noise of an iteration, `energy`, `encoder`, `t` and `draws` are the inversion's, `json` is a file for every scene's numbers. Prints the table of docs/prior.md with
//! bootstrap intervals. Without `--bench`, as tests run it, it does nothing: what it measures takes
//! minutes.
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;

use candle_core::{DType, Device};
use dipir_diffusion::model::Model;
use dipir_guidance::distillation::{Distillation, DistillationSettings};
use dipir_guidance::reading::{self, read_light, start};
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_light::gaussian::LobeParameters;
use dipir_numerics::stats::{bootstrap_median_interval, median};
use dipir_optimize::crop::bounding_box;
use dipir_optimize::guidance::touched;
use dipir_optimize::lighting::Lighting;
use dipir_optimize::objective::Objective;
use dipir_optimize::optimization::Optimization;
use dipir_optimize::parameters::{Parameters, ambient_of};
use dipir_optimize::settings::{GuidanceKind, LightTable, Settings};
use dipir_pipeline::config::Quality;
use dipir_pretraining::CameraResponse;
use dipir_pretraining::generated_photograph::GeneratedPhotograph;
use dipir_pretraining::lighting::sun_angles;
use dipir_pretraining::scene::{Paint, Setting};
use dipir_prior::inversion::{InversionSettings, Reading, angle_between, combine};
use dipir_prior::text_conditioning::add_placeholders;
use dipir_render::features::SPECULAR;
use dipir_render::render::{Renderer, Simulation};
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::material::Material;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use dipir_stages::known_light;
use dipir_stages::presets;
use glam::Vec3;

/// Key of these scenes. Training and quality checks have others.
const SEED: u64 = 0x5ce7e5;
/// Pixels on a side of the photographs.
const SIZE: u32 = 96;
/// The environment in which truth and answers are held.
const MAP: [usize; 2] = [128, 64];

struct Trial {
    place: GeneratedPhotograph,
    photo: DisplayImage,
    linear: LinearImage,
    transport: Transport,
}

fn material(paint: &Paint) -> Material {
    Material {
        base_color: paint.color.extend(1.0),
        roughness: paint.roughness,
        metallic: if paint.metallic { 1.0 } else { 0.0 },
        ..Material::default()
    }
}

fn ground() -> Proxy {
    Proxy::Plane(Plane {
        point: Vec3::ZERO,
        normal: Vec3::Y,
    })
}

impl Trial {
    fn draw(index: u64, samples: u32, setting: Setting) -> anyhow::Result<Self> {
        let place = GeneratedPhotograph::draw(SEED, index, SIZE, setting);
        let (stage, tone) = (&place.scene, place.response);
        let mut shown: Vec<f32> = place.radiance.iter().flat_map(|p| p.to_array()).collect();
        tone.apply(&mut shown);
        // As a file would hold it.
        let shown = shown.chunks_exact(3).map(|p| {
            let v = Vec3::new(p[0], p[1], p[2]).clamp(Vec3::ZERO, Vec3::ONE);
            (v * 255.0).round() / 255.0
        });
        let size = SIZE as usize;
        let photo = DisplayImage(Raster::from_pixels(size, size, shown.collect()));
        let linear = Transfer::Srgb.decode(photo.clone());
        let scene = Scene {
            mesh: stage.main.clone(),
            materials: vec![material(&stage.main_paint)],
            textures: vec![],
            camera: stage.camera,
            proxy: ground(),
        };
        let simulation = Simulation {
            features: SPECULAR,
            max_depth: 3,
            shadow: true,
            proxy_occlusion: true,
            light_on_proxy: None,
        };
        let settings = RecordSettings {
            environment: MAP,
            samples,
            shadow_samples: samples,
            background: Some(&linear),
            ..RecordSettings::new(simulation)
        };
        let renderer = Renderer::new(&scene);
        let transport =
            Transport::record(&renderer, &settings, &mut |_| ControlFlow::Continue(()))?;
        Ok(Self {
            place,
            photo,
            linear,
            transport,
        })
    }

    /// The composite under the true light with the photograph's own tone.
    fn truth(&self, objective: &Objective) -> anyhow::Result<DisplayImage> {
        let map = self.place.map(MAP[0], MAP[1])?;
        Ok(self.under(&map, objective, Some(&self.place.response)))
    }

    /// The composite under `map`, the object through `tone`.
    fn under(
        &self,
        map: &EnvironmentMap,
        objective: &Objective,
        tone: Option<&CameraResponse>,
    ) -> DisplayImage {
        let transport = objective.transport();
        let object = transport.foreground(map.texels());
        let shadow = transport.shadow(map.texels());
        let coverage = transport.coverage();
        let pixels = (0..coverage.pixels().len()).map(|p| {
            let a = coverage.pixels()[p];
            let mut object = object.pixels()[p] / a.max(1e-6);
            if let Some(tone) = tone {
                let mut values = object.to_array();
                tone.apply(&mut values);
                object = Vec3::from_array(values.map(|v| Transfer::Srgb.decode_scalar(v)));
            }
            let ground = self.linear.0.pixels()[p] * shadow.pixels()[p];
            let c = ground * (1.0 - a) + object * a;
            Vec3::from_array(c.to_array().map(|v| Transfer::Srgb.encode_scalar(v)))
        });
        let size = SIZE as usize;
        DisplayImage(Raster::from_pixels(size, size, pixels.collect()))
    }
}

#[derive(Clone, Copy)]
struct Answer {
    azimuth: f32,
    elevation: f32,
    rmse: f64,
}

fn answer(
    trial: &Trial,
    objective: &Objective,
    parameters: &Parameters,
    truth: &DisplayImage,
) -> Answer {
    let picture = objective.forward(parameters, 1.0).picture;
    let lighting = Lighting::of(parameters, MAP[0], MAP[1]);
    judge(trial, objective, &picture, lighting.peak_direction(), truth)
}

/// Errors of a composite, over what the object or its shadow touches, and of a light's brightest
/// direction.
fn judge(
    trial: &Trial,
    objective: &Objective,
    picture: &DisplayImage,
    peak: Option<Vec3>,
    truth: &DisplayImage,
) -> Answer {
    let mask = touched(objective);
    let (azimuth, elevation) = peak.map_or((f32::NAN, f32::NAN), sun_angles);
    let sun = trial.place.sun();
    Answer {
        azimuth: angle_between(azimuth, sun.azimuth).to_degrees(),
        elevation: (elevation - sun.elevation).abs().to_degrees(),
        rmse: dipir_optimize::guidance::rmse(picture, truth, &mask, None),
    }
}

/// The baseline that every other row is compared with, scene by scene.
const ENCODER: &str = "3 encoder";

struct Knobs {
    model: PathBuf,
    scenes: u64,
    first: u64,
    setting: Setting,
    iterations: usize,
    rate: f64,
    ablations: bool,
    guidance_draws: usize,
    samples: u32,
    reader: InversionSettings,
    json: Option<PathBuf>,
}

fn run(
    knobs: &Knobs,
    model: &Model,
    index: u64,
    readings: &mut Vec<serde_json::Value>,
) -> anyhow::Result<BTreeMap<&'static str, Answer>> {
    let trial = Trial::draw(index, knobs.samples, knobs.setting)?;
    let lobes = 32;
    let table = LightTable {
        iterations: Some(knobs.iterations.max(1)),
        ..LightTable::default()
    };
    let mut settings = table.settings(&presets::of(Quality::Standard).light, 1)?;
    settings.preview_every = 0;
    settings.checkpoint_every = 0;
    settings.learning_rates = settings.learning_rates.scaled(knobs.rate);
    let coverage = trial.transport.coverage().clone();
    let objective = Objective::new(
        Box::new(trial.transport.clone()),
        trial.linear.clone(),
        Transfer::Srgb,
        settings.weights(),
    )?;
    let truth = trial.truth(&objective)?;
    let mut found = BTreeMap::new();
    let neutral = Parameters::neutral(lobes, ambient_of(&trial.linear));
    found.insert("1 neutral", answer(&trial, &objective, &neutral, &truth));
    let ambient = glam::DVec3::splat(ambient_of(&trial.linear));
    let plain = Parameters::from_light(lobes, ambient, ambient * 0.3, None);
    found.insert(
        "2 neutral, camera's tone",
        answer(&trial, &objective, &plain, &truth),
    );
    let projected = trial.under(
        &known_light::projected(&trial.linear, &trial.place.scene.camera, MAP)?,
        &objective,
        None,
    );
    let unknown = judge(&trial, &objective, &projected, None, &truth);
    found.insert("2b photograph projected", unknown);
    let Some(object) = bounding_box(&coverage) else {
        return Ok(found);
    };
    let camera = &trial.place.scene.camera;
    let proxy = ground();
    let place = reading::Place {
        camera,
        proxy: &proxy,
        object,
    };
    let reading = read_light(model, &trial.photo, &place, &knobs.reader, index, &|_| {
        ControlFlow::Continue(())
    })?;
    let Some(reading) = reading else {
        anyhow::bail!("the model has no light encoder");
    };
    readings.push(serde_json::json!({
        "scene": index, "reading": reading, "truth": {
            "azimuth": trial.place.sun().azimuth, "elevation": trial.place.sun().elevation,
            "share": trial.place.light.share,
        },
    }));
    let mut unasked = reading.crops.clone();
    unasked.iter_mut().for_each(|c| c.energies.clear());
    let seen = combine(unasked, &reading.encoder, &knobs.reader);
    let seen = start(&seen.light, camera, lobes);
    found.insert(ENCODER, answer(&trial, &objective, &seen, &truth));
    let read = start(&reading.light, camera, lobes);
    found.insert("4 inversion", answer(&trial, &objective, &read, &truth));
    // The same with a hard sun, and with a softer one.
    for (name, sure) in [
        ("4c inversion, sure", 0.0),
        ("4d inversion, twice as unsure", 4.0),
    ] {
        let mut light = reading.light;
        light.confidence = light.confidence.clamp(1e-3, 1.0).powf(sure);
        let light = start(&light, camera, lobes);
        found.insert(name, answer(&trial, &objective, &light, &truth));
    }
    let mut known = reading.light;
    known.description.azimuth = trial.place.sun().azimuth;
    let turned = start(&known, camera, lobes);
    found.insert(
        "6 true azimuth",
        answer(&trial, &objective, &turned, &truth),
    );
    known.description.elevation = trial.place.sun().elevation;
    let turned = start(&known, camera, lobes);
    found.insert(
        "7 true direction",
        answer(&trial, &objective, &turned, &truth),
    );
    let unaided = InversionSettings {
        encoder_weight: 0.0,
        ..knobs.reader
    };
    let alone = combine(reading.crops.clone(), &reading.encoder, &unaided);
    let alone = start(&alone.light, camera, lobes);
    found.insert(
        "4b inversion, no encoder",
        answer(&trial, &objective, &alone, &truth),
    );
    if knobs.iterations == 0 {
        return Ok(found);
    }
    let variants = VARIANTS
        .iter()
        .take(if knobs.ablations { VARIANTS.len() } else { 1 });
    for variant in variants {
        let delivered = guided(knobs, variant, model, &trial, &settings, &reading)?;
        found.insert(variant.name, answer(&trial, &objective, &delivered, &truth));
    }
    Ok(found)
}

/// Guidance with everything, or with something left out.
struct Variant {
    name: &'static str,
    kind: GuidanceKind,
    timesteps: [f64; 2],
    /// The caption names the light.
    light_words: bool,
    /// The model sees what surrounds the object.
    background: bool,
    /// The light that is said is the inversion's, not the encoder's.
    inversion: bool,
    /// It starts where the light was read, not from the photograph's brightness.
    read_start: bool,
    /// Regularisers hold the light sets together.
    anchors: bool,
    /// The light is told from the same light from other sides, not from no caption.
    turned: bool,
}

const WHOLE: Variant = Variant {
    name: "5 guidance",
    kind: GuidanceKind::Lds,
    timesteps: [0.5, 0.9],
    light_words: true,
    background: true,
    inversion: true,
    read_start: true,
    anchors: true,
    turned: true,
};

const VARIANTS: [Variant; 10] = [
    WHOLE,
    Variant {
        name: "5a guidance, no light words",
        light_words: false,
        ..WHOLE
    },
    Variant {
        name: "5b guidance, background hidden",
        background: false,
        ..WHOLE
    },
    Variant {
        name: "5c guidance, t .02 to .5",
        timesteps: [0.02, 0.5],
        ..WHOLE
    },
    Variant {
        name: "5d guidance, encoder's light said",
        inversion: false,
        ..WHOLE
    },
    Variant {
        name: "5e guidance, from a neutral start",
        read_start: false,
        ..WHOLE
    },
    Variant {
        name: "5f guidance, SDS",
        kind: GuidanceKind::Sds,
        ..WHOLE
    },
    Variant {
        name: "5g guidance, pictures edited",
        kind: GuidanceKind::SdEdit,
        ..WHOLE
    },
    Variant {
        name: "5h guidance, no regularisers",
        anchors: false,
        ..WHOLE
    },
    Variant {
        name: "5i guidance, told from no caption",
        turned: false,
        ..WHOLE
    },
];

/// The light that `variant` of guidance delivers.
fn guided(
    knobs: &Knobs,
    variant: &Variant,
    model: &Model,
    trial: &Trial,
    settings: &Settings,
    reading: &Reading,
) -> anyhow::Result<Parameters> {
    let lobes = settings.lobes;
    let mut settings = settings.clone();
    if !variant.anchors {
        settings.consistency = 0.0;
        settings.regularizer = 0.0;
    }
    let said = match variant.inversion {
        true => reading.light,
        false => reading.encoder,
    };
    let class = trial.place.scene.shape.word();
    let coverage = trial.transport.coverage().clone();
    let camera = &trial.place.scene.camera;
    let told = bounding_box(&coverage).map(|object| {
        said.description
            .seen_from(reading::view_direction(camera, object).heading)
    });
    let paint = match variant.background {
        true => coverage,
        false => Raster::filled(SIZE as usize, SIZE as usize, 1.0),
    };
    let mut guidance = Distillation::new(
        model,
        DistillationSettings {
            guidance: variant.kind,
            timesteps: [variant.timesteps; 2],
            draws: knobs.guidance_draws,
            guidance_scale: 7.5,
            prompt: (!variant.light_words).then(|| format!("a photo of a {class}")),
            adapt: false,
            turned: variant.turned,
        },
        None,
        class,
        told.as_ref(),
        &trial.photo,
        &paint,
    )?;
    let objective = || {
        Objective::new(
            Box::new(trial.transport.clone()),
            trial.linear.clone(),
            Transfer::Srgb,
            settings.weights(),
        )
    };
    let start = match variant.read_start {
        true => start(&said, camera, lobes),
        false => {
            let ambient = glam::DVec3::splat(ambient_of(&trial.linear));
            Parameters::from_light(lobes, ambient, ambient * 0.3, None)
        }
    };
    let optimization = Optimization {
        objective: objective()?,
        guidance: &mut guidance,
        recorder: None,
        settings: settings.clone(),
        start,
        checkpoint: None,
    };
    let outcome = optimization.run(&mut |_| ControlFlow::Continue(()))?;
    let set: Vec<_> = outcome
        .lighting
        .lobes
        .iter()
        .map(LobeParameters::of)
        .collect();
    Ok(Parameters {
        foreground: set.clone(),
        shadow: set,
        tone: outcome.parameters.tone,
        log_exposure: 0.0,
    })
}

fn main() -> anyhow::Result<()> {
    let mut knobs = Knobs {
        model: "data/prior".into(),
        scenes: 100,
        first: 0,
        setting: Setting::Open,
        iterations: 50,
        rate: 0.05,
        ablations: false,
        guidance_draws: 1,
        samples: 192,
        reader: InversionSettings::default(),
        json: None,
    };
    let mut bench = false;
    for arg in std::env::args().skip(1) {
        match arg.split_once('=') {
            Some(("scenes", v)) => knobs.scenes = v.parse()?,
            Some(("first", v)) => knobs.first = v.parse()?,
            Some(("places", v)) => {
                knobs.setting = match v {
                    "open" => Setting::Open,
                    "street" => Setting::Street,
                    "yard" => Setting::Courtyard,
                    other => anyhow::bail!("places={other}: accepted are open, street and yard"),
                }
            }
            Some(("iterations", v)) => knobs.iterations = v.parse()?,
            Some(("rate", v)) => knobs.rate = v.parse()?,
            Some(("energy", v)) => knobs.reader.energy_weight = v.parse()?,
            Some(("encoder", v)) => knobs.reader.encoder_weight = v.parse()?,
            Some(("t", v)) => knobs.reader.timestep = v.parse()?,
            Some(("json", v)) => knobs.json = Some(v.into()),
            Some(("ablations", v)) => knobs.ablations = v.parse::<u8>()? != 0,
            Some(("noise", v)) => knobs.guidance_draws = v.parse()?,
            Some(("samples", v)) => knobs.samples = v.parse()?,
            Some(("draws", v)) => knobs.reader.draws = v.parse()?,
            Some((key, _)) => anyhow::bail!("unknown key {key}"),
            None if arg == "--bench" => bench = true,
            None => knobs.model = arg.into(),
        }
    }
    if !bench {
        return Ok(());
    }
    // SAFETY: no other thread runs yet.
    unsafe { std::env::set_var("CANDLE_NUM_THREADS", "1") };
    let mut model = Model::load(&knobs.model, DType::F32, &Device::Cpu)?;
    add_placeholders(&mut model.tokenizer);
    let mut all: BTreeMap<&str, Vec<Answer>> = BTreeMap::new();
    let mut readings = vec![];
    for index in knobs.first..knobs.first + knobs.scenes {
        for (name, answer) in run(&knobs, &model, index, &mut readings)? {
            all.entry(name).or_default().push(answer);
        }
        eprintln!("scene {index}");
    }
    if let Some(path) = &knobs.json {
        std::fs::write(path, serde_json::to_string(&readings)?)?;
    }
    println!(
        "| light from | azimuth, median | within 30 degrees | elevation, median | RMSE, median (95%) | RMSE, mean | beside encoder (95%) |"
    );
    println!("|---|---|---|---|---|---|---|");
    let beside: Vec<f64> = all
        .get(ENCODER)
        .map_or_else(Vec::new, |v| v.iter().map(|a| a.rmse).collect());
    for (name, answers) in &all {
        let values = |f: &dyn Fn(&Answer) -> f64| -> Vec<f64> { answers.iter().map(f).collect() };
        let n = answers.len() as f64;
        let near = answers.iter().filter(|a| a.azimuth <= 30.0).count() as f64 / n;
        let rmse = values(&|a| a.rmse);
        let of = |v: &[f64]| median(v).unwrap_or(f64::NAN);
        let between =
            |v: &[f64]| bootstrap_median_interval(v, 0.95, 4000, 1).unwrap_or((f64::NAN, f64::NAN));
        let less: Vec<f64> = rmse.iter().zip(&beside).map(|(a, b)| a - b).collect();
        let (low, high) = between(&rmse);
        let (less_low, less_high) = between(&less);
        println!(
            "| {} | {:.1} | {near:.2} | {:.1} | {:.4} ({low:.4} to {high:.4}) | {:.4} | {:+.4} ({less_low:+.4} to {less_high:+.4}) |",
            name,
            of(&values(&|a| a.azimuth.into())),
            of(&values(&|a| a.elevation.into())),
            of(&rmse),
            rmse.iter().sum::<f64>() / n,
            of(&less),
        );
    }
    Ok(())
}
