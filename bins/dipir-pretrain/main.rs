//! `dipir-pretrain`: trains the small model that knows light, and measures it.
mod cli;

use std::ops::ControlFlow;
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Context, bail};
use candle_core::{DType, Device};
use clap::Parser;
use cli::{Cli, Command, Data, Encoder, Gates, Sheet, Train};
use dipir_cli::args::OutputArgs;
use dipir_cli::exit::{self, Usage};
use dipir_cli::interrupt::{self, Interrupted};
use dipir_cli::progress::Progress;
use dipir_cli::session::duration;
use dipir_diffusion::generate::{GenerateSettings, generate};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::Solver;
use dipir_diffusion::weights::Weights;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_prior::blueprint::{Blueprint, WEIGHT_FILES};
use dipir_prior::dataset::{Dataset, DatasetSettings, Places};
use dipir_prior::encoder::{self, EncoderSettings, LightEncoder};
use dipir_prior::examples::{Recipe, SIZE};
use dipir_prior::gates;
use dipir_prior::student::add_placeholders;
use dipir_prior::studio::Kinds;
use dipir_prior::trainer::{Trainer, TrainerSettings};
use glam::Vec3;
use serde_json::json;

fn main() -> ExitCode {
    exit::run(|| {
        let cli = Cli::parse();
        // All commands look every few seconds, and training has weights to save.
        interrupt::listen_patiently()?;
        match &cli.command {
            Command::Train(args) => train(args, &cli.output),
            Command::Encoder(args) => train_encoder(args, &cli.output),
            Command::Gates(args) => measure(args, &cli.output),
            Command::Sheet(args) => sheet(args),
        }
    })
}

fn go_on() -> ControlFlow<()> {
    match interrupt::asked() {
        true => ControlFlow::Break(()),
        false => ControlFlow::Continue(()),
    }
}

/// Renders what is missing of the training scenes.
fn scenes(data: &Data, places: Places, seed: u64, output: &OutputArgs) -> anyhow::Result<Dataset> {
    if data.scenes == 0 {
        return Err(Usage("--scenes 0: at least one scene is needed".into()).into());
    }
    let settings = DatasetSettings {
        seed,
        scenes: data.scenes,
        places,
        kinds: Kinds::Trained,
    };
    let progress = Progress::new("scenes", output.quiet);
    let dataset = Dataset::make(&data.cache.join("scenes"), &settings, &mut |done| {
        progress.set(done as f64 / data.scenes as f64);
        go_on()
    })?;
    progress.done();
    dataset.ok_or_else(|| Interrupted.into())
}

fn check_rate(rate: f64) -> anyhow::Result<()> {
    match rate > 0.0 && rate.is_finite() {
        true => Ok(()),
        false => {
            let message = format!("--learning-rate {rate}: accepted are numbers above 0");
            Err(Usage(message).into())
        }
    }
}

