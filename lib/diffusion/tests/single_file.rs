//! Whole models in one file. The small references in diffusers' layout are written out under the original names by a table
//! of prefixes that goes the other way and shares nothing with the code, and have to come back tensor by tensor.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::model::Model;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::schedule::Prediction;
use dipir_diffusion::single_file::{Encoder, SingleFile};
use dipir_diffusion::tokenizer::{Padding, Tokenizer};
use dipir_diffusion::vae::Vae;
use dipir_diffusion::weights::{Weights, write_safetensors};

type Outcome = Result<(), Box<dyn std::error::Error>>;
type Tensors = BTreeMap<String, Tensor>;

fn family(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("tests/references")
        .join(name)
}

fn tensors(path: &Path) -> Result<Tensors, dipir_diffusion::Error> {
    let weights = Weights::open_file(path)?;
    let names: Vec<String> = weights.names().map(str::to_owned).collect();
    let mut tensors = Tensors::new();
    for name in names {
        if let Some(tensor) = weights.tensor(&name, DType::F32, &Device::Cpu)? {
            tensors.insert(name, tensor);
        }
    }
    Ok(tensors)
}

/// diffusers' prefixes and the original ones, of a UNet of three levels with one residual block each.
fn unet_table() -> Vec<(String, String)> {
    let mut table: Vec<(String, String)> = [
        ("conv_in.", "input_blocks.0.0."),
        ("time_embedding.linear_1.", "time_embed.0."),
        ("time_embedding.linear_2.", "time_embed.2."),
        ("conv_norm_out.", "out.0."),
        ("conv_out.", "out.2."),
        ("mid_block.resnets.0.", "middle_block.0."),
        ("mid_block.attentions.0.", "middle_block.1."),
        ("mid_block.resnets.1.", "middle_block.2."),
    ]
    .map(|(a, b)| (a.to_owned(), b.to_owned()))
    .into();
    // Counted by hand: 0 conv_in, 1 residual, 2 shrink, 3 residual, 4 shrink, 5 residual; 0 1 | 2 3 | 4 5 upwards.
    for (level, residual, shrink) in [(0, 1, 2), (1, 3, 4), (2, 5, 0)] {
        table.push((
            format!("down_blocks.{level}.resnets.0."),
            format!("input_blocks.{residual}.0."),
        ));
        table.push((
            format!("down_blocks.{level}.attentions.0."),
            format!("input_blocks.{residual}.1."),
        ));
        table.push((
            format!("down_blocks.{level}.downsamplers.0.conv."),
            format!("input_blocks.{shrink}.0.op."),
        ));
    }
    // The coarsest level has no attention, so that its enlargement comes one place earlier.
    for (level, blocks, enlarge) in [(0, [0, 1], "1.1"), (1, [2, 3], "3.2"), (2, [4, 5], "")] {
        for (j, block) in blocks.into_iter().enumerate() {
            table.push((
                format!("up_blocks.{level}.resnets.{j}."),
                format!("output_blocks.{block}.0."),
            ));
            table.push((
                format!("up_blocks.{level}.attentions.{j}."),
                format!("output_blocks.{block}.1."),
            ));
        }
        table.push((
            format!("up_blocks.{level}.upsamplers.0.conv."),
            format!("output_blocks.{enlarge}.conv."),
        ));
    }
    table
}

