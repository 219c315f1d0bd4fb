//! Times a whole model at its real size for tests/references/time_model.py:
//!
//!     model_times FOLDER [bf16]
//!
//! Prints wall and processor seconds of "forward", "text" (the text encoder)
//! and "step" (a LoRA step with recomputation, one example, its text encoded),
//! "peak_mib", the mebibytes of the whole process so far, then "encode" and
//! "gradient" (the autoencoder's encoder, and that with the gradient at the image).

use std::path::PathBuf;
use std::time::Instant;

use candle_core::{DType, Device};
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::training::{Example, LoraTrainer, TrainingConfig, TrainingData};

type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

struct OneExample(Example);

impl TrainingData for OneExample {
    fn instance(&self, _: &mut NoiseStream) -> dipir_diffusion::Result<Example> {
        Ok(self.0.clone())
    }

    fn prior(&self, _: &mut NoiseStream) -> dipir_diffusion::Result<Option<Example>> {
        Ok(None)
    }
}

/// Seconds that the process has spent on processors so far.
fn processor_seconds() -> Outcome<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    // After the name in brackets: fields 14 and 15, in ticks of 10 ms.
    let fields: Vec<&str> = stat
        .rsplit(')')
        .next()
        .ok_or("stat")?
        .split_whitespace()
        .collect();
    Ok((fields[11].parse::<f64>()? + fields[12].parse::<f64>()?) / 100.0)
}

fn main() -> Outcome<()> {
    dipir_diffusion::memory::keep_freed();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (folder, dtype) = match arguments.as_slice() {
        [folder] => (PathBuf::from(folder), DType::F32),
        [folder, word] if word == "bf16" => (PathBuf::from(folder), DType::BF16),
        _ => return Err("usage: model_times FOLDER [bf16]".into()),
    };
    let model = Model::load(&folder, dtype, &Device::Cpu)?;
    let latents = NoiseStream::new(1, 1)
        .normal_tensor(&[1, 4, 64, 64], DType::F32, &Device::Cpu)?
        .to_dtype(dtype)?;
    let context = model.encode_prompts(&["a photo of a car"], None)?;
    let report = |name: &str, run: &mut dyn FnMut() -> Outcome<()>| -> Outcome<()> {
        run()?;
        let (wall, processor) = (Instant::now(), processor_seconds()?);
        run()?;
        println!(
            "{name} {:.2} {:.2}",
            wall.elapsed().as_secs_f64(),
            processor_seconds()? - processor
        );
        Ok(())
    };
    report("forward", &mut || {
        model
            .unet
            .forward(&latents, &[500.0], &context, &Pass::default())?;
        Ok(())
    })?;
    report("text", &mut || {
        model.encode_prompts(&["a photo of a car"], None)?;
        Ok(())
    })?;
    let data = OneExample(Example {
        latents: latents.clone(),
        prompt: "a photo of a car".into(),
        inpaint: None,
    });
    let mut trainer = LoraTrainer::new(&model, TrainingConfig::default(), None)?;
    report("step", &mut || {
        trainer.step(&data)?;
        Ok(())
    })?;
    let status = std::fs::read_to_string("/proc/self/status")?;
    let peak = status
        .lines()
        .find_map(|l| l.strip_prefix("VmHWM:"))
        .ok_or("VmHWM")?;
    let kib: f64 = peak.trim().trim_end_matches(" kB").parse()?;
    println!("peak_mib {:.0}", kib / 1024.0);
    let image = NoiseStream::new(1, 2)
        .normal_tensor(&[1, 3, 512, 512], DType::F32, &Device::Cpu)?
        .to_dtype(dtype)?;
    report("encode", &mut || {
        model.vae.encode(&image)?;
        Ok(())
    })?;
    report("gradient", &mut || {
        model.vae.trace(&image)?.gradient(&latents)?;
        Ok(())
    })?;
    Ok(())
}
