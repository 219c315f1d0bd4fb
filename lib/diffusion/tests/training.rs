//! Fine-tuning on a small model: gradients of every matrix, resuming to the
//! same bytes, learning something.

use std::path::PathBuf;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::Error;
use dipir_diffusion::distillation::{InpaintCondition, ScoreDistillation, ScoreRule, Weighting};
use dipir_diffusion::lora::Lora;
use dipir_diffusion::model::Model;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::{Sampler, Solver, edit, guided, sample};
use dipir_diffusion::training::{Example, LoraTrainer, TrainingConfig, TrainingData};
use dipir_diffusion::validation::Validation;

type Outcome = Result<(), Box<dyn std::error::Error>>;

fn model(family: &str) -> dipir_diffusion::Result<Model> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("tests/references")
        .join(family);
    Model::load(&folder, DType::F32, &Device::Cpu)
}

fn normal(stream: u64, shape: &[usize]) -> Tensor {
    NoiseStream::new(17, stream)
        .normal_tensor(shape, DType::F32, &Device::Cpu)
        .expect("tensor")
}

struct Data {
    inpaint: bool,
    prior: bool,
}

impl Data {
    fn example(&self, stream: u64, prompt: &str) -> Example {
        let inpaint = self.inpaint.then(|| InpaintCondition {
            mask: Tensor::ones((1, 1, 8, 8), DType::F32, &Device::Cpu).expect("mask"),
            masked_latents: normal(stream + 50, &[1, 4, 8, 8]),
        });
        Example {
            latents: normal(stream, &[1, 4, 8, 8]),
            prompt: prompt.into(),
            inpaint,
        }
    }
}

impl TrainingData for Data {
    fn instance(&self, stream: &mut NoiseStream) -> dipir_diffusion::Result<Example> {
        Ok(self.example(
            stream.below(2) as u64,
            "a scene in the style of sks rendering",
        ))
    }

    fn prior(&self, stream: &mut NoiseStream) -> dipir_diffusion::Result<Option<Example>> {
        Ok(self
            .prior
            .then(|| self.example(10 + stream.below(2) as u64, "a photo of a car")))
    }
}

fn config() -> TrainingConfig {
    TrainingConfig {
        rank: 2,
        alpha: 2.0,
        warmup_steps: 2,
        learning_rate: 1e-2,
        ..TrainingConfig::default()
    }
}

/// Central differences with steps of 1e-2 on a loss of size 1: rounding of
/// 1e-6 / 1e-2 and truncation of 1e-4 against gradients of size 1e-2.
fn assert_gradients(family: &str) -> Outcome {
    let mut model = model(family)?;
    let vocabulary = model.text_encoder.config().vocab_size as u32;
    model.tokenizer.add_placeholder("sks", vocabulary);
    let start = model.text_encoder.embedding(5)?;
    for recompute in [false, true] {
        let trainer = LoraTrainer::new(
            &model,
            TrainingConfig {
                recompute: Some(recompute),
                ..config()
            },
            Some(&start),
        )?;
        // Zero `up` matrices would hide the gradient of `down`.
        for (name, variable) in trainer.lora().variables() {
            let mut stream = NoiseStream::named(3, name);
            variable
                .set(&(stream.normal_tensor(variable.dims(), DType::F32, &Device::Cpu)? * 0.2)?)?;
        }
        let data = Data {
            inpaint: family == "inpaint",
            prior: false,
        };
        let examples = [data.example(0, "a scene in the style of sks rendering")];
        let loss = || trainer.losses(&examples, &mut NoiseStream::new(4, 4));
        let gradients = trainer.gradients_of(&loss()?[0])?;
        let largest = |t: &Tensor| t.abs().and_then(|t| t.max_all()?.to_scalar::<f32>());
        assert_eq!(gradients.len(), trainer.lora().variables().len() + 1);
        if recompute {
            continue; // compared with the other way by `recomputation_changes_nothing`
        }
        let mut checked = 0;
        for (name, variable) in trainer.variables() {
            let gradient = &gradients[&name];
            let size = largest(gradient)?;
            assert!(
                size.is_finite() && size > 0.0,
                "{family}: {name}: gradient of size {size}"
            );
            // The direction of the gradient itself: the largest signal.
            let unit = (gradient / gradient.sqr()?.sum_all()?.sqrt()?.to_scalar::<f32>()? as f64)?;
            let kept = variable.as_detached_tensor().copy()?;
            let at = |shift: f64| -> Result<f64, Box<dyn std::error::Error>> {
                variable.set(&(&kept + (&unit * shift)?)?)?;
                Ok(loss()?[0].to_scalar::<f32>()? as f64)
            };
            let step = 2e-2;
            let numerical = (at(step)? - at(-step)?) / (2.0 * step);
            variable.set(&kept)?;
            let analytical = (gradient * &unit)?.sum_all()?.to_scalar::<f32>()? as f64;
            let error = (numerical - analytical).abs();
            assert!(
                error < 0.03 * analytical.abs() + 2e-4,
                "{family}: {name}: difference {numerical}, gradient {analytical}"
            );
            checked += 1;
        }
        assert!(checked > 30);
    }
    Ok(())
}

