//! What `dipir-model check` reports of a small model.

use std::path::PathBuf;

use candle_core::{DType, Device};
use dipir_diffusion::check::{Reference, TimesSettings, compare, sizes, times};
use dipir_diffusion::model::Model;
use dipir_diffusion::training::TrainingConfig;

type Outcome = Result<(), Box<dyn std::error::Error>>;

fn model(family: &str, dtype: DType) -> Result<Model, dipir_diffusion::Error> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/references");
    Model::load(&folder.join(family), dtype, &Device::Cpu)
}

#[test]
fn our_kernels_agree_with_the_composed_operations_in_every_part() -> Outcome {
    for family in ["sd15", "sd21", "inpaint"] {
        let model = model(family, DType::F32)?;
        for side in sizes(&model) {
            let parts = compare(&model, Reference::Composed, side, |_| true)?;
            assert_eq!(parts.len(), 5);
            for part in parts {
                // Equal bytes would mean that both ran the same code.
                assert!(part.holds() && part.error > 0.0, "{family}: {part:?}");
            }
        }
    }
    Ok(())
}

/// Against f32, whose numbers bf16 rounds: the tolerance is that of a GPU.
#[test]
fn every_part_of_every_family_computes_in_bf16_on_the_cpu() -> Outcome {
    for family in ["sd15", "sd21", "inpaint"] {
        let exact = model(family, DType::F32)?;
        let rounded = model(family, DType::BF16)?;
        for side in sizes(&exact) {
            for part in compare(&rounded, Reference::Cpu(&exact), side, |_| true)? {
                // Less than a third of one rounding would mean that nothing was rounded.
                assert!(part.holds() && part.error > 1e-3, "{family}: {part:?}");
            }
        }
    }
    let refused = model("sd15", DType::F16).expect_err("f16");
    assert!(refused.to_string().contains("accepted are f32 and bf16"));
    Ok(())
}

#[test]
fn a_part_that_computes_something_else_is_found() -> Outcome {
    // Another family of the same sizes has other weights.
    let (model, other) = (model("sd15", DType::F32)?, model("pooled", DType::F32)?);
    let parts = compare(&model, Reference::Cpu(&other), 8, |_| true)?;
    assert!(parts.iter().any(|p| p.part == "UNet" && !p.holds()));
    Ok(())
}

#[test]
fn every_part_of_every_family_can_be_timed_and_a_measurement_can_be_stopped() -> Outcome {
    for (family, dtype, with_prior) in [
        ("sd21", DType::F32, true),
        ("inpaint", DType::F32, false),
        ("sd21", DType::BF16, true),
        ("inpaint", DType::BF16, false),
    ] {
        let model = model(family, dtype)?;
        let settings = TimesSettings {
            side: 8,
            training: TrainingConfig::default(),
            with_prior,
        };
        let found = times(&model, &settings, |_| true)?;
        assert_eq!(found.size, 16);
        assert!(found.unet_s > 0.0 && found.lora_step_s > 0.0 && found.guidance_s > 0.0);
        let stopped = times(&model, &settings, |_| false).expect_err("stopped");
        assert!(stopped.to_string().contains("stopped"));
    }
    Ok(())
}
