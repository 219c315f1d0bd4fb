//! Hard cases: both ends of the schedule, no signal at all, half precision
//! beside f32, and files whose bytes somebody changed.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use candle_core::{DType, Device, Tensor, Var};
use dipir_diffusion::distillation::{ScoreDistillation, ScoreRule, Weighting};
use dipir_diffusion::lora::Lora;
use dipir_diffusion::model::{Model, load_unet};
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::sampler::{Sampler, Solver, edit, sample};
use dipir_diffusion::schedule::{BetaSchedule, NoiseSchedule, Prediction, ScheduleConfig, Spacing};
use dipir_diffusion::tokenizer::Tokenizer;
use dipir_diffusion::vae::Vae;
use dipir_diffusion::weights::Weights;
use proptest::prelude::*;

type Outcome = Result<(), Box<dyn std::error::Error>>;

fn family(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("tests/references")
        .join(name)
}

fn normal(stream: u64, shape: &[usize]) -> Tensor {
    NoiseStream::new(23, stream)
        .normal_tensor(shape, DType::F32, &Device::Cpu)
        .expect("tensor")
}

fn largest(t: &Tensor) -> Result<f32, candle_core::Error> {
    t.to_dtype(DType::F32)?.abs()?.max_all()?.to_scalar()
}

/// Every schedule that a model may come with and that has a signal at the
/// end, or none.
fn schedules() -> Vec<NoiseSchedule> {
    let mut all = vec![];
    for beta_schedule in [
        BetaSchedule::Linear,
        BetaSchedule::ScaledLinear,
        BetaSchedule::SquaredCosine,
    ] {
        for (prediction_type, rescale_betas_zero_snr) in [
            (Prediction::Epsilon, false),
            (Prediction::Velocity, false),
            (Prediction::Velocity, true),
            (Prediction::Sample, false),
        ] {
            let config = ScheduleConfig {
                beta_schedule,
                prediction_type,
                rescale_betas_zero_snr,
                timestep_spacing: Some(Spacing::Trailing),
                ..ScheduleConfig::default()
            };
            all.push(NoiseSchedule::new(config).expect("valid"));
        }
    }
    all
}

#[test]
fn score_distillation_is_finite_at_both_ends_for_every_prediction() -> Outcome {
    let model = Model::load(&family("sd15"), DType::F32, &Device::Cpu)?;
    let (latents, noise) = (normal(1, &[1, 4, 8, 8]), normal(2, &[1, 4, 8, 8]));
    // An image far outside what the model knows, too.
    let extreme = (&latents * 1e4)?;
    let contexts = model.encode_prompts(&["", &"word ".repeat(1000)], None)?;
    let (u, c) = (contexts.narrow(0, 0, 1)?, contexts.narrow(0, 1, 1)?);
    let lora = Arc::new(Lora::new(
        &model.unet.adapter_targets(),
        4,
        4.0,
        1,
        &Device::Cpu,
    )?);
    for schedule in schedules()
        .into_iter()
        .filter(|s| s.config().beta_schedule == BetaSchedule::ScaledLinear)
    {
        for rule in [
            ScoreRule::Sds { scale: 100.0 },
            ScoreRule::Csd,
            ScoreRule::Lds,
            ScoreRule::Edit {
                scale: 7.5,
                steps: 4,
            },
        ] {
            let step = ScoreDistillation {
                unet: &model.unet,
                schedule: &schedule,
                rule,
                weighting: Weighting::NoiseVariance,
                lora: Some(&lora),
                conditional: &c,
                unconditional: &u,
                inpaint: None,
            };
            for t in [0, schedule.len() - 1] {
                for latents in [&latents, &extreme] {
                    let found = step.gradient(latents, t, &noise)?;
                    let size = largest(&found.gradient)?;
                    assert!(
                        size.is_finite() && found.difference.is_finite(),
                        "{rule:?}, {:?}, t = {t}: {size}",
                        schedule.config()
                    );
                }
            }
        }
        assert!(
            model
                .schedule
                .add_noise(&latents, &noise, schedule.len())
                .is_err()
        );
    }
    Ok(())
}