#[test]
fn every_adapter_and_the_token_of_1_5_get_the_gradient_of_the_loss() -> Outcome {
    assert_gradients("sd15")
}

#[test]
fn every_adapter_and_the_token_of_2_1_get_the_gradient_of_the_loss() -> Outcome {
    assert_gradients("sd21")
}

#[test]
fn every_adapter_and_the_token_of_an_inpainting_model_get_the_gradient_of_the_loss() -> Outcome {
    assert_gradients("inpaint")
}

#[test]
fn recomputation_changes_nothing() -> Outcome {
    let model = model("sd21")?;
    let data = Data {
        inpaint: false,
        prior: true,
    };
    let run = |recompute: bool| -> Result<Vec<f32>, Box<dyn std::error::Error>> {
        let mut trainer = LoraTrainer::new(
            &model,
            TrainingConfig {
                recompute: Some(recompute),
                ..config()
            },
            None,
        )?;
        for _ in 0..3 {
            trainer.step(&data)?;
        }
        let mut values = vec![];
        for variable in trainer.lora().variables().values() {
            values.extend(variable.flatten_all()?.to_vec1::<f32>()?);
        }
        Ok(values)
    };
    let (a, b) = (run(false)?, run(true)?);
    // Adam turns differences of rounding in the gradient of near-zero
    // elements into steps of the learning rate; most must agree closely.
    let far = a
        .iter()
        .zip(&b)
        .filter(|(a, b)| (*a - *b).abs() > 1e-4)
        .count();
    assert!(
        far * 100 <= a.len(),
        "{far} of {} parameters differ",
        a.len()
    );
    Ok(())
}

#[test]
fn a_resumed_run_ends_with_the_same_bytes() -> Outcome {
    let mut model = model("sd15")?;
    let vocabulary = model.text_encoder.config().vocab_size as u32;
    model.tokenizer.add_placeholder("sks", vocabulary);
    let start = model.text_encoder.embedding(5)?;
    let data = Data {
        inpaint: false,
        prior: true,
    };
    let folder = tempfile::tempdir()?;
    let (half, whole, resumed) = (
        folder.path().join("half"),
        folder.path().join("whole"),
        folder.path().join("resumed"),
    );
    let config = TrainingConfig {
        accumulation: 2,
        ..config()
    };
    let mut trainer = LoraTrainer::new(&model, config.clone(), Some(&start))?;
    for step in 0..4 {
        if step == 2 {
            trainer.save_checkpoint(&half)?;
        }
        trainer.step(&data)?;
    }
    trainer.save_checkpoint(&whole)?;
    let mut trainer = LoraTrainer::new(
        &model,
        TrainingConfig {
            steps: 9,
            ..config.clone()
        },
        Some(&start),
    )?;
    trainer.resume(&half)?;
    for _ in 2..4 {
        trainer.step(&data)?;
    }
    trainer.save_checkpoint(&resumed)?;
    assert!(
        std::fs::read(whole)? == std::fs::read(resumed)?,
        "the checkpoints differ"
    );
    // Another rank is another run.
    let mut other = LoraTrainer::new(&model, TrainingConfig { rank: 3, ..config }, Some(&start))?;
    let message = other.resume(&half).expect_err("other rank").to_string();
    assert!(message.contains("other settings"), "{message}");
    Ok(())
}