fn vae_table() -> Vec<(String, String)> {
    let pairs = [
        (
            "encoder.down_blocks.0.resnets.0.",
            "encoder.down.0.block.0.",
        ),
        (
            "encoder.down_blocks.0.downsamplers.0.",
            "encoder.down.0.downsample.",
        ),
        (
            "encoder.down_blocks.1.resnets.0.",
            "encoder.down.1.block.0.",
        ),
        ("decoder.up_blocks.0.resnets.0.", "decoder.up.1.block.0."),
        ("decoder.up_blocks.0.resnets.1.", "decoder.up.1.block.1."),
        (
            "decoder.up_blocks.0.upsamplers.0.",
            "decoder.up.1.upsample.",
        ),
        ("decoder.up_blocks.1.resnets.0.", "decoder.up.0.block.0."),
        ("decoder.up_blocks.1.resnets.1.", "decoder.up.0.block.1."),
    ];
    let mut table: Vec<(String, String)> = pairs.map(|(a, b)| (a.to_owned(), b.to_owned())).into();
    for coder in ["encoder", "decoder"] {
        for (new, old) in [
            ("mid_block.resnets.0.", "mid.block_1."),
            ("mid_block.resnets.1.", "mid.block_2."),
            ("mid_block.attentions.0.group_norm.", "mid.attn_1.norm."),
            ("mid_block.attentions.0.to_q.", "mid.attn_1.q."),
            ("mid_block.attentions.0.to_k.", "mid.attn_1.k."),
            ("mid_block.attentions.0.to_v.", "mid.attn_1.v."),
            ("mid_block.attentions.0.to_out.0.", "mid.attn_1.proj_out."),
            ("conv_norm_out.", "norm_out."),
        ] {
            table.push((format!("{coder}.{new}"), format!("{coder}.{old}")));
        }
    }
    table
}

fn original(name: &str, table: &[(String, String)]) -> String {
    let found = table.iter().find(|(new, _)| name.starts_with(new));
    found.map_or_else(
        || name.to_owned(),
        |(new, old)| format!("{old}{}", &name[new.len()..]),
    )
}

/// Names inside a residual block of the UNet.
fn in_residual(name: String) -> String {
    let inside = [
        (".norm1.", ".in_layers.0."),
        (".conv1.", ".in_layers.2."),
        (".time_emb_proj.", ".emb_layers.1."),
        (".norm2.", ".out_layers.0."),
        (".conv2.", ".out_layers.3."),
        (".conv_shortcut.", ".skip_connection."),
    ];
    match name.contains("transformer_blocks") {
        // Layer norms have the names of group norms there.
        true => name,
        false => inside
            .iter()
            .fold(name, |name, (new, old)| name.replace(new, old)),
    }
}

/// The reference in the original layout.
fn export(name: &str, encoder: Encoder) -> Result<Tensors, Box<dyn std::error::Error>> {
    let folder = family(name);
    let mut all = Tensors::new();
    let table = unet_table();
    for (name, tensor) in tensors(&folder.join("unet/diffusion_pytorch_model.safetensors"))? {
        let old = in_residual(original(&name, &table));
        all.insert(format!("model.diffusion_model.{old}"), tensor);
    }
    let table = vae_table();
    for (name, tensor) in tensors(&folder.join("vae/diffusion_pytorch_model.safetensors"))? {
        let old = original(&name, &table).replace("conv_shortcut", "nin_shortcut");
        // 1x1 convolutions there.
        let tensor = match old.contains("attn_1") && tensor.rank() == 2 {
            true => tensor.unsqueeze(2)?.unsqueeze(3)?,
            false => tensor,
        };
        all.insert(format!("first_stage_model.{old}"), tensor);
    }
    let text: Tensors = tensors(&folder.join("text_encoder/model.safetensors"))?
        .into_iter()
        .map(|(name, t)| (name.trim_start_matches("text_model.").to_owned(), t))
        .collect();
    match encoder {
        Encoder::Clip => {
            for (name, tensor) in text {
                all.insert(
                    format!("cond_stage_model.transformer.text_model.{name}"),
                    tensor,
                );
            }
        }
        Encoder::OpenClip => open_clip(&text, &mut all)?,
    }
    // What such files hold beside the networks.
    all.insert("betas".into(), Tensor::zeros(4, DType::F32, &Device::Cpu)?);
    all.insert(
        "first_stage_model.loss.logvar".into(),
        Tensor::zeros((), DType::F32, &Device::Cpu)?,
    );
    Ok(all)
}

