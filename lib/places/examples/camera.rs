//! Trains the networks that score a photograph's camera, and prints how well it is told of places left out:
//! `cargo run -p dipir-places --example camera -- PANORAMAS OUT [key=value]...` with the keys folds, views, learned,
//! judged, built, seed; and hidden, epochs, batch, dropout, features, decay, rate of the networks that score, with
//! `whole.` before them of those that see pictures as a whole.
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use dipir_places::cameras::{Progress, Settings, run, table};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(panoramas), Some(out)) = (arguments.next(), arguments.next()) else {
        return Err("usage: camera PANORAMAS OUT [key=value]...".into());
    };
    let mut settings = Settings::new(PathBuf::from(panoramas), PathBuf::from(out));
    for argument in arguments {
        let (key, value) = argument.split_once('=').ok_or("arguments are key=value")?;
        match key {
            "folds" => settings.folds = value.parse()?,
            "views" => settings.views = value.parse()?,
            "learned" => settings.learned = value.parse()?,
            "judged" => settings.judged = value.parse()?,
            "built" => settings.built = value.parse()?,
            "seed" => settings.seed = value.parse()?,
            _ => set(&mut settings, key, value)?,
        }
    }
    let shown = AtomicUsize::new(0);
    let outcome = run(&settings, &|p| match p {
        Progress::Training(fold, done, loss) => {
            if shown.fetch_add(1, Ordering::Relaxed).is_multiple_of(4) {
                eprintln!("fold {fold}: {:.0}%, loss {loss:.3}", 100.0 * done);
            }
        }
        other => eprintln!("{other:?}"),
    })?;
    println!(
        "trust {}\n\nplaces left out\n{}",
        outcome.trust,
        table(&outcome.rows)
    );
    println!("generated\n{}", table(&outcome.built));
    println!(
        "panoramas of half the resolution: field of view times {:.3}",
        outcome.blurred
    );
    Ok(())
}

/// Sets how the networks are trained.
fn set(settings: &mut Settings, key: &str, value: &str) -> Result<(), Box<dyn std::error::Error>> {
    let (training, name) = match key.strip_prefix("whole.") {
        Some(name) => (&mut settings.wholes, name),
        None => (&mut settings.scorers, key),
    };
    match name {
        "hidden" => training.hidden = value.parse()?,
        "epochs" => training.epochs = value.parse()?,
        "dropout" => training.dropout = value.parse()?,
        "features" => training.feature_dropout = value.parse()?,
        "batch" => training.batch = value.parse()?,
        "decay" => training.weight_decay = value.parse()?,
        "rate" => training.learning_rate = value.parse()?,
        _ => return Err(format!("unknown key `{key}`").into()),
    }
    Ok(())
}
