use super::*;
use crate::dataset::{DatasetSettings, SceneMix};
use crate::scene::ObjectSet;

fn scenes(folder: &Path) -> Dataset {
    let settings = DatasetSettings {
        seed: 5,
        scenes: 1,
        mix: SceneMix::OpenAndStreets,
        objects: ObjectSet::Training,
    };
    Dataset::make(folder, &settings, &mut |_| ControlFlow::Continue(()))
        .unwrap()
        .unwrap()
}

fn small(folder: &Path, samples: usize) -> Trainer {
    let architecture = Architecture {
        channels: vec![8, 16],
        layers: 1,
        text_width: 16,
    };
    architecture.write_configs(folder).unwrap();
    let settings = TrainerSettings {
        samples,
        batch: 4,
        learning_rate: 1e-3,
        seed: 2,
        contrast: 0.0,
    };
    Trainer::new(&architecture, folder, settings, Recipe::default()).unwrap()
}

fn train(trainer: &mut Trainer, data: &Dataset, until: usize) {
    let mut watch = |_: &Trainer, update: &Update| {
        Ok(match update.seen < until {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(()),
        })
    };
    trainer.run(data, &mut watch).unwrap();
}

#[test]
fn a_stopped_run_ends_with_the_same_weights() {
    let folder = tempfile::tempdir().unwrap();
    let data = scenes(&folder.path().join("scenes"));
    let checkpoint = folder.path().join("checkpoint.safetensors");
    let mut whole = small(folder.path(), 24);
    train(&mut whole, &data, 24);
    let mut first = small(folder.path(), 24);
    train(&mut first, &data, 12);
    first.save(&checkpoint).unwrap();
    let mut second = small(folder.path(), 24);
    second.resume(&checkpoint).unwrap();
    assert_eq!(second.seen(), 12);
    train(&mut second, &data, 24);
    let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let mut moved = 0.0f32;
    for (name, tensor) in whole.average() {
        assert!(values(tensor) == values(&second.average()[name]), "{name}");
        let before = values(&first.average()[name]);
        let change = values(tensor)
            .into_iter()
            .zip(before)
            .map(|(a, b)| (a - b).abs());
        moved = change.fold(moved, f32::max);
    }
    assert!(
        moved > 1e-6,
        "no weight changed in the second half: {moved}"
    );

    // A checkpoint of another run is refused.
    let mut other = small(folder.path(), 24);
    other.settings.seed = 3;
    let error = other.resume(&checkpoint).unwrap_err().to_string();
    assert!(error.contains("\"seed\":3"), "{error}");
}

#[test]
fn a_run_may_get_a_contrastive_loss_on_the_way() {
    let folder = tempfile::tempdir().unwrap();
    let data = scenes(&folder.path().join("scenes"));
    let checkpoint = folder.path().join("checkpoint.safetensors");
    let batch = |trainer: &mut Trainer, contrast: f64| {
        trainer.settings = TrainerSettings {
            batch: 12,
            contrast,
            ..trainer.settings
        };
    };
    let mut plain = small(folder.path(), 48);
    batch(&mut plain, 0.0);
    assert!(plain.step(&data).unwrap().contrastive_loss.is_nan());
    plain.save(&checkpoint).unwrap();
    let mut later = small(folder.path(), 48);
    batch(&mut later, 0.5);
    later.resume(&checkpoint).unwrap();
    assert_eq!(later.seen(), 12);
    // After one update of the warm-up the model still answers by chance.
    let contrastive_loss = later.step(&data).unwrap().contrastive_loss;
    assert!((contrastive_loss - 1.0).abs() < 0.05, "{contrastive_loss}");

    let architecture = Architecture {
        channels: vec![8, 16],
        layers: 1,
        text_width: 16,
    };
    let settings = TrainerSettings {
        batch: 10,
        ..later.settings
    };
    let refused = Trainer::new(&architecture, folder.path(), settings, Recipe::default());
    let error = refused.err().unwrap().to_string();
    assert!(error.contains("even numbers from 12"), "{error}");
}

#[test]
fn a_run_starts_from_the_weights_of_a_model_of_its_shape() {
    let folder = tempfile::tempdir().unwrap();
    let architecture = Architecture {
        channels: vec![8, 16],
        layers: 1,
        text_width: 16,
    };
    let first = small(folder.path(), 24);
    architecture
        .write_weights(folder.path(), first.average())
        .unwrap();
    let settings = TrainerSettings {
        seed: 9,
        ..first.settings
    };
    let mut second =
        Trainer::new(&architecture, folder.path(), settings, Recipe::default()).unwrap();
    second.start_from(folder.path()).unwrap();
    let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    for (name, variable) in second.denoiser.variables() {
        let wanted = values(&first.average()[name]);
        // Weights are stored in f16.
        for (found, wanted) in values(variable).into_iter().zip(wanted) {
            assert!(
                (found - wanted).abs() <= 1e-3 * wanted.abs() + 1e-6,
                "{name}"
            );
        }
        assert_eq!(values(variable), values(&second.average()[name]));
    }

    let other = tempfile::tempdir().unwrap();
    let wider = Architecture {
        channels: vec![8, 24],
        ..architecture
    };
    wider.write_configs(other.path()).unwrap();
    let mut third = Trainer::new(&wider, other.path(), settings, Recipe::default()).unwrap();
    let error = third.start_from(folder.path()).unwrap_err().to_string();
    assert!(error.contains("has the shape"), "{error}");
    let error = third.start_from(other.path()).unwrap_err().to_string();
    assert!(error.contains("diffusion_pytorch_model"), "{error}");
}

