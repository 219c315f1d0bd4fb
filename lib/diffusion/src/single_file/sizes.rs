//! What the shapes in a file tell of the networks.

use super::{CLIP, Encoder, OPEN_CLIP, UNET, VAE};
use crate::config::PerLevel;
use crate::text_encoder::TextEncoderConfig;
use crate::unet::UNetConfig;
use crate::vae::AutoencoderConfig;
use crate::weights::Weights;

/// Channels of a head of Stable Diffusion 2's UNet and of both text encoders.
const HEAD: usize = 64;
/// Heads of every attention of Stable Diffusion 1.
const HEADS: usize = 8;

/// What a file holds that is no Stable Diffusion 1 or 2, by its name.
pub(super) fn foreign(weights: &Weights) -> Option<String> {
    let has = |start: &str| weights.names().any(|n| n.starts_with(start));
    let within = |part: &str| weights.names().any(|n| n.contains(part));
    // The most telling first.
    let known: [(bool, &str); 12] = [
        (has("conditioner.embedders.1."), "Stable Diffusion XL"),
        (
            has("conditioner."),
            "Stable Diffusion XL's refiner, or another model of that code",
        ),
        (within("joint_blocks."), "Stable Diffusion 3"),
        (within("double_blocks."), "Flux"),
        (
            within("time_stack.") || within("time_mixer"),
            "a video model",
        ),
        (has("control_model."), "a ControlNet"),
        (has("embedder."), "Stable Diffusion 2.1 unCLIP"),
        (
            has("model.diffusion_model.label_emb."),
            "a UNet with labels, as Stable Diffusion XL has",
        ),
        (
            has("lora_") || within(".lora_down.") || within(".lora_A."),
            "a LoRA, not a model",
        ),
        (
            has("down_blocks.") || has("unet."),
            "one part in the layout of diffusers: name the model's folder",
        ),
        (has("text_model."), "a text encoder alone"),
        (
            has("encoder.down.") || (has(VAE) && !has(UNET)),
            "an autoencoder alone",
        ),
    ];
    if let Some((_, name)) = known.iter().find(|(found, _)| *found) {
        return Some((*name).to_owned());
    }
    let Some([_, channels, ..]) = weights.shape(&format!("{UNET}input_blocks.0.0.weight")) else {
        return Some(format!("no UNet ({UNET}input_blocks.*)"));
    };
    match channels {
        4 | 9 => None,
        5 => Some("Stable Diffusion 2 for depth, whose UNet takes 5 channels".into()),
        7 => Some("the upscaler of Stable Diffusion, whose UNet takes 7 channels".into()),
        8 => Some("InstructPix2Pix, whose UNet takes 8 channels".into()),
        n => Some(format!("a UNet that takes {n} channels")),
    }
}

pub(super) fn encoder(weights: &Weights) -> Option<Encoder> {
    if clip_prefix(weights).is_some() {
        return Some(Encoder::Clip);
    }
    let open = weights.contains(&format!("{OPEN_CLIP}token_embedding.weight"));
    open.then_some(Encoder::OpenClip)
}

/// What stands before the names of CLIP's tensors: transformers 5 leaves out `text_model.`.
fn clip_prefix(weights: &Weights) -> Option<String> {
    let prefixes = ["text_model.", ""].map(|part| format!("{CLIP}{part}"));
    let has =
        |prefix: &String| weights.contains(&format!("{prefix}embeddings.token_embedding.weight"));
    prefixes.into_iter().find(has)
}

/// Shape of the tensor `name` below `prefix`.
fn shape<'a>(weights: &'a Weights, prefix: &str, name: &str) -> Option<&'a [usize]> {
    weights.shape(&format!("{prefix}{name}"))
}

/// How many n from 0 on have a tensor `name(n)`.
fn count(weights: &Weights, prefix: &str, name: impl Fn(usize) -> String) -> usize {
    let exists = |n: &usize| weights.contains(&format!("{prefix}{}", name(*n)));
    (0..).take_while(exists).count()
}