fn open_clip(text: &Tensors, all: &mut Tensors) -> Outcome {
    let mut put = |name: &str, tensor: &Tensor| {
        all.insert(format!("cond_stage_model.model.{name}"), tensor.clone());
    };
    put(
        "token_embedding.weight",
        &text["embeddings.token_embedding.weight"],
    );
    put(
        "positional_embedding",
        &text["embeddings.position_embedding.weight"],
    );
    for kind in ["weight", "bias"] {
        put(
            &format!("ln_final.{kind}"),
            &text[&format!("final_layer_norm.{kind}")],
        );
        // Two layers, and the last one, which is not used.
        for (to, from) in [(0, 0), (1, 1), (2, 0)] {
            let of = |part: &str| &text[&format!("encoder.layers.{from}.{part}.{kind}")];
            let block = format!("transformer.resblocks.{to}");
            let packed = [
                of("self_attn.q_proj"),
                of("self_attn.k_proj"),
                of("self_attn.v_proj"),
            ];
            put(
                &format!("{block}.attn.in_proj_{kind}"),
                &Tensor::cat(&packed, 0)?,
            );
            for (new, old) in [
                ("layer_norm1", "ln_1"),
                ("layer_norm2", "ln_2"),
                ("self_attn.out_proj", "attn.out_proj"),
                ("mlp.fc1", "mlp.c_fc"),
                ("mlp.fc2", "mlp.c_proj"),
            ] {
                put(&format!("{block}.{old}.{kind}"), of(new));
            }
        }
    }
    let logit_scale = Tensor::zeros((), DType::F32, &Device::Cpu)?;
    put("logit_scale", &logit_scale);
    put(
        "text_projection",
        &text["embeddings.position_embedding.weight"],
    );
    Ok(())
}

fn write(folder: &Path, tensors: &Tensors) -> Result<PathBuf, dipir_diffusion::Error> {
    let path = folder.join("model.safetensors");
    write_safetensors(&path, tensors, &BTreeMap::new())?;
    Ok(path)
}

#[test]
fn clip_s_names_may_lack_their_prefix() -> Outcome {
    let whole = export("sd15", Encoder::Clip)?;
    let short: Tensors = whole
        .iter()
        .map(|(name, t)| (name.replace(".text_model.", "."), t.clone()))
        .collect();
    let folder = tempfile::tempdir()?;
    let states = |tensors: &Tensors| -> Result<Vec<f32>, Box<dyn std::error::Error>> {
        let mut file = SingleFile::open(&write(folder.path(), tensors)?, None)?;
        assert_eq!(file.encoder, Encoder::Clip);
        file.unet.norm_num_groups = 4;
        file.vae.norm_num_groups = 4;
        let (_, _, text) = file.networks(DType::F32, &Device::Cpu)?;
        let states = text.forward(&[vec![1, 2, 3]], None)?;
        Ok(states.flatten_all()?.to_vec1()?)
    };
    assert_eq!(states(&short)?, states(&whole)?);
    Ok(())
}

/// An axis of 2^62 beside one of 0 takes no byte; products with it exceed all numbers.
#[test]
fn axes_of_tensors_without_numbers_are_no_sizes() -> Outcome {
    let folder = tempfile::tempdir()?;
    let mut tensors = export("sd15", Encoder::Clip)?;
    let name = "cond_stage_model.transformer.text_model.embeddings.position_embedding.weight";
    let empty = Tensor::zeros((1usize << 62, 0), DType::F32, &Device::Cpu)?;
    assert!(tensors.insert(name.into(), empty).is_some());
    let mut file = SingleFile::open(&write(folder.path(), &tensors)?, None)?;
    (file.unet.norm_num_groups, file.vae.norm_num_groups) = (4, 4);
    let error = file.networks(DType::F32, &Device::Cpu);
    let message = error.expect_err("refused").to_string();
    let said = "max_position_embeddings = 4611686018427387904 does not fit the weights";
    assert!(message.contains(said), "{message}");
    Ok(())
}

