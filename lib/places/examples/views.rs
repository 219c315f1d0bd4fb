//! How much better several photographs of a place tell its light than one, on places left out:
//! `cargo run -p dipir-places --example views -- PANORAMAS WEIGHTS [any]`, where training with `--keep-folds` left
//! `.foldN` beside WEIGHTS. With `any` cameras and exposures are drawn.
use std::path::PathBuf;

use dipir_places::LeftOut;
use dipir_places::several::{run, table};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(panoramas), Some(weights)) = (arguments.next(), arguments.next()) else {
        return Err("usage: views PANORAMAS WEIGHTS [any]".into());
    };
    let any = match arguments.next().as_deref() {
        None => false,
        Some("any") => true,
        Some(other) => return Err(format!("`{other}` is not `any`").into()),
    };
    let left_out = LeftOut::read(&PathBuf::from(panoramas), &PathBuf::from(weights))?;
    println!("{}", table(&run(&left_out, any)));
    if let Some(note) = left_out.note() {
        println!("{note}");
    }
    Ok(())
}
