//! Trains the light estimator: `cargo run -p dipir-places --example train -- PANORAMAS OUT [key=value]...` with the keys
//! folds, networks, views, judged, places, seed, hidden, epochs, dropout, decay, rate.
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use dipir_places::figures::table;
use dipir_places::{Progress, Settings, run};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(panoramas), Some(out)) = (arguments.next(), arguments.next()) else {
        return Err("usage: train PANORAMAS OUT [key=value]...".into());
    };
    let mut settings = Settings::new(PathBuf::from(panoramas), PathBuf::from(out));
    for argument in arguments {
        let (key, value) = argument.split_once('=').ok_or("arguments are key=value")?;
        match key {
            "networks" => settings.networks = value.parse()?,
            "folds" => settings.folds = value.parse()?,
            "views" => settings.views = value.parse()?,
            "judged" => settings.judged = value.parse()?,
            "places" => settings.places = Some(value.parse()?),
            "seed" => settings.seed = value.parse()?,
            "hidden" => settings.training.hidden = value.parse()?,
            "epochs" => settings.training.epochs = value.parse()?,
            "dropout" => settings.training.dropout = value.parse()?,
            "decay" => settings.training.weight_decay = value.parse()?,
            "rate" => settings.training.learning_rate = value.parse()?,
            _ => return Err(format!("unknown key `{key}`").into()),
        }
    }
    let shown = AtomicUsize::new(0);
    let outcome = run(&settings, &|p| {
        match p {
            Progress::Training(f, done, loss) => {
                if shown.fetch_add(1, Ordering::Relaxed).is_multiple_of(40) {
                    eprintln!("fold {f}: {:.0}%, loss {loss:.4}", 100.0 * done);
                }
            }
            other => eprintln!("{other:?}"),
        }
        true
    })?;
    println!("calibration {:?}\n", outcome.calibration);
    for (name, rows) in [
        ("standard", &outcome.standard),
        ("any", &outcome.any),
        ("seen", &outcome.seen),
    ] {
        println!("{name}\n{}", table(rows));
    }
    Ok(())
}
