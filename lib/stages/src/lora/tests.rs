use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use candle_core::{DType, Device, Tensor};
use clap::Parser;
use dipir_cli::exit;
use dipir_diffusion::check::Times;
use dipir_diffusion::weights::{Weights, write_safetensors};
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_pipeline::manifest::hash_file;
use glam::Vec3;
use tempfile::TempDir;

use super::*;
use crate::command_line::lora::Cli;
use crate::graph::{graph, state_of};
use crate::model::forecast;

fn family() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../diffusion/tests/references/sd15")
}

/// A photograph, and a configuration that trains for a moment.
fn project() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let photo = DisplayImage(Raster::filled(36, 24, Vec3::splat(0.5)));
    write_png(folder.path().join("photo.png"), &photo).unwrap();
    let text = format!(
        "[pipeline]\nout = \"out\"\n[model]\npath = {:?}\n[scene]\nbackground = \"photo.png\"\nclass = \"toy\"\n\
         [concepts]\ncount = 0\n[light]\nguidance = \"lds\"\nstart = \"neutral\"\n[lora]\nsteps = 2\nsheet_steps = 1\nvalidate_every = 0\n",
        family()
    );
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    folder
}

fn session(folder: &TempDir, sets: &[&str]) -> Session {
    let file = folder.path().join("pipeline.toml").display().to_string();
    let mut args = vec!["dipir-lora", "-q", "-p", file.as_str()];
    args.extend(sets.iter().flat_map(|set| ["--set", set]));
    Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap()
}

/// Writes `change` of the reference's LoRA, with peft's keys and its configuration, into `lora` in the folder.
fn peft_folder(folder: &TempDir, alpha: f64, change: impl Fn(Tensor) -> Tensor) {
    let to = folder.path().join("lora");
    fs::create_dir_all(&to).unwrap();
    let known = Weights::open_file(&family().join("lora_peft.safetensors")).unwrap();
    let mut tensors = BTreeMap::new();
    let mut rank = 0;
    for name in known.names() {
        let tensor = known
            .tensor(name, DType::F32, &Device::Cpu)
            .unwrap()
            .unwrap();
        if name.contains("lora_A") {
            rank = tensor.dims()[0];
        }
        let own = name.replace("unet.", "base_model.model.");
        tensors.insert(own, change(tensor));
    }
    write_safetensors(
        &to.join("adapter_model.safetensors"),
        &tensors,
        &BTreeMap::new(),
    )
    .unwrap();
    let config = json!({"r": rank, "lora_alpha": alpha, "peft_type": "LORA"});
    fs::write(to.join("adapter_config.json"), config.to_string()).unwrap();
}

fn refusal(session: &Session) -> (String, u8) {
    let Err(error) = run(session) else {
        panic!("it runs")
    };
    (exit::describe(&error), exit::code_of(&error))
}

#[test]
fn a_finished_lora_takes_the_place_of_a_training() {
    let folder = project();
    peft_folder(&folder, 6.0, |t| t);
    let sets = ["lora.path=lora", "concepts.count=4"];
    let own = session(&folder, &sets);
    let done = run(&own).unwrap();
    assert!(done.to_string().contains("lora: "), "{done}");
    assert_eq!(done.to_json()["own"]["path"], "lora");
    let written = folder.path().join("out/lora/lora.safetensors");
    let model = model::load(&own, &own.config.table("model").unwrap()).unwrap();
    let targets = model.unet.adapter_targets();
    let load =
        |path: &Path| dipir_diffusion::lora::Lora::load(path, &targets, DType::F32, &Device::Cpu);
    let (was, is) = (
        load(&folder.path().join("lora")).unwrap(),
        load(&written).unwrap(),
    );
    assert_eq!(was.adapters().len(), is.adapters().len());
    for (name, adapter) in was.adapters() {
        let other = is.adapter(name).unwrap();
        assert_eq!((adapter.alpha(), other.alpha()), (6.0, 6.0), "{name}");
        let values = |t: &Tensor| t.to_vec2::<f32>().unwrap();
        assert_eq!(values(adapter.up()), values(other.up()));
    }
    assert!(folder.path().join("out/lora/sheet.png").is_file());
    // Nothing else is needed, and what was read is what decides.
    let concepts = graph(&own).unwrap();
    let node = concepts
        .nodes()
        .iter()
        .find(|n| n.stage == "concepts")
        .unwrap();
    assert_eq!(node.unneeded, Some("lora.path names a finished LoRA"));
    let state = |sets: &[&str]| format!("{:?}", state_of(&session(&folder, sets), "lora").unwrap());
    assert_eq!(state(&sets), "Fresh");
    assert_eq!(
        state(&["lora.path=lora", "lora.steps=9", "lora.rank=2"]),
        "Fresh"
    );
    assert!(state(&["lora.path=lora", "lora.word=style"]).contains("Stale"));
    fs::write(
        folder.path().join("lora/adapter_config.json"),
        r#"{"lora_alpha": 2}"#,
    )
    .unwrap();
    assert!(state(&sets).contains("InputChanged"));
}

