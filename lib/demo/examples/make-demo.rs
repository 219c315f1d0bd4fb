//! Makes everything in `data/demo`.
//!
//! `cargo run --release -p dipir-demo --example make-demo [-- FOLDER [SAMPLES]]`
use std::path::PathBuf;

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let folder = PathBuf::from(args.next().unwrap_or_else(|| "data/demo".into()));
    let samples: u32 = args.next().map_or(Ok(256), |s| s.parse())?;
    dipir_demo::make(&folder, samples, &mut |file| println!("{file}"))
}