#[test]
fn training_lowers_the_loss_on_the_picture() -> Outcome {
    let model = model("sd15")?;
    let data = Data {
        inpaint: false,
        prior: false,
    };
    let mut trainer = LoraTrainer::new(&model, config(), None)?;
    let example = [data.example(0, "a scene in the style of sks rendering")];
    let average = |trainer: &LoraTrainer| -> Result<f64, Box<dyn std::error::Error>> {
        let mut sum = 0f64;
        for i in 0..16 {
            sum += trainer.losses(&example, &mut NoiseStream::new(8, i))?[0].to_scalar::<f32>()?
                as f64;
        }
        Ok(sum / 16.0)
    };
    let before = average(&trainer)?;
    for _ in 0..40 {
        let report = trainer.step(&data)?;
        assert!(report.loss.is_finite() && report.gradient_norm > 0.0);
    }
    let after = average(&trainer)?;
    assert!(after < 0.9 * before, "loss {before} became {after}");
    Ok(())
}

#[test]
fn the_loss_at_fixed_noise_falls_and_is_the_same_after_a_resumption() -> Outcome {
    let model = model("sd15")?;
    let data = Data {
        inpaint: false,
        prior: true,
    };
    let config = config();
    let mut trainer = LoraTrainer::new(&model, config.clone(), None)?;
    let validation = Validation::new(&trainer, &data, 6, |_| true)?;
    let start = validation.start();
    assert_eq!((start.step, start.change), (0, 0.0));
    // A fresh adapter is the un-adapted model.
    assert_eq!(
        validation.evaluate(&trainer, |_| true)?.instance_loss,
        start.instance_loss
    );
    for _ in 0..40 {
        trainer.step(&data)?;
    }
    let end = validation.evaluate(&trainer, |_| true)?;
    assert!(end.instance_loss < start.instance_loss, "{start:?} {end:?}");
    assert!(end.change > 0.0 && end.step == 40, "{end:?}");
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("checkpoint.safetensors");
    trainer.save_checkpoint(&path)?;
    let mut resumed = LoraTrainer::new(&model, config, None)?;
    let validation = Validation::new(&resumed, &data, 6, |_| true)?;
    resumed.resume(&path)?;
    assert_eq!(validation.evaluate(&resumed, |_| true)?, end);
    Ok(())
}

#[test]
fn a_cut_graph_is_refused_by_the_name_of_the_parameter() -> Outcome {
    let model = model("sd15")?;
    let trainer = LoraTrainer::new(&model, config(), None)?;
    let unrelated = candle_core::Var::new(1f32, &Device::Cpu)?;
    let loss = unrelated.as_tensor().sqr()?;
    match trainer.gradients_of(&loss) {
        Err(Error::Gradient { name, .. }) => assert!(name.ends_with("lora_A"), "{name}"),
        other => panic!("{other:?}"),
    }
    Ok(())
}

#[test]
fn a_fresh_adapter_changes_nothing_and_rows_choose_who_sees_it() -> Outcome {
    let model = model("sd15")?;
    let lora = Lora::new(&model.unet.adapter_targets(), 4, 4.0, 1, &Device::Cpu)?;
    assert_eq!(
        lora.adapters().len(),
        model
            .unet
            .adapter_targets()
            .iter()
            .filter(|t| t.is_attention())
            .count()
    );
    let x = normal(60, &[2, 4, 8, 8]);
    let context = model.encode_prompts(&["a car", ""], None)?;
    let run = |pass: &Pass| -> Result<Vec<Vec<f32>>, Box<dyn std::error::Error>> {
        Ok(model
            .unet
            .forward(&x, &[300.0], &context, pass)?
            .flatten_from(1)?
            .to_vec2()?)
    };
    let base = run(&Pass::default())?;
    let lora = std::sync::Arc::new(lora);
    assert_eq!(run(&Pass::with_lora(&lora))?, base);
    for variable in lora.variables().values() {
        variable.set(&(variable.ones_like()? * 0.1)?)?;
    }
    let all = run(&Pass::with_lora(&lora))?;
    let first = run(&Pass {
        lora_rows: Some(1),
        ..Pass::with_lora(&lora)
    })?;
    let close = |a: &[f32], b: &[f32]| {
        a.iter()
            .zip(b)
            .all(|(a, b)| (a - b).abs() < 1e-4 * (1.0 + b.abs()))
    };
    assert!(!close(&all[0], &base[0]));
    assert!(close(&first[0], &all[0]) && close(&first[1], &base[1]));
    // Row by row.
    let pass = Pass {
        lora_rows: Some(1),
        ..Pass::with_lora(&lora)
    };
    let apart = model.unet.predict(&x, &[300.0], &context, &pass)?;
    let apart: Vec<Vec<f32>> = apart.flatten_from(1)?.to_vec2()?;
    assert!(close(&apart[0], &first[0]) && close(&apart[1], &first[1]));
    Ok(())
}