#[test]
fn a_lora_that_does_not_fit_is_refused_by_key_and_name() {
    let folder = project();
    let own = session(&folder, &["lora.path=lora"]);
    let (message, code) = refusal(&own);
    assert!(
        message.contains("lora.path: \"lora\" is not there"),
        "{message}"
    );
    assert_eq!(code, exit::USAGE);
    peft_folder(&folder, 6.0, |t| (t * f64::NAN).unwrap());
    let (message, _) = refusal(&own);
    assert!(message.contains("are not finite"), "{message}");
    peft_folder(&folder, 6.0, |t| match t.dims()[0] < t.dims()[1] {
        true => t.narrow(1, 0, 3).unwrap(),
        false => t,
    });
    let (message, code) = refusal(&own);
    for part in ["cannot use lora.path = \"lora\"", "do not fit the layer of"] {
        assert!(message.contains(part), "{message}");
    }
    assert_eq!(code, exit::FAILED);
    fs::remove_file(folder.path().join("lora/adapter_model.safetensors")).unwrap();
    let (message, code) = refusal(&own);
    assert!(message.contains("lora.path: "), "{message}");
    assert_eq!(code, exit::USAGE);
}

#[test]
fn a_lora_of_huge_values_is_named_and_not_the_model() {
    let folder = project();
    peft_folder(&folder, 6.0, |t| (t * 1e18).unwrap());
    for steps in ["lora.sheet_steps=0", "lora.sheet_steps=1"] {
        let (message, code) = refusal(&session(&folder, &["lora.path=lora", steps]));
        for part in [
            "cannot use lora.path = \"lora\"",
            "prediction is not finite",
            "its values reach",
        ] {
            assert!(message.contains(part), "{message}");
        }
        assert!(!message.contains("dipir-model check"), "{message}");
        assert_eq!(code, exit::FAILED);
    }
}

#[test]
fn a_sheet_that_is_not_finite_with_the_lora_alone_is_not_laid_on_the_model() {
    let folder = project();
    peft_folder(&folder, 6.0, |t| (t * 1e18).unwrap());
    let own = session(&folder, &[]);
    let model = model::load(&own, &own.config.table("model").unwrap()).unwrap();
    let targets = model.unet.adapter_targets();
    let path = folder.path().join("lora");
    let lora = dipir_diffusion::lora::Lora::load(&path, &targets, DType::F32, &Device::Cpu);
    let sheet = Sheet {
        prompts: vec!["a toy".into()],
        steps: 1,
        of: "the LoRA x".into(),
    };
    let to = folder.path().join("sheet.png");
    let error = sheet.write(&model, &lora.unwrap(), None, &to, |_| ());
    let message = error.expect_err("not finite").to_string();
    assert!(message.contains("cannot use the LoRA x: "), "{message}");
}