/// With the exact prediction for data of a single image, whatever starts from
/// noise alone, where alpha is 0, has to end at that image.
#[test]
fn sampling_starts_where_there_is_no_signal() -> Outcome {
    let image = normal(3, &[1, 4, 5, 3]);
    for schedule in schedules() {
        let kind = schedule.config().prediction_type;
        let predict = |x: &Tensor, t: usize| -> dipir_diffusion::Result<Tensor> {
            let (signal, sigma) = schedule.signal_and_noise(t)?;
            let noise = ((x - (&image * signal)?)? / sigma)?;
            Ok(match kind {
                Prediction::Epsilon => noise,
                Prediction::Velocity => ((noise * signal)? - (&image * sigma)?)?,
                Prediction::Sample => image.clone(),
            })
        };
        for solver in [Solver::Ddim, Solver::DpmSolver2M] {
            for steps in [1, 2, 20] {
                let start = normal(4, &[1, 4, 5, 3]);
                let mut sampler = Sampler::new(&schedule, solver, steps)?;
                assert_eq!(sampler.timesteps()[0], schedule.len() - 1);
                let found = sample(&mut sampler, 0, &start, predict)?;
                let error = largest(&(found - &image)?)?;
                // A noise prediction is divided by the signal of the last
                // timestep, which a squared cosine leaves at 5e-5.
                let tolerance = if kind == Prediction::Epsilon {
                    5e-2
                } else {
                    1e-3
                };
                assert!(
                    error < tolerance,
                    "{solver:?}, {steps} steps, {:?}: {error}",
                    schedule.config()
                );
                let mut sampler = Sampler::new(&schedule, solver, steps)?;
                let found = edit(
                    &mut sampler,
                    &normal(5, &[1, 4, 5, 3]),
                    &start,
                    1.0,
                    predict,
                )?;
                assert!(largest(&found)?.is_finite());
            }
        }
    }
    Ok(())
}

/// Weights and activations in half precision, as a GPU has them, beside f32.
/// The references' weights are exact in f16; an activation is rounded by
/// 2^-11 or, in bf16, 2^-8, some dozens of times on the way.
#[test]
fn half_precision_follows_f32_forwards_and_backwards() -> Outcome {
    for name in ["sd15", "sd21"] {
        let folder = family(name).join("unet");
        let exact = load_unet(&folder, DType::F32, &Device::Cpu)?;
        let (x, context) = (
            normal(6, &[2, 4, 8, 8]),
            normal(7, &[2, 5, exact.config().cross_attention_dim]),
        );
        let lora = Lora::new(&exact.adapter_targets(), 2, 2.0, 3, &Device::Cpu)?;
        for (name, variable) in lora.variables() {
            let noise = NoiseStream::named(5, name).normal_tensor(
                variable.dims(),
                DType::F32,
                &Device::Cpu,
            )?;
            variable.set(&(noise * 0.2)?)?;
        }
        let lora = Arc::new(lora);
        let run = |dtype: DType| -> Result<(Tensor, Vec<Tensor>), Box<dyn std::error::Error>> {
            let unet = load_unet(&folder, dtype, &Device::Cpu)?;
            let y = unet
                .forward(
                    &x.to_dtype(dtype)?,
                    &[1.0, 998.0],
                    &context.to_dtype(dtype)?,
                    &Pass::with_lora(&lora),
                )?
                .to_dtype(DType::F32)?;
            let store = y.sqr()?.mean_all()?.backward()?;
            let gradients = lora
                .variables()
                .iter()
                .map(|(name, v)| store.get(v).cloned().ok_or(format!("{name}: no gradient")))
                .collect::<Result<_, _>>()?;
            Ok((y.detach(), gradients))
        };
        let (wanted, wanted_gradients) = run(DType::F32)?;
        for (dtype, tolerance) in [(DType::F16, 1e-2), (DType::BF16, 8e-2)] {
            let (found, gradients) = run(dtype)?;
            let error = largest(&(found - &wanted)?)? / largest(&wanted)?;
            assert!(error < tolerance, "{name} {dtype:?}: {error}");
            let (mut product, mut norms) = (0f64, (0f64, 0f64));
            for (g, w) in gradients.iter().zip(&wanted_gradients) {
                // Masters, and what they receive, are f32.
                assert_eq!(g.dtype(), DType::F32);
                assert!(largest(g)?.is_finite());
                let sum = |a: &Tensor, b: &Tensor| (a * b)?.sum_all()?.to_scalar::<f32>();
                product += sum(g, w)? as f64;
                norms.0 += sum(g, g)? as f64;
                norms.1 += sum(w, w)? as f64;
            }
            // The gradient as a whole points the same way.
            let cosine = product / (norms.0 * norms.1).sqrt();
            assert!(cosine > 0.99, "{name} {dtype:?}: cosine {cosine}");
        }
    }
    Ok(())
}

#[test]
fn the_gradient_through_the_encoder_is_finite_for_any_image() -> Outcome {
    let Vae::Kl(vae) = Model::load(&family("sd15"), DType::F32, &Device::Cpu)?.vae else {
        return Err("no AutoencoderKL".into());
    };
    let zeros = Tensor::zeros((1, 3, 16, 16), DType::F32, &Device::Cpu)?;
    for (what, image) in [
        ("black", (&zeros - 1.0)?),
        ("white", (&zeros + 1.0)?),
        ("grey", zeros.clone()),
        ("far out of range", (normal(8, &[1, 3, 16, 16]) * 1e4)?),
    ] {
        let image = Var::from_tensor(&image)?;
        let mean = vae.encode(&image)?.mean;
        let gradients = mean.sqr()?.sum_all()?.backward()?;
        let gradient = gradients.get(&image).ok_or("no gradient")?;
        assert!(
            largest(&mean)?.is_finite() && largest(gradient)?.is_finite(),
            "{what}"
        );
    }
    Ok(())
}

