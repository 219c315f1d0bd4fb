//! Parity with diffusers, transformers and peft on small models of each
//! family; references and the script that made them are in tests/references.

mod comparison;

use std::path::PathBuf;

use candle_core::{DType, Device, Tensor};
use comparison::{Errors, Expected, Outcome, relative_error};
use dipir_diffusion::model::Model;
use dipir_diffusion::sampler::{Sampler, Solver};
use dipir_diffusion::schedule::{NoiseSchedule, ScheduleConfig};

/// f32 against f32 with other orders of summation: about 1e-6 a layer.
const TOLERANCE: f64 = 1e-4;

fn references() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/references")
}

fn open(family: &str) -> Outcome<(PathBuf, Model, Expected)> {
    let folder = references().join(family);
    let model = Model::load(&folder, DType::F32, &Device::Cpu)?;
    let expected = Expected::open(&folder.join("expected.safetensors"))?;
    Ok((folder, model, expected))
}

fn assert_close(family: &str, errors: Errors) {
    assert!(!errors.is_empty());
    for (what, error) in errors {
        assert!(
            error < TOLERANCE,
            "{family}: {what}: relative error {error:.2e}"
        );
    }
}

fn compare(family: &str) -> Outcome<()> {
    let (folder, model, expected) = open(family)?;
    let wrong = comparison::tokenizer(&folder, &model)?;
    assert!(wrong.is_empty(), "{family}: {wrong:#?}");
    assert_close(
        family,
        comparison::text_encoder(&folder, &model, &expected)?,
    );
    assert_close(family, comparison::vae(&model, &expected)?);
    assert_close(family, comparison::unet(&model, &expected)?);
    assert_close(family, comparison::lora(&folder, &model, &expected, false)?);
    Ok(())
}

#[test]
fn stable_diffusion_1_5_agrees_with_diffusers() -> Outcome<()> {
    compare("sd15")
}

#[test]
fn stable_diffusion_2_1_agrees_with_diffusers() -> Outcome<()> {
    compare("sd21")
}

#[test]
fn inpainting_model_agrees_with_diffusers() -> Outcome<()> {
    compare("inpaint")
}

#[test]
fn model_whose_timestep_hears_the_pooled_text_agrees_with_diffusers() -> Outcome<()> {
    compare("pooled")
}

#[test]
fn every_sampler_step_agrees_with_diffusers() -> Outcome<()> {
    let cases: Vec<serde_json::Value> =
        serde_json::from_slice(&std::fs::read(references().join("schedulers.json"))?)?;
    let expected = Expected::open(&references().join("schedulers.safetensors"))?;
    assert!(cases.len() >= 10);
    for case in cases {
        let key = case["key"].as_str().ok_or("key")?;
        let config: ScheduleConfig = serde_json::from_value(case["config"].clone())?;
        let schedule = NoiseSchedule::new(config)?;
        let solver = if case["kind"] == "ddim" {
            Solver::Ddim
        } else {
            Solver::DpmSolver2M
        };
        let steps: usize = serde_json::from_value(case["steps"].clone())?;
        let mut sampler = Sampler::new(&schedule, solver, steps)?;
        let timesteps: Vec<usize> = serde_json::from_value(case["timesteps"].clone())?;
        assert_eq!(sampler.timesteps(), timesteps, "{key}");
        let alphas: Vec<f32> = (0..schedule.len())
            .map(|t| schedule.alpha_bar(t).map(|a| a as f32))
            .collect::<Result<_, _>>()?;
        let error = relative_error(
            &Tensor::new(alphas, &Device::Cpu)?,
            &expected.get(&format!("{key}.alphas"))?,
        )?;
        assert!(error < TOLERANCE, "{key}: alpha bars: {error:.2e}");
        let (outputs, states) = (
            expected.get(&format!("{key}.outputs"))?,
            expected.get(&format!("{key}.states"))?,
        );
        let mut x = states.get(0)?;
        for index in 0..steps {
            x = sampler.step(index, &outputs.get(index)?, &x)?;
            let error = relative_error(&x, &states.get(index + 1)?)?;
            assert!(error < TOLERANCE, "{key}: step {index}: {error:.2e}");
        }
    }
    Ok(())
}