#[test]
fn a_deeper_model_starts_with_the_output_of_the_shallow_one() {
    let folder = tempfile::tempdir().unwrap();
    let data = scenes(&folder.path().join("scenes"));
    let first = small(folder.path(), 24);
    // Weights that are initialised to 0 get values.
    for (name, variable) in first.denoiser.variables() {
        let ends = [".conv2.weight", ".proj_out.weight", "unet.conv_out.weight"];
        if ends.iter().any(|e| name.ends_with(e)) {
            let mut noise = NoiseStream::new(9, variable.elem_count() as u64);
            let values = noise.normal_tensor(variable.dims(), DType::F32, &Device::Cpu);
            variable.set(&(values.unwrap() * 0.05).unwrap()).unwrap();
        }
    }
    let weights = first.denoiser.variables().iter();
    let weights: BTreeMap<_, _> = weights
        .map(|(n, v)| (n.clone(), v.as_detached_tensor()))
        .collect();
    first
        .architecture
        .write_weights(folder.path(), &weights)
        .unwrap();
    let deeper = Architecture {
        layers: 3,
        ..first.architecture.clone()
    };
    let grown = tempfile::tempdir().unwrap();
    deeper.write_configs(grown.path()).unwrap();
    let begin = || Trainer::new(&deeper, grown.path(), first.settings, Recipe::default());
    let loss = |trainer: &Trainer| {
        let mut stream = NoiseStream::new(1, 2);
        let example = Example::draw(data.scene(0), &trainer.recipe, &mut stream);
        let batch = Batch::new(vec![example]).unwrap();
        let losses = trainer.denoiser.loss(&batch, &mut stream).unwrap();
        losses.velocity.to_scalar::<f32>().unwrap()
    };
    let mut second = begin().unwrap();
    let fresh = loss(&second);
    second.start_from(folder.path()).unwrap();
    let (found, wanted) = (loss(&second), loss(&first));
    // Weights are stored in f16.
    assert!((found - wanted).abs() < 1e-3 * wanted, "{found} {wanted}");
    assert!((fresh - wanted).abs() > 1e-2 * wanted, "{fresh} {wanted}");
    // Every block learns.
    let before: BTreeMap<_, _> = second
        .denoiser
        .variables()
        .iter()
        .map(|(n, v)| (n.clone(), v.as_detached_tensor().copy().unwrap()))
        .collect();
    second.step(&data).unwrap();
    for (name, variable) in second.denoiser.variables() {
        if name.ends_with("conv2.weight") {
            let moved = (variable.as_tensor() - &before[name]).unwrap();
            let moved = moved.abs().unwrap().max_all().unwrap();
            assert!(moved.to_scalar::<f32>().unwrap() > 0.0, "{name}");
        }
    }

    let mut shallow = small(folder.path(), 24);
    second
        .architecture
        .write_weights(grown.path(), second.average())
        .unwrap();
    let error = shallow.start_from(grown.path()).unwrap_err().to_string();
    assert!(error.contains("layers_per_block is 3"), "{error}");
    let checkpoint = grown.path().join("checkpoint.safetensors");
    second.save(&checkpoint).unwrap();
    begin().unwrap().resume(&checkpoint).unwrap();
    let error = shallow.resume(&checkpoint).unwrap_err().to_string();
    assert!(error.contains("--layers 3"), "{error}");
}

#[test]
fn no_more_than_all_of_the_scenes_are_done() {
    let cache = tempfile::tempdir().unwrap();
    std::fs::create_dir(cache.path().join("scenes")).unwrap();
    // A file holds 64 scenes. The work stops before it is read.
    std::fs::write(cache.path().join("scenes/scenes-00000.safetensors"), "").unwrap();
    let mut shares = vec![];
    let stop = &mut |share| {
        shares.push(share);
        ControlFlow::Break(())
    };
    let mix = SceneMix::OpenAndStreets;
    let none = crate::training_run::scenes(cache.path(), 10, mix, 1, stop).unwrap();
    assert!(none.is_none() && shares == [1.0], "{shares:?}");
}

#[test]
fn a_truncated_file_of_scenes_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let data = scenes(folder.path());
    assert_eq!(data.len(), crate::dataset::BLOCK);
    let path = folder.path().join("scenes-00000.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = Dataset::open(folder.path(), SceneMix::OpenAndStreets, 1)
        .unwrap_err()
        .to_string();
    assert!(error.contains("scenes-00000.safetensors"), "{error}");
}