#[test]
fn what_reading_a_lora_takes_is_foretold() {
    let folder = project();
    let times = Times {
        size: 512,
        unet_s: 1.0,
        sampling_step_s: 2.0,
        decode_s: 8.0,
        lora_step_s: 1000.0,
        ..Times::default()
    };
    let work = |sets: &[&str]| {
        let works = forecast::works(&session(&folder, sets), &times).unwrap();
        works.into_iter().find(|w| w.stage == "lora").unwrap()
    };
    // Two pictures without and two with it, of a quarter of the pixels.
    let read = work(&["lora.path=lora", "lora.sheet_steps=12"]);
    assert_eq!(read.seconds, 1.0 + 4.0 * (12.0 * 2.0 + 8.0) / 4.0);
    let words = "check of a finished LoRA, 4 pictures of 12 steps for its sheet";
    assert_eq!(read.what, words);
    assert_eq!(read.halved_by, ["lora.sheet_steps = 6"]);
    let checked = work(&["lora.path=lora", "lora.sheet_steps=0"]);
    assert_eq!((checked.seconds, checked.halved_by), (1.0, vec![]));
    assert_eq!(work(&[]).seconds, 2000.0);
}

#[test]
fn the_base_model_is_known_by_the_hash_of_its_unet() {
    let folder = project();
    run(&session(&folder, &[])).unwrap();
    let written = Weights::open_file(&folder.path().join("out/lora/lora.safetensors")).unwrap();
    let unet = family().join("unet/diffusion_pytorch_model.safetensors");
    assert_eq!(
        written.metadata()["base_model_blake3"],
        hash_file(&unet).unwrap().1
    );
    let mut plan = StagePlan::new("lora", 1, Value::Null, 0);
    let of = |plan: &StagePlan| base_hash(plan).unwrap();
    for (name, content) in [
        ("m/model_index.json", "{}"),
        ("m/unet/diffusion_pytorch_model-1.safetensors", "a"),
        ("m/unet/diffusion_pytorch_model-2.safetensors", "b"),
        ("m/vae/diffusion_pytorch_model.safetensors", "c"),
    ] {
        plan.input_of_bytes("model", Path::new(name), content.as_bytes());
    }
    let shards = of(&plan);
    assert!(plan.inputs.iter().all(|i| i.blake3 != shards));
    plan.inputs[3].blake3 = "another autoencoder".into();
    assert_eq!(of(&plan), shards);
    plan.inputs[2].blake3 = "another shard".into();
    assert_ne!(of(&plan), shards);
    for variant in [".bf16", ".fp16", ""] {
        let name = format!("m/unet/diffusion_pytorch_model{variant}.safetensors");
        plan.input_of_bytes("model", Path::new(&name), name.as_bytes());
        assert_eq!(
            Some(of(&plan)),
            plan.inputs.last().map(|i| i.blake3.clone())
        );
    }
    let mut plan = StagePlan::new("lora", 1, Value::Null, 0);
    plan.input_of_bytes("model", Path::new("sd15.safetensors"), b"a");
    plan.input_of_bytes("model", Path::new("sd15.yaml"), b"b");
    assert_eq!(of(&plan), plan.inputs[0].blake3);
}

#[test]
fn a_training_is_gone_on_with_by_more_steps_and_not_by_another_prediction() {
    let folder = project();
    let of = |set: &str| {
        let session = session(&folder, &[set]);
        let table = session.config.table("lora").unwrap();
        resumable(&session, &plan(&session).unwrap(), &table).unwrap()
    };
    let first = of("lora.steps=2");
    assert_eq!(of("lora.steps=9"), first);
    assert_ne!(of("model.prediction=v_prediction"), first);
    assert_ne!(of("lora.rank=2"), first);
}

#[test]
fn a_training_that_diverges_names_its_rate() {
    let folder = project();
    let sets = [
        "lora.learning_rate=1e30",
        "lora.warmup_steps=0",
        "lora.steps=5",
    ];
    let (message, _) = refusal(&session(&folder, &sets));
    assert!(
        message.contains("lower lora.learning_rate, which is 1"),
        "{message}"
    );
}

#[test]
fn a_size_that_latents_cannot_make_is_an_error_of_usage() {
    let folder = project();
    let session = session(
        &folder,
        &["concepts.count=1", "concepts.steps=1", "concepts.size=33"],
    );
    let Err(error) = concepts::run(&session) else {
        panic!("it runs")
    };
    assert_eq!(exit::code_of(&error), exit::USAGE);
    let message = exit::describe(&error);
    let part = "concepts.size: 33 is out of range; accepted: multiples of";
    assert!(message.contains(part), "{message}");
}
