use dipir_prior::caption::LightDescription;
use dipir_prior::picture::SIZE;

use super::*;
use crate::examples::Example;

fn light(azimuth: f32) -> LightDescription {
    LightDescription {
        azimuth,
        elevation: 0.5,
        sun_share: 0.8,
    }
}

fn caption(azimuth: f32) -> Option<Caption> {
    Some(Caption::new("red car", Some(&light(azimuth))))
}

fn alternative(azimuth: f32, image: Option<Vec<f32>>) -> AlternativeLight {
    AlternativeLight {
        caption: caption(azimuth).expect("a caption"),
        image,
    }
}

fn small() -> Denoiser {
    let folder = tempfile::tempdir().expect("a folder");
    let architecture = Architecture {
        channels: vec![8, 16],
        layers: 1,
        text_width: 16,
    };
    architecture.write_configs(folder.path()).expect("written");
    Denoiser::new(&architecture, folder.path(), 1).expect("built")
}

#[test]
fn an_untrained_model_has_the_contrastive_loss_of_chance() {
    let denoiser = small();
    let example = |value: f32, alternatives: usize| Example {
        image: vec![value; 3 * SIZE * SIZE],
        noised: None,
        visible: vec![0.5; 3 * SIZE * SIZE],
        mask: vec![1.0; SIZE * SIZE],
        weight: vec![0.5 + value; SIZE * SIZE],
        caption: caption(0.3),
        light: light(0.3),
        alternatives: (1..=alternatives)
            .map(|k| alternative(0.3 + k as f32, None))
            .collect(),
    };
    let loss = |examples: Vec<Example>| {
        let batch = Batch::new(examples).expect("a batch");
        let mut stream = NoiseStream::new(3, 3);
        let losses = denoiser.loss(&batch, &mut stream).expect("a loss");
        let value = |t: Tensor| t.to_scalar::<f32>().expect("a value");
        (value(losses.velocity), losses.contrastive.map(value))
    };
    // Its output is 0 for every caption, so all captions are equally likely.
    let (mixed, contrastive) = loss(vec![example(0.2, 0), example(0.7, 3), example(0.4, 3)]);
    let contrastive = contrastive.expect("alternatives");
    assert!((contrastive - 1.0).abs() < 1e-5, "{contrastive}");
    // Alternatives without pictures do not change the velocity loss; without alternatives there is no other loss.
    let (fewer, _) = loss(vec![example(0.2, 0), example(0.7, 1), example(0.4, 1)]);
    assert_eq!(mixed, fewer);
    assert!(loss(vec![example(0.7, 0), example(0.4, 0)]).1.is_none());

    // An alternative with the picture under noise as its target adds the same error, one with another picture adds more.
    let pictured = |value: f32| Example {
        alternatives: vec![alternative(1.3, Some(vec![value; 3 * SIZE * SIZE]))],
        ..example(0.7, 0)
    };
    let alone = loss(vec![example(0.7, 1)]).0;
    let (same, other) = (loss(vec![pictured(0.7)]), loss(vec![pictured(0.2)]));
    assert!((same.0 / alone - 1.0).abs() < 1e-5, "{same:?} {alone}");
    assert!(other.0 > 1.02 * alone, "{other:?} {alone}");
    // The contrastive loss is about the noise of the picture under noise.
    assert!(
        (other.1.expect("alternatives") - 1.0).abs() < 1e-5,
        "{other:?}"
    );

    // With random weights, alternatives with the right caption are as likely as it, and others are not. So rows are
    // compared with their own picture.
    for (name, variable) in denoiser.variables() {
        if name.starts_with("unet.conv_out.") || name.ends_with(".proj_out.weight") {
            let mut noise = NoiseStream::new(9, variable.elem_count() as u64);
            let values = noise.normal_tensor(variable.dims(), DType::F32, &Device::Cpu);
            let small = (values.expect("noise") * 0.1).expect("noise");
            variable.set(&small).expect("set");
        }
    }
    let same = |value: f32| Example {
        alternatives: vec![alternative(0.3, None); 3],
        ..example(value, 0)
    };
    let contrastive = loss(vec![same(0.7), same(0.4)]).1.expect("alternatives");
    // 400 nats times the rounding of errors of about 1 in f32. Other captions differ by several times as much.
    assert!((contrastive - 1.0).abs() < 1e-3, "{contrastive}");
    let contrastive = loss(vec![example(0.7, 3), example(0.4, 3)]).1;
    let contrastive = contrastive.expect("alternatives");
    assert!((contrastive - 1.0).abs() > 4e-3, "{contrastive}");
}

#[test]
fn the_target_of_a_relit_example_is_the_picture_under_the_captions_light() {
    let denoiser = small();
    let flat = |value: f32| vec![value; 3 * SIZE * SIZE];
    let example = Example {
        image: flat(0.2),
        noised: Some(flat(0.7)),
        visible: flat(0.5),
        mask: vec![1.0; SIZE * SIZE],
        weight: vec![1.0; SIZE * SIZE],
        caption: caption(0.3),
        light: light(0.3),
        alternatives: vec![],
    };
    let batch = Batch::new(vec![example]).expect("a batch");
    let latent = |t: &Tensor| {
        t.mean_all()
            .expect("mean")
            .to_scalar::<f32>()
            .expect("value")
    };
    let [target, noised] = [&batch.latents, &batch.noised].map(|t| f64::from(latent(t)));
    for seed in 0..4 {
        let losses = denoiser
            .loss(&batch, &mut NoiseStream::new(3, seed))
            .expect("a loss");
        // The output is 0, so the loss is the mean square of the target velocity,
        // signal e + (signal^2 noised - target) / noise.
        let t = (0.4 + 0.5 * NoiseStream::new(3, seed).uniform()) * 1000.0;
        let (signal, noise) = denoiser
            .schedule
            .signal_and_noise(t as usize)
            .expect("in range");
        let mean = (signal * signal * noised - target) / noise;
        let expected = signal * signal + mean * mean;
        let found = f64::from(losses.velocity.to_scalar::<f32>().expect("a value"));
        // Means over 3,072 normal numbers: .018 of e, .026 of its square.
        let tolerance = 4.0 * (0.026 * signal * signal + 2.0 * 0.018 * signal * mean.abs());
        assert!((found - expected).abs() < tolerance, "{found} {expected}");
    }
}

#[test]
fn captions_encode_every_number_of_the_light() {
    let folder = tempfile::tempdir().expect("a folder");
    let architecture = Architecture::default();
    architecture.write_configs(folder.path()).expect("written");
    let denoiser = Denoiser::new(&architecture, folder.path(), 1).expect("built");
    let states = |captions: &[Option<Caption>]| -> Vec<Vec<f32>> {
        let encoded = EncodedCaptions::new(&denoiser.tokenizer, captions).expect("tokens");
        let states = encoded.states(&denoiser.text).expect("states");
        let rows = states.flatten_from(1).expect("rows");
        rows.to_vec2().expect("values")
    };
    let apart = |a: &[f32], b: &[f32]| {
        let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs());
        differences.fold(0f32, f32::max)
    };
    let rows = states(&[caption(0.1), caption(2.0), None]);
    assert!(apart(&rows[0], &rows[1]) > 1e-2 && apart(&rows[0], &rows[2]) > 1e-2);
    // States of a caption do not depend on its place in a batch.
    let alone = states(&[caption(2.0)]);
    assert!(apart(&alone[0], &rows[1]) < 1e-5);
}