#[test]
fn a_level_whose_number_is_the_largest_one_belongs_to_no_layer() -> Outcome {
    let folder = tempfile::tempdir()?;
    let mut tensors = export("sd15", Encoder::Clip)?;
    let name = format!("decoder.up.{}.block.0.conv1.bias", usize::MAX);
    let bias = Tensor::zeros(4, DType::F32, &Device::Cpu)?;
    tensors.insert(format!("first_stage_model.{name}"), bias);
    let mut file = SingleFile::open(&write(folder.path(), &tensors)?, None)?;
    (file.unet.norm_num_groups, file.vae.norm_num_groups) = (4, 4);
    let error = file.networks(DType::F32, &Device::Cpu);
    let message = error.expect_err("refused").to_string();
    let said = format!("tensor \"{name}\" belongs to no layer");
    assert!(message.contains(&said), "{message}");
    Ok(())
}

#[test]
fn a_single_file_gives_the_same_bytes_as_the_folder_that_it_was_made_of() -> Outcome {
    for (name, encoder) in [
        ("sd15", Encoder::Clip),
        ("sd21", Encoder::OpenClip),
        ("inpaint", Encoder::OpenClip),
    ] {
        let model = Model::load(&family(name), DType::F32, &Device::Cpu)?;
        let folder = tempfile::tempdir()?;
        let path = write(folder.path(), &export(name, encoder)?)?;
        let mut file = SingleFile::open(&path, Some(Prediction::Epsilon))?;
        assert_eq!(file.encoder, encoder);
        // Shapes do not tell heads, groups and the size of the training.
        let wanted = model.unet.config();
        file.unet.attention_head_dim = wanted.attention_head_dim.clone();
        file.unet.norm_num_groups = wanted.norm_num_groups;
        file.unet.sample_size = wanted.sample_size;
        file.vae.norm_num_groups = 4;
        file.text.num_attention_heads = model.text_encoder.config().num_attention_heads;
        assert_eq!(&file.unet, wanted, "{name}");
        assert_eq!(&file.text, model.text_encoder.config(), "{name}");
        let (unet, vae, text) = file.networks(DType::F32, &Device::Cpu)?;

        let tokens = vec![model.tokenizer.encode("a photo of a car")?];
        let states = model.text_encoder.forward(&tokens, None)?;
        let same = |what: &str, a: &Tensor, b: &Tensor| -> Outcome {
            let values = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
            assert_eq!(values(a)?, values(b)?, "{name}: {what}");
            Ok(())
        };
        same("text", &text.forward(&tokens, None)?, &states)?;
        let x = Tensor::arange(0f32, (wanted.in_channels * 64) as f32, &Device::Cpu)?;
        let x = (x.reshape((1, wanted.in_channels, 8, 8))? / 100.0)?.sin()?;
        let predict = |unet: &dipir_diffusion::unet::UNet| {
            unet.forward(&x, &[321.0], &states, &Pass::default())
        };
        same("UNet", &predict(&unet)?, &predict(&model.unet)?)?;
        let image =
            (Tensor::arange(0f32, 768.0, &Device::Cpu)?.reshape((1, 3, 16, 16))? / 50.0)?.cos()?;
        let latents = model.vae.encode(&image)?;
        same("encoder", &vae.encode(&image)?, &latents)?;
        same(
            "decoder",
            &vae.decode(&latents)?,
            &model.vae.decode(&latents)?,
        )?;
        assert!(matches!(vae, Vae::Kl(_)));
    }
    Ok(())
}

