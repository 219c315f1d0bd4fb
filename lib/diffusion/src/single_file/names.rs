//! Names of tensors in the original layout, as diffusers and transformers call them. A name that is not known stays as it
//! is, so that building the network reports it.

/// `input_blocks.4.1.proj_in.weight` to `down_blocks.1.attentions.0.proj_in.weight`. `layers` are the residual blocks of a
/// level on the way down; the level's last block shrinks.
pub(super) fn unet(name: &str, layers: usize) -> String {
    let stays = || name.to_owned();
    let Some((block, rest)) = name.split_once('.') else {
        return stays();
    };
    match block {
        "time_embed" => numbered(
            rest,
            &[
                ("0", "time_embedding.linear_1"),
                ("2", "time_embedding.linear_2"),
            ],
        ),
        "out" => numbered(rest, &[("0", "conv_norm_out"), ("2", "conv_out")]),
        "middle_block" => match rest.split_once('.') {
            Some(("0", rest)) => Some(format!("mid_block.resnets.0.{}", resnet(rest))),
            Some(("1", rest)) => Some(format!("mid_block.attentions.0.{rest}")),
            Some(("2", rest)) => Some(format!("mid_block.resnets.1.{}", resnet(rest))),
            _ => None,
        },
        "input_blocks" => two_numbers(rest).and_then(|(n, part, rest)| {
            let Some(n) = n.checked_sub(1) else {
                return Some(format!("conv_in.{rest}"));
            };
            let (level, index) = (n / (layers + 1), n % (layers + 1));
            Some(match (index == layers, part) {
                (true, _) => format!(
                    "down_blocks.{level}.downsamplers.0.conv.{}",
                    rest.strip_prefix("op.")?
                ),
                (false, 0) => format!("down_blocks.{level}.resnets.{index}.{}", resnet(rest)),
                (false, _) => format!("down_blocks.{level}.attentions.{index}.{rest}"),
            })
        }),
        "output_blocks" => two_numbers(rest).map(|(n, part, rest)| {
            let (level, index) = (n / (layers + 1), n % (layers + 1));
            match (part, rest.strip_prefix("conv.")) {
                (0, _) => format!("up_blocks.{level}.resnets.{index}.{}", resnet(rest)),
                (_, Some(rest)) => format!("up_blocks.{level}.upsamplers.0.conv.{rest}"),
                _ => format!("up_blocks.{level}.attentions.{index}.{rest}"),
            }
        }),
        _ => None,
    }
    .unwrap_or_else(stays)
}

/// The reverse for a layer of an attention: `down_blocks.1.attentions.0.proj_in` to `input_blocks.4.1.proj_in`. Nothing for
/// other layers.
pub(crate) fn original_attention(name: &str, layers: usize) -> Option<String> {
    if let Some(rest) = name.strip_prefix("mid_block.attentions.0.") {
        return Some(format!("middle_block.1.{rest}"));
    }
    let (block, rest) = name.split_once('.')?;
    let (level, rest) = rest.split_once(".attentions.")?;
    let (index, rest) = rest.split_once('.')?;
    let (level, index): (usize, usize) = (level.parse().ok()?, index.parse().ok()?);
    let n = level * (layers + 1) + index;
    match block {
        // The first is the convolution of the input.
        "down_blocks" => Some(format!("input_blocks.{}.1.{rest}", n + 1)),
        "up_blocks" => Some(format!("output_blocks.{n}.1.{rest}")),
        _ => None,
    }
}

/// `3.0.rest` to (3, 0, `rest`).
fn two_numbers(text: &str) -> Option<(usize, usize, &str)> {
    let (first, rest) = text.split_once('.')?;
    let (second, rest) = rest.split_once('.')?;
    Some((first.parse().ok()?, second.parse().ok()?, rest))
}

/// `0.weight` to the name that stands for 0, and `.weight`.
fn numbered(rest: &str, known: &[(&str, &str)]) -> Option<String> {
    let (number, rest) = rest.split_once('.')?;
    let (_, name) = known.iter().find(|(n, _)| *n == number)?;
    Some(format!("{name}.{rest}"))
}

/// A tensor of the UNet's residual block.
fn resnet(name: &str) -> String {
    const PARTS: [(&str, &str); 6] = [
        ("in_layers.0.", "norm1."),
        ("in_layers.2.", "conv1."),
        ("emb_layers.1.", "time_emb_proj."),
        ("out_layers.0.", "norm2."),
        ("out_layers.3.", "conv2."),
        ("skip_connection.", "conv_shortcut."),
    ];
    replaced(name, &PARTS)
}

fn replaced(name: &str, parts: &[(&str, &str)]) -> String {
    let found = parts
        .iter()
        .find_map(|(from, to)| Some(format!("{to}{}", name.strip_prefix(from)?)));
    found.unwrap_or_else(|| name.to_owned())
}

/// Whether a tensor of the autoencoder serves its training alone.
pub(super) fn is_of_training(name: &str) -> bool {
    name.starts_with("loss.") || name.starts_with("model_ema.")
}

