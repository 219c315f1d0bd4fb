#![no_main]
use candle_core::{DType, Device};
use dipir_diffusion::lora::{AdapterTarget, Lora};
use libfuzzer_sys::fuzz_target;

/// Layers of a UNet that is a little of the real one.
fn targets() -> Vec<AdapterTarget> {
    let layers = ["attn1.to_q", "attn2.to_k", "attn2.to_out.0"];
    let blocks = ["down_blocks.1.attentions.0", "mid_block.attentions.0"];
    let target = |block: &str, layer: &str| AdapterTarget {
        name: format!("{block}.transformer_blocks.0.{layer}"),
        inputs: 4,
        outputs: 4,
        pointwise_conv: false,
    };
    let all = blocks
        .iter()
        .flat_map(|block| layers.map(|layer| target(block, layer)));
    all.collect()
}

// A LoRA, with the `adapter_config.json` beside it in front of a line of `---`, if there is one.
fuzz_target!(|bytes: &[u8]| {
    const LINE: &[u8] = b"\n---\n";
    let cut = bytes.windows(LINE.len()).position(|w| w == LINE);
    let (config, file) = match cut {
        Some(at) => (Some(&bytes[..at]), &bytes[at + LINE.len()..]),
        None => (None, bytes),
    };
    let name = format!("dipir-fuzz-lora-{}", std::process::id());
    let folder = std::env::temp_dir().join(name);
    if std::fs::create_dir_all(&folder).is_ok() {
        let path = folder.join("adapter_model.safetensors");
        let _ = std::fs::write(&path, file);
        if let Some(config) = config {
            let _ = std::fs::write(folder.join("adapter_config.json"), config);
        }
        let _ = Lora::load(&path, &targets(), DType::F32, &Device::Cpu);
        let _ = std::fs::remove_dir_all(&folder);
    }
});