#[test]
fn what_the_second_family_predicts_is_asked_for_or_found_beside_the_file() -> Outcome {
    let folder = tempfile::tempdir()?;
    let tensors = export("sd21", Encoder::OpenClip)?;
    let path = write(folder.path(), &tensors)?;
    let message = SingleFile::open(&path, None)
        .expect_err("ambiguous")
        .to_string();
    assert!(message.contains("set [model] prediction"), "{message}");
    std::fs::write(
        folder.path().join("model.yaml"),
        "model:\n  params:\n    parameterization: \"v\"\n",
    )?;
    let file = SingleFile::open(&path, None)?;
    assert_eq!(file.schedule.prediction_type, Prediction::Velocity);
    assert_eq!(file.unet.sample_size, 96);
    let yaml = folder.path().join("model.yaml");
    std::fs::write(&yaml, "params:\n  parameterization: v  # not eps\n")?;
    let file = SingleFile::open(&path, None)?;
    assert_eq!(file.schedule.prediction_type, Prediction::Velocity);
    std::fs::write(&yaml, "params:\n  parameterization: \"x0\"\n")?;
    let message = SingleFile::open(&path, None).expect_err("x0").to_string();
    assert!(
        message.contains("parameterization: \"x0\" is not supported"),
        "{message}"
    );
    let header = BTreeMap::from([("modelspec.prediction_type".to_owned(), "epsilon".to_owned())]);
    write_safetensors(&path, &tensors, &header)?;
    let file = SingleFile::open(&path, None)?;
    assert_eq!(file.schedule.prediction_type, Prediction::Epsilon);
    assert_eq!(file.unet.sample_size, 64);
    Ok(())
}

#[test]
fn models_of_other_families_are_refused_by_name() -> Outcome {
    let folder = tempfile::tempdir()?;
    let channels = |n: usize| {
        (
            "model.diffusion_model.input_blocks.0.0.weight",
            vec![320, n, 3, 3],
        )
    };
    for (tensor, name) in [
        (
            ("conditioner.embedders.1.model.ln_final.weight", vec![2]),
            "Stable Diffusion XL",
        ),
        (
            ("conditioner.embedders.0.model.ln_final.weight", vec![2]),
            "refiner",
        ),
        (
            (
                "model.diffusion_model.joint_blocks.0.context_block.x",
                vec![2],
            ),
            "Stable Diffusion 3",
        ),
        (("double_blocks.0.img_attn.qkv.weight", vec![2]), "Flux"),
        (("model.diffusion_model.double_blocks.0.x", vec![2]), "Flux"),
        (
            ("control_model.input_blocks.0.0.weight", vec![2]),
            "ControlNet",
        ),
        (
            ("lora_unet_down_blocks_0.lora_down.weight", vec![2]),
            "a LoRA",
        ),
        (
            ("down_blocks.0.resnets.0.conv1.weight", vec![2]),
            "name the model's folder",
        ),
        (
            ("first_stage_model.encoder.conv_in.weight", vec![2]),
            "an autoencoder alone",
        ),
        (channels(8), "InstructPix2Pix"),
        (channels(5), "for depth"),
        (channels(3), "takes 3 channels"),
        (channels(4), "no text encoder"),
    ] {
        let (key, shape) = tensor;
        let tensors = Tensors::from([(
            key.to_owned(),
            Tensor::zeros(shape, DType::F32, &Device::Cpu)?,
        )]);
        let path = write(folder.path(), &tensors)?;
        let message = SingleFile::open(&path, None).expect_err(name).to_string();
        assert!(message.contains(name), "{key}: {message}");
    }
    let message = SingleFile::open(Path::new("model.ckpt"), None)
        .expect_err("refused")
        .to_string();
    assert!(message.contains("convert it first"), "{message}");
    Ok(())
}

#[test]
fn the_built_in_tokenizer_is_clip_s() -> Outcome {
    let clip = Tokenizer::clip(Padding::End)?;
    assert_eq!(clip.vocab_size(), 49408);
    let tokens = clip.encode("a photo of a cat")?;
    assert_eq!(
        tokens[..8],
        [49406, 320, 1125, 539, 320, 2368, 49407, 49407]
    );
    assert_eq!(tokens.len(), 77);
    let open_clip = Tokenizer::clip(Padding::First)?;
    assert_eq!(open_clip.encode("a photo of a cat")?[6..9], [49407, 0, 0]);
    Ok(())
}
