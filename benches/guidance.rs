//! How well light is recovered from a photograph alone, on generated scenes that training never showed,
//! for `docs/prior.md`. `dipir-evaluate` measures the same through the executables; this replays one
//! recorded transport a scene instead of path tracing composites, which takes seconds, not minutes.
//!
//! Run with `cargo test --bench guidance -- --bench [MODEL] [key=value...]`: `scenes` and `first` choose
//! the scenes, `places` is open, street or yard, `iterations` are those of guidance (0 leaves its row out),
//! `draws` are the noises that the inversion looks at, `json` is a file for every scene's reading. Without
//! `--bench`, as tests run it, it does nothing.
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;

use candle_core::{DType, Device};
use dipir_diffusion::model::Model;
use dipir_evaluation::summary::Summary;
use dipir_guidance::distillation::DistillationSettings;
use dipir_guidance::reading::start;
use dipir_guidance::recover::{ModelGuidance, Problem, Recovery, Target, recover_light};
use dipir_imaging::raster::{DisplayImage, LinearImage, Raster};
use dipir_imaging::transfer::Transfer;
use dipir_light::environment::EnvironmentMap;
use dipir_optimize::guidance::{rmse, touched};
use dipir_optimize::lighting::Lighting;
use dipir_optimize::objective::Objective;
use dipir_optimize::parameters::{Parameters, ambient_of};
use dipir_optimize::settings::{LightTable, Settings};
use dipir_pipeline::config::Quality;
use dipir_pretraining::generated_photograph::GeneratedPhotograph;
use dipir_pretraining::lighting::sun_angles;
use dipir_pretraining::scene::Setting;
use dipir_prior::inversion::angle_between;
use dipir_prior::inversion::{InversionSettings, combine};
use dipir_prior::text_conditioning::add_placeholders;
use dipir_render::features::SPECULAR;
use dipir_render::render::{Renderer, Simulation};
use dipir_render::transport::{RecordSettings, Transport};
use dipir_scene::material::Material;
use dipir_scene::proxy::{Plane, Proxy};
use dipir_scene::scene::Scene;
use dipir_stages::known_light;
use dipir_stages::presets;
use glam::{DVec3, Vec3};

/// Key of these scenes; training and checks have others.
const SEED: u64 = 0x5ce7e5;
/// Pixels on a side of the photographs.
const SIZE: usize = 96;
/// The environment in which truth and answers are held.
const MAP: [usize; 2] = [128, 64];
/// Paths a pixel of the record.
const SAMPLES: u32 = 192;
/// Factor on the learning rates, as the light stage has it for a model that knows light.
const RATE: f64 = 0.05;
const GROUND: Proxy = Proxy::Plane(Plane {
    point: Vec3::ZERO,
    normal: Vec3::Y,
});

struct Arguments {
    model: PathBuf,
    scenes: u64,
    first: u64,
    setting: Setting,
    iterations: usize,
    reader: InversionSettings,
    json: Option<PathBuf>,
}

impl Arguments {
    /// `None` without `--bench`.
    fn parse() -> anyhow::Result<Option<Self>> {
        let mut parsed = Self {
            model: "data/prior".into(),
            scenes: 100,
            first: 0,
            setting: Setting::Open,
            iterations: 50,
            reader: InversionSettings::default(),
            json: None,
        };
        let mut is_bench = false;
        for argument in std::env::args().skip(1) {
            match argument.split_once('=') {
                Some(("scenes", v)) => parsed.scenes = v.parse()?,
                Some(("first", v)) => parsed.first = v.parse()?,
                Some(("places", "open")) => parsed.setting = Setting::Open,
                Some(("places", "street")) => parsed.setting = Setting::Street,
                Some(("places", "yard")) => parsed.setting = Setting::Courtyard,
                Some(("iterations", v)) => parsed.iterations = v.parse()?,
                Some(("draws", v)) => parsed.reader.draws = v.parse()?,
                Some(("json", v)) => parsed.json = Some(v.into()),
                Some(_) => anyhow::bail!("{argument} is unknown"),
                None if argument == "--bench" => is_bench = true,
                None => parsed.model = argument.into(),
            }
        }
        Ok(is_bench.then_some(parsed))
    }
}

struct Trial {
    place: GeneratedPhotograph,
    linear: LinearImage,
    scene: Scene,
    settings: Settings,
}

/// Errors of a light: of its direction in degrees, of its picture.
struct Errors {
    azimuth: f64,
    elevation: f64,
    rmse: f64,
}

