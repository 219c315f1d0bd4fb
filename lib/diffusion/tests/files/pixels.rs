//! A rearrangement of pixels in place of an encoder of pictures, and extreme values.
use candle_core::{DType, Device, Tensor};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::vae::Vae;

use super::{Outcome, family};

#[test]
fn a_rearrangement_of_pixels_has_a_largest_factor() -> Outcome {
    let folder = tempfile::tempdir()?;
    for factor in ["4294967296", "0", "-1"] {
        let text = format!(r#"{{"_class_name": "PixelUnshuffle", "factor": {factor}}}"#);
        std::fs::write(folder.path().join("config.json"), text)?;
        let message = Vae::load(folder.path(), DType::F32, &Device::Cpu)
            .expect_err(factor)
            .to_string();
        assert!(message.contains("factor"), "{message}");
    }
    Ok(())
}

#[test]
fn pixel_unshuffle_is_exact_both_ways() -> Outcome {
    let folder = tempfile::tempdir()?;
    std::fs::write(
        folder.path().join("config.json"),
        r#"{"_class_name": "PixelUnshuffle", "factor": 2, "scaling_factor": 0.5}"#,
    )?;
    let vae = Vae::load(folder.path(), DType::F32, &Device::Cpu)?;
    assert_eq!((vae.downscale(), vae.latent_channels()), (2, 12));
    let image = Tensor::arange(0f32, 96.0, &Device::Cpu)?.reshape((2, 3, 4, 4))?;
    let latents = vae.encode(&image)?;
    assert_eq!(latents.dims(), [2, 12, 2, 2]);
    // Channel 0 is the top left pixel of each block, channel 1 the one right of it.
    assert_eq!(
        latents.get(0)?.get(1)?.to_vec2::<f32>()?,
        [[0.5, 1.5], [4.5, 5.5]]
    );
    assert_eq!(
        vae.decode(&latents)?.flatten_all()?.to_vec1::<f32>()?,
        image.flatten_all()?.to_vec1::<f32>()?
    );
    let message = vae
        .encode(&image.narrow(3, 0, 3)?)
        .expect_err("odd width")
        .to_string();
    assert!(message.contains("3x4"), "{message}");
    Ok(())
}

#[test]
fn extreme_latents_and_timesteps_stay_finite() -> Outcome {
    let model = Model::load(&family(), DType::F32, &Device::Cpu)?;
    let context = model.encode_prompts(&["", &"word ".repeat(1000)], None)?;
    let noise = dipir_diffusion::noise::NoiseStream::new(1, 1).normal_tensor(
        &[2, 4, 8, 8],
        DType::F32,
        &Device::Cpu,
    )?;
    let x = (noise * 1e4)?;
    for t in [0.0, 999.0] {
        let y = model.unet.forward(&x, &[t], &context, &Pass::default())?;
        let worst = y.abs()?.max_all()?.to_scalar::<f32>()?;
        assert!(worst.is_finite(), "t = {t}: {worst}");
    }
    let image = model
        .vae
        .decode(&x.narrow(0, 0, 1)?)?
        .abs()?
        .max_all()?
        .to_scalar::<f32>()?;
    assert!(image.is_finite());
    Ok(())
}