/// `encoder.down.1.block.0.nin_shortcut.weight` to `encoder.down_blocks.1.resnets.0.conv_shortcut.weight`. The decoder
/// counts its `levels` from the coarsest here, from the finest there.
pub(super) fn vae(name: &str, levels: usize) -> String {
    vae_of(name, levels).unwrap_or_else(|| name.to_owned())
}

fn vae_of(name: &str, levels: usize) -> Option<String> {
    let (coder, rest) = name.split_once('.')?;
    if !["encoder", "decoder"].contains(&coder) {
        return None;
    }
    let (block, inside) = rest.split_once('.')?;
    let renamed = match block {
        "norm_out" => format!("conv_norm_out.{inside}"),
        "mid" => vae_middle(inside)?,
        "down" => {
            let (level, rest) = inside.split_once('.')?;
            format!(
                "down_blocks.{level}.{}",
                vae_level(rest, "downsample", "downsamplers")?
            )
        }
        "up" => {
            let (level, rest) = inside.split_once('.')?;
            let level: usize = level.parse().ok()?;
            let level = levels.checked_sub(level.checked_add(1)?)?;
            format!(
                "up_blocks.{level}.{}",
                vae_level(rest, "upsample", "upsamplers")?
            )
        }
        _ => return None,
    };
    Some(format!("{coder}.{renamed}"))
}

fn vae_level(rest: &str, resample: &str, renamed: &str) -> Option<String> {
    let (part, rest) = rest.split_once('.')?;
    if part == resample {
        return Some(format!("{renamed}.0.{rest}"));
    }
    let (index, rest) = rest.split_once('.')?;
    (part == "block").then(|| format!("resnets.{index}.{}", vae_resnet(rest)))
}

fn vae_resnet(name: &str) -> String {
    replaced(name, &[("nin_shortcut.", "conv_shortcut.")])
}

fn vae_middle(inside: &str) -> Option<String> {
    let (part, rest) = inside.split_once('.')?;
    Some(match part {
        "block_1" => format!("mid_block.resnets.0.{}", vae_resnet(rest)),
        "block_2" => format!("mid_block.resnets.1.{}", vae_resnet(rest)),
        "attn_1" => {
            const PARTS: [(&str, &str); 5] = [
                ("norm.", "group_norm."),
                ("q.", "to_q."),
                ("k.", "to_k."),
                ("v.", "to_v."),
                ("proj_out.", "to_out.0."),
            ];
            format!("mid_block.attentions.0.{}", replaced(rest, &PARTS))
        }
        _ => return None,
    })
}

/// A tensor of OpenCLIP's text encoder; three names for the one that holds query, key and value one above the other, none
/// for what comes after the `layers` that Stable Diffusion uses.
pub(super) fn open_clip(name: &str, layers: usize) -> Vec<String> {
    let text = |name: &str| vec![format!("text_model.{name}")];
    match name {
        "positional_embedding" => return text("embeddings.position_embedding.weight"),
        "token_embedding.weight" => return text("embeddings.token_embedding.weight"),
        "text_projection" | "logit_scale" | "attn_mask" => return vec![],
        _ => {}
    }
    if let Some(rest) = name.strip_prefix("ln_final.") {
        return text(&format!("final_layer_norm.{rest}"));
    }
    let block = name
        .strip_prefix("transformer.resblocks.")
        .and_then(|rest| rest.split_once('.'));
    let Some((Ok(layer), rest)) = block.map(|(n, rest)| (n.parse::<usize>(), rest)) else {
        return vec![name.to_owned()];
    };
    if layer >= layers {
        return vec![];
    }
    let of = |rest: &str| format!("text_model.encoder.layers.{layer}.{rest}");
    if let Some(kind) = rest.strip_prefix("attn.in_proj_") {
        return ["q", "k", "v"]
            .map(|p| of(&format!("self_attn.{p}_proj.{kind}")))
            .into();
    }
    const PARTS: [(&str, &str); 5] = [
        ("ln_1.", "layer_norm1."),
        ("ln_2.", "layer_norm2."),
        ("attn.out_proj.", "self_attn.out_proj."),
        ("mlp.c_fc.", "mlp.fc1."),
        ("mlp.c_proj.", "mlp.fc2."),
    ];
    vec![of(&replaced(rest, &PARTS))]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_of_attentions_are_found_under_their_original_names() {
        for (original, name) in [
            (
                "input_blocks.1.1.proj_in",
                "down_blocks.0.attentions.0.proj_in",
            ),
            (
                "input_blocks.8.1.proj_in",
                "down_blocks.2.attentions.1.proj_in",
            ),
            ("middle_block.1.proj_in", "mid_block.attentions.0.proj_in"),
            (
                "output_blocks.3.1.proj_in",
                "up_blocks.1.attentions.0.proj_in",
            ),
            (
                "output_blocks.11.1.proj_in",
                "up_blocks.3.attentions.2.proj_in",
            ),
        ] {
            assert_eq!(unet(original, 2), name);
            assert_eq!(original_attention(name, 2).as_deref(), Some(original));
        }
        for name in [
            "conv_in",
            "down_blocks.0.resnets.0.conv1",
            "time_embedding.linear_1",
        ] {
            assert_eq!(original_attention(name, 2), None, "{name}");
        }
    }
}