impl Trial {
    fn draw(arguments: &Arguments, index: u64) -> anyhow::Result<Self> {
        let place = GeneratedPhotograph::draw(SEED, index, SIZE as u32, arguments.setting);
        let mut values: Vec<f32> = place.radiance.iter().flat_map(|p| p.to_array()).collect();
        place.response.apply(&mut values);
        // As a file would hold it.
        let pixels = values.chunks_exact(3).map(|p| {
            let v = Vec3::from_slice(p).clamp(Vec3::ZERO, Vec3::ONE);
            (v * 255.0).round() / 255.0
        });
        let photo = DisplayImage(Raster::from_pixels(SIZE, SIZE, pixels.collect()));
        let linear = Transfer::Srgb.decode(photo);
        let paint = &place.scene.main_paint;
        let scene = Scene {
            mesh: place.scene.main.clone(),
            materials: vec![Material {
                base_color: paint.color.extend(1.0),
                roughness: paint.roughness,
                metallic: if paint.metallic { 1.0 } else { 0.0 },
                ..Material::default()
            }],
            textures: vec![],
            camera: place.scene.camera,
            proxy: GROUND,
        };
        let table = LightTable {
            iterations: Some(arguments.iterations.max(1)),
            ..LightTable::default()
        };
        let mut settings = table.settings(&presets::of(Quality::Standard).light, index)?;
        settings.preview_every = 0;
        settings.checkpoint_every = 0;
        settings.learning_rates = settings.learning_rates.scaled(RATE);
        Ok(Self {
            place,
            linear,
            scene,
            settings,
        })
    }

    fn record(&self) -> RecordSettings<'_> {
        let simulation = Simulation {
            features: SPECULAR,
            max_depth: 3,
            shadow: true,
            proxy_occlusion: true,
            light_on_proxy: None,
        };
        RecordSettings {
            environment: MAP,
            samples: SAMPLES,
            shadow_samples: SAMPLES,
            background: Some(&self.linear),
            ..RecordSettings::new(simulation)
        }
    }

    fn objective(&self, transport: &Transport) -> anyhow::Result<Objective> {
        Ok(Objective::new(
            Box::new(transport.clone()),
            self.linear.clone(),
            Transfer::Srgb,
            self.settings.weights(),
        )?)
    }

    /// The composite under `map`, the object through the photograph's own tone curve if `is_toned`.
    fn under(&self, map: &EnvironmentMap, transport: &Transport, is_toned: bool) -> DisplayImage {
        let object = transport.foreground(map.texels());
        let shadow = transport.shadow(map.texels());
        let coverage = transport.coverage();
        let pixels = (0..SIZE * SIZE).map(|p| {
            let a = coverage.pixels()[p];
            let mut object = object.pixels()[p] / a.max(1e-6);
            if is_toned {
                let mut values = object.to_array();
                self.place.response.apply(&mut values);
                object = Vec3::from_array(values.map(|v| Transfer::Srgb.decode_scalar(v)));
            }
            let ground = self.linear.0.pixels()[p] * shadow.pixels()[p];
            let linear = ground * (1.0 - a) + object * a;
            Vec3::from_array(linear.to_array().map(|v| Transfer::Srgb.encode_scalar(v)))
        });
        DisplayImage(Raster::from_pixels(SIZE, SIZE, pixels.collect()))
    }

    fn errors(&self, objective: &Objective, light: &Parameters, truth: &DisplayImage) -> Errors {
        let picture = objective.forward(light, 1.0).picture;
        let peak = Lighting::of(light, MAP[0], MAP[1]).peak_direction();
        let (azimuth, elevation) = peak.map_or((f32::NAN, f32::NAN), sun_angles);
        let sun = self.place.sun();
        Errors {
            azimuth: angle_between(azimuth, sun.azimuth).to_degrees().into(),
            elevation: (elevation - sun.elevation).abs().to_degrees().into(),
            rmse: rmse(&picture, truth, &touched(objective)),
        }
    }

    /// The light read off the photograph, and guided by LDS from there.
    fn recover(
        &self,
        model: &Model,
        reader: &InversionSettings,
        renderer: &Renderer,
        transport: Transport,
    ) -> anyhow::Result<Recovery> {
        let table = LightTable {
            adapt: Some(false),
            ..LightTable::default()
        };
        let distillation = DistillationSettings::new(&table, true);
        let distillation = distillation.map_err(|e| anyhow::anyhow!(e.message))?;
        let target = Target::Model(ModelGuidance {
            model,
            adapter: None,
            settings: &distillation,
            class: self.place.scene.shape.word(),
            reading: Some(reader),
        });
        let problem = Problem {
            renderer,
            transport,
            record: self.record(),
            background: &self.linear,
            transfer: Transfer::Srgb,
            settings: &self.settings,
            start: None,
            checkpoint: None,
        };
        Ok(recover_light(problem, &target, &|_| {
            ControlFlow::Continue(())
        })?)
    }
}

/// The row that others are compared with, scene by scene.
const ENCODER: &str = "3 encoder";