fn train(args: &Train, output: &OutputArgs) -> anyhow::Result<()> {
    for (name, share) in [
        ("light-words", args.light_words),
        ("background", args.background),
        ("relit", args.relit),
    ] {
        if !(0.0..=1.0).contains(&share) {
            return Err(Usage(format!("--{name} {share}: accepted are 0 to 1")).into());
        }
    }
    for (name, weight) in [("contrast", args.contrast), ("name-light", args.name_light)] {
        if !(weight >= 0.0 && weight.is_finite()) {
            let message = format!("--{name} {weight}: accepted are 0 and more");
            return Err(Usage(message).into());
        }
    }
    check_rate(args.learning_rate)?;
    if !(1..=8).contains(&args.layers) {
        return Err(Usage(format!("--layers {}: accepted are 1 to 8", args.layers)).into());
    }
    let settings = TrainerSettings {
        samples: args.samples,
        batch: args.batch,
        seed: args.seed,
        contrast: args.contrast,
        naming: args.name_light,
        learning_rate: args.learning_rate,
    };
    let recipe = Recipe {
        light_words: args.light_words,
        background: args.background,
        relit: args.relit,
        ..Recipe::default()
    };
    let blueprint = Blueprint {
        layers: args.layers,
        ..Blueprint::default()
    };
    let out = &args.data.out;
    let checkpoint = args.data.cache.join("checkpoint.safetensors");
    let from = args.from.as_ref().filter(|_| !checkpoint.is_file());
    // Before anything is written.
    if let Some(from) = from {
        for (_, file) in WEIGHT_FILES {
            Weights::open_file(&from.join(file))?;
        }
    }
    blueprint.write_configs(out)?;
    let mut trainer = Trainer::new(&blueprint, out, settings, recipe)?;
    match from {
        Some(from) => trainer.start_from(from)?,
        None if checkpoint.is_file() => trainer.resume(&checkpoint)?,
        None => {}
    }
    let data = scenes(&args.data, Places::Objects, args.seed, output)?;
    let resumed_at = trainer.seen();
    let progress = Progress::new("training", output.quiet);
    let clock = Instant::now();
    let mut mean: Option<f64> = None;
    let (mut surprise, mut naming) = (None, None);
    trainer.run(&data, &mut |trainer, update| {
        let loss = smooth(&mut mean, update.loss);
        progress.set(update.seen as f64 / args.samples.max(1) as f64);
        let mut state = format!("{} examples, loss {loss:.4}", update.seen);
        for (what, mean, now) in [
            ("surprise at the light", &mut surprise, update.surprise),
            ("light named to", &mut naming, update.naming),
        ] {
            if !now.is_nan() {
                state += &format!(", {what} {:.3}", smooth(mean, now));
            }
        }
        let stop = go_on();
        let every = (args.checkpoint_every.max(1) * args.batch).max(1);
        if stop.is_break() || update.seen.is_multiple_of(every) {
            trainer.save(&checkpoint)?;
            progress.note(&state);
        }
        progress.say(state);
        Ok(stop)
    })?;
    progress.done();
    trainer.save(&checkpoint)?;
    // Also of a run that is stopped: its gates can be measured, and it goes on from its checkpoint.
    blueprint.write_weights(out, trainer.average())?;
    interrupt::check()?;
    let seconds = clock.elapsed().as_secs_f64();
    output.result(
        || {
            let loss = mean.map_or(String::new(), |m| format!(", loss {m:.4}"));
            let (folder, seen) = (out.display(), trainer.seen());
            format!(
                "wrote {folder}: {seen} examples{loss}, in {}",
                duration(seconds)
            )
        },
        || {
            json!({
                "folder": out, "examples": trainer.seen(), "resumed_at": resumed_at,
                "loss": mean, "elapsed_s": seconds,
            })
        },
    );
    Ok(())
}

/// Takes `now` into a mean over about fifty updates.
fn smooth(mean: &mut Option<f64>, now: f64) -> f64 {
    let smoothed = mean.map_or(now, |m| 0.98 * m + 0.02 * now);
    *mean = Some(smoothed);
    smoothed
}