/// The first update beside the gradient of one batch with the same draws.
#[test]
fn an_update_is_that_of_the_weighted_sum_of_both_losses() -> Outcome {
    let model = model("sd15")?;
    let data = Data {
        inpaint: false,
        prior: true,
    };
    let config = TrainingConfig {
        prior_weight: 0.3,
        ..config()
    };
    let mut trainer = LoraTrainer::new(&model, config.clone(), None)?;
    let mut stream = NoiseStream::new(config.seed, 1);
    let prior = |stream: &mut NoiseStream| {
        data.prior(stream)?
            .ok_or(Error::Argument("no prior".into()))
    };
    let examples = [data.instance(&mut stream)?, prior(&mut stream)?];
    let losses = trainer.losses(&examples, &mut stream)?;
    let gradients = trainer.gradients_of(&(&losses[0] + (&losses[1] * 0.3)?)?)?;
    let mut squares = 0f64;
    for gradient in gradients.values() {
        squares += gradient.sqr()?.sum_all()?.to_scalar::<f32>()? as f64;
    }
    let report = trainer.step(&data)?;
    let wanted = [losses[0].to_scalar::<f32>()?, losses[1].to_scalar::<f32>()?];
    let pairs = [
        (report.instance_loss, wanted[0] as f64),
        (report.prior_loss, wanted[1] as f64),
        (report.gradient_norm, squares.sqrt()),
    ];
    // Rounding of a network of f32.
    for (found, wanted) in pairs {
        assert!(
            (found - wanted).abs() < 1e-4 * wanted,
            "{found} instead of {wanted}"
        );
    }
    Ok(())
}

#[test]
fn score_distillation_is_the_difference_of_separate_predictions() -> Outcome {
    let model = model("inpaint")?;
    let lora = Lora::new(&model.unet.adapter_targets(), 4, 4.0, 1, &Device::Cpu)?;
    for variable in lora.variables().values() {
        variable.set(&(variable.ones_like()? * 0.1)?)?;
    }
    let lora = std::sync::Arc::new(lora);
    let (latents, noise) = (normal(70, &[1, 4, 8, 8]), normal(71, &[1, 4, 8, 8]));
    let condition = InpaintCondition {
        mask: Tensor::ones((1, 1, 8, 8), DType::F32, &Device::Cpu)?,
        masked_latents: normal(72, &[1, 4, 8, 8]),
    };
    let (c, u) = (
        model.encode_prompts(&["a car"], None)?,
        model.encode_prompts(&[""], None)?,
    );
    let t = 600;
    let x_t = model.schedule.add_noise(&latents, &noise, t)?;
    let predict = |context: &Tensor, adapted: bool| -> dipir_diffusion::Result<Tensor> {
        let pass = if adapted {
            Pass::with_lora(&lora)
        } else {
            Pass::default()
        };
        let output = model
            .unet
            .forward(&condition.join(&x_t)?, &[t as f64], context, &pass)?;
        model.schedule.noise_of(&output, &x_t, t)
    };
    let weight = 1.0 - model.schedule.alpha_bar(t)?;
    for (rule, wanted) in [
        (
            ScoreRule::Sds { scale: 7.5 },
            (guided(&predict(&u, true)?, &predict(&c, true)?, 7.5)? - &noise)?,
        ),
        (ScoreRule::Csd, (predict(&c, true)? - predict(&u, true)?)?),
        (ScoreRule::Lds, (predict(&c, true)? - predict(&u, false)?)?),
    ] {
        let found = ScoreDistillation {
            unet: &model.unet,
            schedule: &model.schedule,
            rule,
            weighting: Weighting::NoiseVariance,
            lora: Some(&lora),
            conditional: &c,
            unconditional: &u,
            inpaint: Some(&condition),
        }
        .gradient(&latents, t, &noise)?;
        let error = (found.gradient - (&wanted * weight)?)?
            .abs()?
            .max_all()?
            .to_scalar::<f32>()?;
        let size = wanted.abs()?.max_all()?.to_scalar::<f32>()?;
        assert!(error < 1e-4 * size, "{rule:?}: {error} of {size}");
        let mean = wanted.sqr()?.mean_all()?.to_scalar::<f32>()? as f64;
        assert!((found.difference - mean).abs() < 1e-3 * mean);
    }
    Ok(())
}