/// Errors of every light on the scene number `index`, and what was read.
fn measure(
    arguments: &Arguments,
    model: &Model,
    index: u64,
) -> anyhow::Result<(BTreeMap<&'static str, Errors>, serde_json::Value)> {
    let trial = Trial::draw(arguments, index)?;
    let lobes = trial.settings.lobes;
    let camera = &trial.scene.camera;
    let renderer = Renderer::new(&trial.scene);
    let record = trial.record();
    let transport = Transport::record(&renderer, &record, &mut |_| ControlFlow::Continue(()))?;
    let ambient = DVec3::splat(ambient_of(&trial.linear));
    let mut lights = vec![
        ("1 neutral", Parameters::neutral(lobes, ambient.x)),
        (
            "2 neutral, camera's tone",
            Parameters::from_light(lobes, ambient, ambient * 0.3, None),
        ),
    ];
    let reader = &arguments.reader;
    let recovery = trial.recover(model, reader, &renderer, transport.clone())?;
    let Some(reading) = recovery.reading else {
        anyhow::bail!("the model has no light encoder");
    };
    let mut encoder_alone = reading.crops.clone();
    encoder_alone.iter_mut().for_each(|c| c.energies.clear());
    let encoder = combine(encoder_alone, &reading.encoder, reader).light;
    let no_encoder = InversionSettings {
        encoder_weight: 0.0,
        ..*reader
    };
    let inversion = combine(reading.crops.clone(), &reading.encoder, &no_encoder).light;
    let mut hard_sun = reading.light;
    hard_sun.confidence = 1.0;
    let mut true_azimuth = reading.light;
    true_azimuth.description.azimuth = trial.place.sun().azimuth;
    let mut true_direction = true_azimuth;
    true_direction.description.elevation = trial.place.sun().elevation;
    for (name, light) in [
        (ENCODER, &encoder),
        ("4 inversion", &inversion),
        ("5 inversion with the encoder", &reading.light),
        ("5b the same with a hard sun", &hard_sun),
        ("6 true azimuth, the rest as read", &true_azimuth),
        ("7 true direction, the rest as read", &true_direction),
    ] {
        lights.push((name, start(light, camera, lobes)));
    }
    if arguments.iterations > 0 {
        let outcome = recovery.outcome;
        let guided = Parameters {
            tone: outcome.parameters.tone,
            ..Parameters::of_lobes(&outcome.lighting.lobes)
        };
        lights.push(("8 guidance", guided));
    }
    let objective = trial.objective(&transport)?;
    let truth = trial.under(&trial.place.map(MAP[0], MAP[1])?, &transport, true);
    let errors = lights.iter();
    let errors = errors.map(|(name, light)| (*name, trial.errors(&objective, light, &truth)));
    let mut errors: BTreeMap<_, _> = errors.collect();
    let projected = known_light::projected(&trial.linear, camera, MAP)?;
    let picture = trial.under(&projected, &transport, false);
    let projected = Errors {
        azimuth: f64::NAN,
        elevation: f64::NAN,
        rmse: rmse(&picture, &truth, &touched(&objective)),
    };
    errors.insert("2b photograph projected", projected);
    let sun = trial.place.sun();
    let json = serde_json::json!({
        "scene": index, "reading": reading,
        "truth": {"azimuth": sun.azimuth, "elevation": sun.elevation, "share": trial.place.light.share},
    });
    Ok((errors, json))
}

fn main() -> anyhow::Result<()> {
    let Some(arguments) = Arguments::parse()? else {
        return Ok(());
    };
    // SAFETY: no other thread runs yet.
    unsafe { std::env::set_var("CANDLE_NUM_THREADS", "1") };
    let mut model = Model::load(&arguments.model, DType::F32, &Device::Cpu)?;
    add_placeholders(&mut model.tokenizer);
    let mut rows: BTreeMap<&str, Vec<Errors>> = BTreeMap::new();
    let mut readings = Vec::new();
    for index in arguments.first..arguments.first + arguments.scenes {
        let (errors, reading) = measure(&arguments, &model, index)?;
        errors
            .into_iter()
            .for_each(|(name, e)| rows.entry(name).or_default().push(e));
        readings.push(reading);
        eprintln!("scene {index}");
    }
    if let Some(path) = &arguments.json {
        std::fs::write(path, serde_json::to_string(&readings)?)?;
    }
    println!(
        "| light from | azimuth, median | within 30 degrees | elevation, median | RMSE, median (95%) | \
         RMSE, mean | beside encoder (95%) |\n|---|---|---|---|---|---|---|"
    );
    for (name, errors) in &rows {
        let summary =
            |f: fn(&Errors) -> f64| Summary::of(&errors.iter().map(f).collect::<Vec<_>>(), 1);
        let median = |s: Option<Summary>| s.map_or("-".into(), |s| format!("{:.1}", s.median));
        let near = errors.iter().filter(|e| e.azimuth <= 30.0).count() as f64 / errors.len() as f64;
        let beside: Vec<f64> = errors
            .iter()
            .zip(&rows[ENCODER])
            .map(|(e, b)| e.rmse - b.rmse)
            .collect();
        let (rmse, beside) = (summary(|e| e.rmse), Summary::of(&beside, 1));
        println!(
            "| {name} | {} | {near:.2} | {} | {} | {:.4} | {} |",
            median(summary(|e| e.azimuth)),
            median(summary(|e| e.elevation)),
            rmse.map_or("-".into(), |s| s.text(4)),
            rmse.map_or(f64::NAN, |s| s.mean),
            beside.map_or("-".into(), |s| s.text(4)),
        );
    }
    Ok(())
}
