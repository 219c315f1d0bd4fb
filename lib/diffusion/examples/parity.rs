//! Compares a model at its real size with the references beside it:
//!
//!     python tests/references/make.py --full sd21 FOLDER
//!     cargo run --release -p dipir-diffusion --example parity -- FOLDER
//!
//! Prints the relative error of every part; fails above 1e-4.

#[path = "../tests/comparison/mod.rs"]
mod comparison;

use std::path::PathBuf;
use std::time::Instant;

use candle_core::{DType, Device};
use comparison::{Errors, Expected, Outcome};
use dipir_diffusion::model::Model;

fn main() -> Outcome<()> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("usage: parity FOLDER")?);
    let start = Instant::now();
    let model = Model::load(&folder, DType::F32, &Device::Cpu)?;
    let expected = Expected::open(&folder.join("expected.safetensors"))?;
    println!("loaded in {:.1} s", start.elapsed().as_secs_f64());
    let wrong = comparison::tokenizer(&folder, &model)?;
    println!("{} token sequences differ {wrong:?}", wrong.len());
    let mut worst = 0f64;
    let mut report = |name: &str, start: Instant, errors: Errors| {
        let mut errors = errors;
        errors.sort_by(|a, b| b.1.total_cmp(&a.1));
        println!(
            "{name}: {} values, {:.1} s; the largest relative errors:",
            errors.len(),
            start.elapsed().as_secs_f64()
        );
        for (what, error) in errors.iter().take(4) {
            println!("  {error:.2e} {what}");
        }
        worst = worst.max(errors.first().map_or(0.0, |(_, e)| *e));
    };
    let start = Instant::now();
    report(
        "text encoder",
        start,
        comparison::text_encoder(&folder, &model, &expected)?,
    );
    let start = Instant::now();
    report("vae", start, comparison::vae(&model, &expected)?);
    let start = Instant::now();
    report("unet", start, comparison::unet(&model, &expected)?);
    let start = Instant::now();
    report(
        "lora",
        start,
        comparison::lora(&folder, &model, &expected, true)?,
    );
    if worst < 1e-4 && wrong.is_empty() {
        Ok(())
    } else {
        Err(format!("worst relative error {worst:.2e}").into())
    }
}