fn train_encoder(args: &Encoder, output: &OutputArgs) -> anyhow::Result<()> {
    check_rate(args.learning_rate)?;
    args.sheet.as_deref().map_or(Ok(()), check_place)?;
    let from = args.from.as_deref();
    if let Some(from) = from {
        Weights::open_file(&from.join(encoder::FILE))?;
    }
    let seed = TrainerSettings::default().seed;
    let data = scenes(&args.data, Places::Anywhere, seed, output)?;
    let settings = EncoderSettings {
        samples: args.samples,
        seed: args.seed,
        learning_rate: args.learning_rate,
    };
    std::fs::create_dir_all(&args.data.out)
        .with_context(|| format!("cannot create {}", args.data.out.display()))?;
    if let Some(png) = &args.sheet {
        const COLUMNS: usize = 12;
        let pictures = encoder::pictures(&data, 8 * COLUMNS, args.seed)?;
        write_sheet(png, &pictures, SIZE, COLUMNS)?;
    }
    let progress = Progress::new("encoder", output.quiet);
    let mut mean: Option<f64> = None;
    let finished = encoder::train(&data, &settings, from, &args.data.out, &mut |seen, loss| {
        let loss = smooth(&mut mean, loss);
        progress.set(seen as f64 / args.samples as f64);
        let state = format!("{seen} pictures, loss {loss:.4}");
        if seen.is_multiple_of(encoder::SAVED_EVERY) {
            progress.note(&state);
        }
        progress.say(state);
        go_on()
    })?;
    progress.done();
    if !finished {
        return Err(Interrupted.into());
    }
    let path = args.data.out.join(encoder::FILE);
    output.result(
        || {
            format!(
                "wrote {}, loss {:.4}",
                path.display(),
                mean.unwrap_or(f64::NAN)
            )
        },
        || json!({"file": path, "examples": args.samples, "loss": mean}),
    );
    Ok(())
}

fn load(folder: &Path) -> anyhow::Result<Model> {
    let mut model = Model::load(folder, DType::F32, &Device::Cpu)?;
    add_placeholders(&mut model.tokenizer);
    Ok(model)
}

fn measure(args: &Gates, output: &OutputArgs) -> anyhow::Result<()> {
    if args.scenes == 0 || args.draws == 0 {
        return Err(Usage("--scenes and --draws must be at least 1".into()).into());
    }
    if let Some(t) = args.timesteps.iter().find(|t| !(0.0..1.0).contains(*t)) {
        return Err(Usage(format!("--timesteps {t}: accepted are 0 to below 1")).into());
    }
    let model = load(&args.model)?;
    let progress = std::sync::Mutex::new(Progress::new("gates", output.quiet));
    let encoder = LightEncoder::load(&args.model)?;
    let found = gates::measure(
        &model,
        encoder.as_ref(),
        args.first,
        args.scenes,
        args.draws,
        &args.timesteps,
        &|done| {
            if let Ok(progress) = progress.lock() {
                progress.set(done as f64 / args.scenes as f64);
            }
            go_on()
        },
    )?;
    drop(progress);
    interrupt::check()?;
    output.result(
        || {
            let percent = |share: f64| format!("{:.1}%", 100.0 * share);
            let degrees = |angle: f64| format!("{angle:.1}");
            let column = |name: &str, scenes: usize, sign: Option<f64>, of: &gates::Recognition| {
                [
                    name.to_owned(),
                    scenes.to_string(),
                    sign.map_or_else(String::new, percent),
                    percent(of.over_opposite),
                    percent(of.over_mirror),
                    percent(of.over_45),
                    degrees(of.azimuth_median),
                    percent(of.within_30),
                ]
            };
            let of_gates = |name: &str, g: &gates::Gates| {
                column(name, g.scenes, Some(g.gradient_sign), &g.recognition)
            };
            let mut columns = vec![of_gates("found", &found)];
            columns.extend(found.by_shape.iter().map(|(k, v)| of_gates(k, v)));
            columns.extend(
                found
                    .encoder
                    .map(|e| column("encoder", found.scenes, None, &e)),
            );
            let rows = GATES.iter().enumerate().map(|(i, (what, wanted))| {
                let values = columns.iter().map(|c| format!(" {:>8}", c[i]));
                format!("\n{what:<51}{wanted:>7}{}", values.collect::<String>())
            });
            [format!(
                "{} held-out scenes, {} draws of noise at each of {} timesteps",
                found.scenes,
                args.draws,
                args.timesteps.len(),
            )]
            .into_iter()
            .chain(rows)
            .collect::<String>()
        },
        || json!(found),
    );
    Ok(())
}