/// Bytes that somebody changed: bits flipped, the end cut off, a part
/// overwritten by another.
fn damaged(original: Vec<u8>) -> impl Strategy<Value = Vec<u8>> {
    let len = original.len();
    let flips = prop::collection::vec((0..len, any::<u8>()), 0..6);
    let copy = (0..len, 0..len, 0..len.min(64));
    (flips, prop::option::of(copy), prop::option::of(0..len)).prop_map(move |(flips, copy, cut)| {
        let mut bytes = original.clone();
        for (at, value) in flips {
            bytes[at] = value;
        }
        if let Some((from, to, count)) = copy {
            let count = count.min(len - from.max(to));
            bytes.copy_within(from..from + count, to);
        }
        bytes.truncate(cut.unwrap_or(len));
        bytes
    })
}

/// A small file in which a changed byte mostly hits the header.
fn small_safetensors() -> Vec<u8> {
    let header = r#"{"__metadata__":{"format":"pt"},"a.weight":{"dtype":"F32","shape":[2,2],"data_offsets":[0,16]},"b":{"dtype":"F16","shape":[0,3],"data_offsets":[16,16]},"c":{"dtype":"BF16","shape":[],"data_offsets":[16,18]},"d":{"dtype":"I64","shape":[1],"data_offsets":[18,26]}}"#;
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(0..26u8);
    bytes
}

/// Whatever the bytes say, there is an error, or every tensor can be read.
fn read_all(path: &Path) -> Result<usize, dipir_diffusion::Error> {
    let weights = Weights::open_file(path)?;
    let names: Vec<String> = weights.names().map(str::to_owned).collect();
    for name in &names {
        if let Ok(Some(tensor)) = weights.tensor(name, DType::F32, &Device::Cpu) {
            assert_eq!(Some(tensor.dims()), weights.shape(name));
        }
    }
    Ok(names.len())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_safetensors_header_makes_the_reader_panic(bytes in damaged(small_safetensors())) {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("x.safetensors");
        fs::write(&path, bytes).expect("write");
        let _ = read_all(&path);
    }

    #[test]
    fn no_header_of_json_makes_the_reader_panic(
        dtype in prop::sample::select(vec!["F32", "F16", "U8", "BOOL", "F8_E4M3", "I16", "F4", "C64"]),
        shape in prop::collection::vec(prop_oneof![0..9u64, Just(u64::MAX), Just(1 << 33)], 0..5),
        offsets in (0..40u64, prop_oneof![0..40u64, Just(u64::MAX)]),
        data in 0..40usize,
    ) {
        let header = format!(
            r#"{{"x":{{"dtype":"{dtype}","shape":{shape:?},"data_offsets":[{},{}]}}}}"#,
            offsets.0, offsets.1
        );
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        bytes.extend(vec![7u8; data]);
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("x.safetensors");
        fs::write(&path, bytes).expect("write");
        let _ = read_all(&path);
    }
}

#[test]
fn the_small_file_is_whole_before_it_is_damaged() -> Outcome {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("x.safetensors");
    fs::write(&path, small_safetensors())?;
    assert_eq!(read_all(&path)?, 4);
    Ok(())
}

/// A vocabulary of a few letters, so that each case takes no time.
fn small_tokenizer() -> [(&'static str, &'static str); 4] {
    [
        (
            "vocab.json",
            r#"{"a":0,"b":1,"a</w>":2,"b</w>":3,"ab":4,"ab</w>":5,"<|startoftext|>":6,"<|endoftext|>":7}"#,
        ),
        ("merges.txt", "#version: 0.2\na b\na b</w>\n"),
        (
            "special_tokens_map.json",
            r#"{"pad_token":{"content":"<|endoftext|>"}}"#,
        ),
        ("tokenizer_config.json", r#"{"model_max_length":12}"#),
    ]
}

fn tokenize(folder: &Path) -> Result<Vec<u32>, dipir_diffusion::Error> {
    let tokens = Tokenizer::load(folder)?.encode("Ab ba <|endoftext|> ☺ 1")?;
    assert!(tokens.len() >= 2);
    Ok(tokens)
}

#[test]
fn the_small_tokenizer_works_before_it_is_damaged() -> Outcome {
    let folder = tempfile::tempdir()?;
    for (name, text) in small_tokenizer() {
        fs::write(folder.path().join(name), text)?;
    }
    let tokens = tokenize(folder.path())?;
    assert_eq!((tokens[0], tokens[1], tokens.len()), (6, 5, 12));
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_tokenizer_file_makes_the_tokenizer_panic(
        (which, bytes) in (0..4usize).prop_flat_map(|which| {
            let original = small_tokenizer()[which].1.as_bytes().to_vec();
            (Just(which), damaged(original))
        }),
    ) {
        let folder = tempfile::tempdir().expect("folder");
        for (index, (name, text)) in small_tokenizer().into_iter().enumerate() {
            let content = if index == which { bytes.as_slice() } else { text.as_bytes() };
            fs::write(folder.path().join(name), content).expect("write");
        }
        let _ = tokenize(folder.path());
    }
}