pub(super) fn unet(weights: &Weights, encoder: Encoder) -> Option<UNetConfig> {
    let of = |name: &str| shape(weights, UNET, name);
    let input = of("input_blocks.0.0.weight")?;
    // Levels end with a block that shrinks, the last one with the end of the list.
    let (mut channels, mut attends, mut depths) = (vec![], vec![], vec![]);
    let (mut layers, mut index, mut context, mut linear) = (0, 1, None, false);
    let mut inside = 0;
    loop {
        let block = format!("input_blocks.{index}");
        if of(&format!("{block}.0.op.weight")).is_some() {
            (layers, inside) = (inside, 0);
        } else if let Some(conv) = of(&format!("{block}.0.out_layers.3.weight")) {
            if inside == 0 {
                channels.push(*conv.first()?);
                let transformer = format!("{block}.1.transformer_blocks");
                let depth = count(weights, UNET, |n| format!("{transformer}.{n}.norm1.weight"));
                attends.push(depth > 0);
                depths.push(depth.max(1));
                if depth > 0 {
                    context = of(&format!("{transformer}.0.attn2.to_k.weight"))?
                        .get(1)
                        .copied();
                    linear = of(&format!("{block}.1.proj_in.weight"))?.len() == 2;
                }
            }
            inside += 1;
        } else {
            break;
        }
        index += 1;
    }
    let named = |attends: bool, with: &str, without: &str| match attends {
        true => with.to_owned(),
        false => without.to_owned(),
    };
    let heads = match encoder {
        Encoder::Clip => PerLevel::All(HEADS),
        Encoder::OpenClip => PerLevel::Each(channels.iter().map(|c| (c / HEAD).max(1)).collect()),
    };
    Some(UNetConfig {
        sample_size: 64,
        in_channels: *input.get(1)?,
        out_channels: *of("out.2.weight")?.first()?,
        down_block_types: attends
            .iter()
            .map(|&a| named(a, "CrossAttnDownBlock2D", "DownBlock2D"))
            .collect(),
        up_block_types: attends
            .iter()
            .rev()
            .map(|&a| named(a, "CrossAttnUpBlock2D", "UpBlock2D"))
            .collect(),
        block_out_channels: channels,
        layers_per_block: match layers {
            0 => inside,
            layers => layers,
        },
        transformer_layers_per_block: match depths.iter().all(|&d| d == 1) {
            true => PerLevel::All(1),
            false => PerLevel::Each(depths),
        },
        attention_head_dim: heads,
        cross_attention_dim: context?,
        use_linear_projection: linear,
        ..UNetConfig::default()
    })
}

pub(super) fn vae(weights: &Weights) -> Option<AutoencoderConfig> {
    let of = |name: &str| shape(weights, VAE, name);
    let levels = count(weights, VAE, |n| {
        format!("encoder.down.{n}.block.0.conv2.weight")
    });
    let channels =
        (0..levels).map(|n| Some(*of(&format!("encoder.down.{n}.block.0.conv2.weight"))?.first()?));
    Some(AutoencoderConfig {
        in_channels: *of("encoder.conv_in.weight")?.get(1)?,
        out_channels: *of("decoder.conv_out.weight")?.first()?,
        latent_channels: *of("decoder.conv_in.weight")?.get(1)?,
        block_out_channels: channels.collect::<Option<_>>()?,
        layers_per_block: count(weights, VAE, |n| {
            format!("encoder.down.0.block.{n}.conv2.weight")
        }),
        use_quant_conv: of("quant_conv.weight").is_some(),
        use_post_quant_conv: of("post_quant_conv.weight").is_some(),
        ..AutoencoderConfig::default()
    })
}

pub(super) fn text(weights: &Weights, encoder: Encoder) -> Option<TextEncoderConfig> {
    let (prefix, tokens, positions, hidden_act) = match encoder {
        Encoder::Clip => (
            clip_prefix(weights)?,
            "embeddings.token_embedding.weight",
            "embeddings.position_embedding.weight",
            "quick_gelu",
        ),
        Encoder::OpenClip => (
            OPEN_CLIP.to_owned(),
            "token_embedding.weight",
            "positional_embedding",
            "gelu",
        ),
    };
    let of = |name: &str| shape(weights, &prefix, name);
    let layer = |n: usize| match encoder {
        Encoder::Clip => format!("encoder.layers.{n}.mlp.fc1.weight"),
        Encoder::OpenClip => format!("transformer.resblocks.{n}.mlp.c_fc.weight"),
    };
    let layers = count(weights, &prefix, layer);
    let width = *of(tokens)?.get(1)?;
    Some(TextEncoderConfig {
        vocab_size: *of(tokens)?.first()?,
        hidden_size: width,
        intermediate_size: *of(&layer(0))?.first()?,
        num_hidden_layers: match encoder {
            Encoder::Clip => layers,
            // The states before the last layer are used.
            Encoder::OpenClip => layers.checked_sub(1)?,
        },
        num_attention_heads: (width / HEAD).max(1),
        max_position_embeddings: *of(positions)?.first()?,
        hidden_act: hidden_act.into(),
        ..TextEncoderConfig::default()
    })
}