#[test]
fn several_prompts_to_be_told_from_are_averaged_and_an_edit_pulls_towards_itself() -> Outcome {
    let model = model("sd15")?;
    let (latents, noise) = (normal(75, &[1, 4, 8, 8]), normal(76, &[1, 4, 8, 8]));
    let c = model.encode_prompts(&["a car"], None)?;
    let others = model.encode_prompts(&["a cat", "a tree", ""], None)?;
    let t = 500;
    let found = |rule: ScoreRule, unconditional: &Tensor| {
        ScoreDistillation {
            unet: &model.unet,
            schedule: &model.schedule,
            rule,
            weighting: Weighting::NoiseVariance,
            lora: None,
            conditional: &c,
            unconditional,
            inpaint: None,
        }
        .gradient(&latents, t, &noise)
    };
    let largest = |t: &Tensor| -> dipir_diffusion::Result<f32> {
        Ok(t.abs()?.max_all()?.to_scalar::<f32>()?)
    };
    let together = found(ScoreRule::Csd, &others)?.gradient;
    let mut mean = together.zeros_like()?;
    for k in 0..3 {
        let one = found(ScoreRule::Csd, &others.narrow(0, k, 1)?)?.gradient;
        mean = (mean + (one / 3.0)?)?;
    }
    let size = largest(&together)?;
    assert!(largest(&(together - mean)?)? < 1e-4 * size);

    // One step down to the end is the clean sample that is predicted.
    let rule = ScoreRule::Edit {
        scale: 3.0,
        steps: 1,
    };
    let edited = found(rule, &others.narrow(0, 2, 1)?)?.gradient;
    let sampler = Sampler::new(&model.schedule, Solver::DpmSolver2M, 1)?;
    let start = sampler.timesteps()[0];
    let x_t = model.schedule.add_noise(&latents, &noise, start)?;
    let predict = |context: &Tensor| {
        let output = model
            .unet
            .forward(&x_t, &[start as f64], context, &Pass::default())?;
        model.schedule.sample_of(&output, &x_t, start)
    };
    let clean = guided(&predict(&others.narrow(0, 2, 1)?)?, &predict(&c)?, 3.0)?;
    let wanted = (&latents - clean)?;
    let error = largest(&(edited - &wanted)?)?;
    assert!(error < 1e-4 * largest(&wanted)?, "{error}");
    Ok(())
}

/// For data of one point the best noise prediction is known in closed form,
/// and both solvers have to end at that point.
#[test]
fn both_solvers_and_sdedit_end_at_the_only_image_there_is() -> Outcome {
    let model = model("sd15")?;
    let image = normal(80, &[1, 4, 3, 3]);
    let predict = |x: &Tensor, t: usize| -> dipir_diffusion::Result<Tensor> {
        let (signal, sigma) = model.schedule.signal_and_noise(t)?;
        Ok(((x - (&image * signal)?)? / sigma)?)
    };
    for solver in [Solver::Ddim, Solver::DpmSolver2M] {
        let mut sampler = Sampler::new(&model.schedule, solver, 20)?;
        let whole = sample(&mut sampler, 0, &normal(81, &[1, 4, 3, 3]), predict)?;
        let mut sampler = Sampler::new(&model.schedule, solver, 20)?;
        let edited = edit(
            &mut sampler,
            &normal(82, &[1, 4, 3, 3]),
            &normal(83, &[1, 4, 3, 3]),
            0.5,
            predict,
        )?;
        for found in [whole, edited] {
            let error = (found - &image)?.abs()?.max_all()?.to_scalar::<f32>()?;
            // DDIM of this schedule ends at the noise of timestep 0, sqrt(.00085).
            let left = if solver == Solver::Ddim { 0.15 } else { 1e-3 };
            assert!(error < left, "{solver:?}: {error}");
        }
    }
    Ok(())
}