/// Rows of the table of gates, and what is wanted of each.
const GATES: [(&str, &str); 8] = [
    ("gate", "wanted"),
    ("scenes", ""),
    ("LDS 25 degrees off points back to the true azimuth", "97%"),
    ("true light preferred to the opposite one", "98%"),
    ("true light preferred to its image, left and right", "98%"),
    ("true light preferred to one 45 degrees off", "90%"),
    ("best azimuth from the true one, median, degrees", "10"),
    ("best azimuth within 30 degrees of the true one", ""),
];

/// Rows of the contact sheet: what is asked for, in words of the vocabulary.
const ASKED: [&str; 6] = [
    "sun at three, low, clear",
    "sun at six, middle, clear",
    "sun at nine, low, clear",
    "sun at twelve, middle, clear",
    "sun at three, high, hazy",
    "overcast",
];

fn sheet(args: &Sheet) -> anyhow::Result<()> {
    check_place(&args.png)?;
    let model = load(&args.model)?;
    let classes = ["red car", "white ball", "yellow box", "blue cone"];
    let side = model.unet.config().sample_size * model.vae.downscale();
    let repeats = 2;
    let (columns, rows) = (classes.len() * repeats, ASKED.len());
    let mut pictures = vec![];
    let progress = Progress::new("sheet", false);
    for (row, light) in ASKED.iter().enumerate() {
        for column in 0..columns {
            interrupt::check()?;
            let prompt = format!("a photo of a {}, {light}", classes[column / repeats]);
            let settings = GenerateSettings {
                solver: Solver::DpmSolver2M,
                steps: 30,
                guidance: 4.0,
                size: (side, side),
                // The same noise down a column: only the light differs.
                seed: column as u64,
            };
            let made = generate(&model, &prompt, &settings, &Pass::default(), None, |_| {
                !interrupt::asked()
            })?;
            let pixels = made.image.flatten_all()?.to_vec1::<f32>()?;
            pictures.push(pixels.iter().map(|v| 0.5 * v + 0.5).collect());
            progress.set((row * columns + column + 1) as f64 / (rows * columns) as f64);
        }
    }
    progress.done();
    write_sheet(&args.png, &pictures, side, columns)
}

/// That a picture can be put at `png`, before the minutes that it takes to make it.
fn check_place(png: &Path) -> anyhow::Result<()> {
    let folder = png.parent().filter(|f| !f.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|f| !f.is_dir()) {
        bail!(
            "cannot write {}: there is no folder {}; create it first",
            png.display(),
            folder.display()
        );
    }
    if png.is_dir() {
        bail!("cannot write {}: it is a folder", png.display());
    }
    Ok(())
}

/// Writes pictures [3, side, side] in [0, 1] side by side.
fn write_sheet(
    png: &Path,
    pictures: &[Vec<f32>],
    side: usize,
    columns: usize,
) -> anyhow::Result<()> {
    let rows = pictures.len().div_ceil(columns);
    let mut sheet = Raster::filled(columns * side, rows * side, Vec3::ZERO);
    for (k, picture) in pictures.iter().enumerate() {
        let (left, top) = (k % columns * side, k / columns * side);
        for i in 0..side * side {
            let at = |c: usize| picture[c * side * side + i].clamp(0.0, 1.0);
            *sheet.get_mut(left + i % side, top + i / side) = Vec3::new(at(0), at(1), at(2));
        }
    }
    write_enlarged(png, &sheet)
}

/// Writes a picture three times as large.
fn write_enlarged(png: &Path, picture: &Raster<Vec3>) -> anyhow::Result<()> {
    let (width, height) = (3 * picture.width(), 3 * picture.height());
    let pixels = (0..width * height).map(|i| *picture.get(i % width / 3, i / width / 3));
    let enlarged = Raster::from_pixels(width, height, pixels.collect());
    write_png(png, &DisplayImage(enlarged))?;
    Ok(())
}
