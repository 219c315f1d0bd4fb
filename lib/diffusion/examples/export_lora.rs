//! Writes a LoRA of both key styles and a prediction made with it, for
//! tests/references/check_lora.py to compare with diffusers:
//!
//!     cargo run -p dipir-diffusion --example export_lora -- tests/references/sd21 OUT

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::lora::{Lora, LoraInfo, LoraStyle};
use dipir_diffusion::model::load_unet;
use dipir_diffusion::noise::NoiseStream;
use dipir_diffusion::pass::Pass;
use dipir_diffusion::weights::write_safetensors;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1).map(PathBuf::from);
    let (Some(folder), Some(out)) = (arguments.next(), arguments.next()) else {
        return Err("usage: export_lora MODEL_FOLDER OUT".into());
    };
    std::fs::create_dir_all(&out)?;
    let unet = load_unet(&folder.join("unet"), DType::F32, &Device::Cpu)?;
    // alpha differs from the rank, so that a reader who ignores it is found out.
    let lora = Lora::new(&unet.adapter_targets(), 4, 6.0, 3, &Device::Cpu)?;
    for (name, variable) in lora.variables() {
        let noise =
            NoiseStream::named(5, name).normal_tensor(variable.dims(), DType::F32, &Device::Cpu)?;
        variable.set(&(noise * 0.2)?)?;
    }
    let info = LoraInfo::from([(
        "prompt".to_owned(),
        "a scene in the style of sks rendering".to_owned(),
    )]);
    lora.save(&out.join("lora.safetensors"), LoraStyle::Peft, &info)?;
    lora.save(&out.join("lora_kohya.safetensors"), LoraStyle::Kohya, &info)?;
    let mut noise = NoiseStream::new(6, 6);
    let config = unet.config();
    let sample = noise.normal_tensor(&[1, config.in_channels, 8, 8], DType::F32, &Device::Cpu)?;
    let context = noise.normal_tensor(
        &[1, 7, config.cross_attention_dim],
        DType::F32,
        &Device::Cpu,
    )?;
    let prediction = unet
        .forward(
            &sample,
            &[321.0],
            &context,
            &Pass::with_lora(&Arc::new(lora)),
        )?
        .detach();
    let timestep = Tensor::new(321f32, &Device::Cpu)?;
    let tensors = BTreeMap::from([
        ("sample".to_owned(), sample),
        ("context".to_owned(), context),
        ("timestep".to_owned(), timestep),
        ("prediction".to_owned(), prediction),
    ]);
    write_safetensors(
        &out.join("prediction.safetensors"),
        &tensors,
        &BTreeMap::new(),
    )?;
    Ok(())
}
