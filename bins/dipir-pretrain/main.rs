//! `dipir-pretrain`: trains the small model that estimates light, and measures it.
use std::ops::ControlFlow;
use std::process::ExitCode;
use std::sync::Mutex;
use std::time::Instant;

use dipir_cli::args::OutputArgs;
use dipir_cli::exit;
use dipir_cli::interrupt::{self, Interrupted};
use dipir_cli::output::{json_path, print_bytes};
use dipir_cli::progress::Progress;
use dipir_cli::session::duration;
use dipir_places::Progress as Step;
use dipir_places::figures::table;
use dipir_places::place::Place;
use dipir_pretraining::command_line::{
    CheckArgs, Cli, Command, DataArgs, EncoderArgs, FoldsArgs, LightArgs, SheetArgs, TrainArgs,
};
use dipir_pretraining::dataset::{Dataset, SceneMix};
use dipir_pretraining::trainer::TrainerSettings;
use dipir_pretraining::training_run::{self, ModelRun, load_model};
use dipir_pretraining::{checks, contact_sheet};
use dipir_prior::encoder::{self, LightEncoder};
use serde_json::json;

fn main() -> ExitCode {
    exit::run(|| {
        let cli = exit::parse::<Cli>()?;
        // All commands look for an interruption every few seconds, and a training saves its weights then.
        interrupt::listen_patiently()?;
        match &cli.command {
            Command::Train(args) => train(args, &cli.output),
            Command::Encoder(args) => train_encoder(args, &cli.output),
            Command::Light(args) => train_light(args, &cli.output),
            Command::Folds(args) => folds(args),
            Command::Check(args) => check(args, &cli.output),
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

fn scenes(
    data: &DataArgs,
    mix: SceneMix,
    seed: u64,
    output: &OutputArgs,
) -> anyhow::Result<Dataset> {
    let progress = Progress::new("scenes", output.quiet);
    let report = &mut |share| {
        progress.set(share);
        go_on()
    };
    let dataset = training_run::scenes(&data.cache, data.scenes, mix, seed, report)?;
    progress.done();
    dataset.ok_or_else(|| Interrupted.into())
}

fn train(args: &TrainArgs, output: &OutputArgs) -> anyhow::Result<()> {
    let mut run = ModelRun::open(args.run()?)?;
    let data = scenes(&args.data, SceneMix::OpenAndStreets, args.seed, output)?;
    let progress = Progress::new("training", output.quiet);
    let clock = Instant::now();
    let summary = run.train(&data, &mut |state| {
        let stop = go_on();
        progress.set(state.seen as f64 / args.samples.max(1) as f64);
        if stop.is_break() || state.at_checkpoint {
            progress.note(&state.to_string());
        }
        progress.say(state.to_string());
        stop
    })?;
    progress.done();
    interrupt::check()?;
    let (folder, seconds) = (&args.data.out, clock.elapsed().as_secs_f64());
    output.result(
        || {
            let loss = summary
                .loss
                .map_or(String::new(), |l| format!(", loss {l:.4}"));
            let (folder, seen) = (folder.display(), summary.seen);
            format!(
                "wrote {folder}: {seen} examples{loss}, in {}",
                duration(seconds)
            )
        },
        || {
            json!({
                "folder": json_path(folder), "examples": summary.seen, "resumed_at": summary.resumed_at,
                "loss": summary.loss, "elapsed_s": seconds,
            })
        },
    );
    Ok(())
}

fn train_encoder(args: &EncoderArgs, output: &OutputArgs) -> anyhow::Result<()> {
    let run = args.run()?;
    run.check()?;
    // The seed of the run does not change its scenes.
    let seed = TrainerSettings::default().seed;
    let data = scenes(&args.data, SceneMix::WithCourtyards, seed, output)?;
    let progress = Progress::new("encoder", output.quiet);
    let loss = run.train(&data, &mut |seen, loss, is_saved| {
        progress.set(seen as f64 / args.samples as f64);
        let state = format!("{seen} pictures, loss {loss:.4}");
        if is_saved {
            progress.note(&state);
        }
        progress.say(state);
        go_on()
    })?;
    progress.done();
    let loss = loss.ok_or(Interrupted)?;
    let path = args.data.out.join(encoder::FILE);
    output.result(
        || format!("wrote {}, loss {loss:.4}", path.display()),
        || json!({"file": json_path(&path), "examples": args.samples, "loss": loss}),
    );
    Ok(())
}

fn train_light(args: &LightArgs, output: &OutputArgs) -> anyhow::Result<()> {
    let settings = args.settings()?;
    let (progress, clock) = (Progress::new("light", output.quiet), Instant::now());
    let done = Mutex::new(vec![0.0; settings.folds]);
    let outcome = dipir_places::run(&settings, &|step| {
        let (fold, share) = match step {
            Step::Training(fold, share, _) => (fold, share),
            Step::Kept(fold) => (fold, 1.0),
            Step::Places(_) | Step::Photographs(_) => return !interrupt::asked(),
        };
        if let Ok(mut done) = done.lock() {
            done[fold] = share;
            progress.set(done.iter().sum::<f64>() / done.len() as f64);
        }
        !interrupt::asked()
    });
    interrupt::check()?;
    let outcome = outcome?;
    progress.done();
    let (file, seconds) = (&args.out, clock.elapsed().as_secs_f64());
    output.result(
        || {
            let tables = [
                ("as dipir-evaluate takes photographs", &outcome.standard),
                ("any camera", &outcome.any),
                ("places that were trained on", &outcome.seen),
            ];
            let texts = tables.map(|(name, rows)| format!("{name}\n{}", table(rows)));
            format!(
                "{}\nwrote {} in {}",
                texts.join("\n"),
                file.display(),
                duration(seconds)
            )
        },
        || json!({"file": json_path(file), "standard": outcome.standard, "any": outcome.any, "elapsed_s": seconds}),
    );
    Ok(())
}

fn folds(args: &FoldsArgs) -> anyhow::Result<()> {
    let places = dipir_places::place::read_places(&args.panoramas)?;
    let count = usize::try_from(args.folds)?;
    let folds = dipir_places::place::filled_folds(&args.panoramas, &places, count)?;
    let line = |(place, fold): (&Place, &usize)| format!("{}\t{fold}\n", place.name);
    let text: String = places.iter().zip(&folds).map(line).collect();
    print_bytes(text.as_bytes());
    Ok(())
}

fn check(args: &CheckArgs, output: &OutputArgs) -> anyhow::Result<()> {
    args.check()?;
    let model = load_model(&args.model)?;
    let encoder = LightEncoder::load(&args.model)?;
    let progress = Mutex::new(Progress::new("checks", output.quiet));
    let report = |done: usize| {
        if let Ok(progress) = progress.lock() {
            progress.set(done as f64 / args.scenes as f64);
        }
        go_on()
    };
    let found = checks::measure(
        &model,
        encoder.as_ref(),
        args.first,
        args.scenes,
        args.draws,
        &args.timesteps,
        &report,
    )?;
    drop(progress);
    interrupt::check()?;
    output.result(
        || {
            let (scenes, draws, timesteps) = (found.scenes, args.draws, args.timesteps.len());
            format!("{scenes} held-out scenes, {draws} draws of noise at each of {timesteps} timesteps\n{found}")
        },
        || json!(found),
    );
    Ok(())
}

fn sheet(args: &SheetArgs) -> anyhow::Result<()> {
    contact_sheet::check_path(&args.png)?;
    let model = load_model(&args.model)?;
    let progress = Progress::new("sheet", false);
    let finished = contact_sheet::sample_lights(&model, &args.png, &mut |share| {
        progress.set(share);
        go_on()
    })?;
    progress.done();
    match finished {
        true => Ok(()),
        false => Err(Interrupted.into()),
    }
}
