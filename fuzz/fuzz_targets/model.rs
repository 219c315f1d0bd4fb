#![no_main]
use candle_core::{DType, Device};
use dipir_diffusion::model::load_unet;
use dipir_diffusion::schedule::{NoiseSchedule, Prediction};
use dipir_diffusion::single_file::SingleFile;
use dipir_diffusion::text_encoder::TextEncoder;
use dipir_diffusion::vae::Vae;
use libfuzzer_sys::fuzz_target;

/// Names under which the parts, and a model in one file, look for weights.
const FILES: [&str; 3] = [
    "diffusion_pytorch_model.safetensors",
    "model.safetensors",
    "one.safetensors",
];

// A configuration, which every part takes for its own, a line of `---`, and weights; or a model in one file.
fuzz_target!(|bytes: &[u8]| {
    const LINE: &[u8] = b"\n---\n";
    let cut = bytes.windows(LINE.len()).position(|w| w == LINE);
    let (config, weights) = match cut {
        Some(at) => (&bytes[..at], &bytes[at + LINE.len()..]),
        None => (&b"{}"[..], bytes),
    };
    let name = format!("dipir-fuzz-model-{}", std::process::id());
    let folder = std::env::temp_dir().join(name);
    if std::fs::create_dir_all(&folder).is_ok() {
        for name in ["config.json", "scheduler_config.json"] {
            let _ = std::fs::write(folder.join(name), config);
        }
        for name in FILES {
            let _ = std::fs::write(folder.join(name), weights);
        }
        let _ = load_unet(&folder, DType::F32, &Device::Cpu);
        let _ = Vae::load(&folder, DType::F32, &Device::Cpu);
        let _ = TextEncoder::load(&folder, DType::F32, &Device::Cpu);
        let _ = NoiseSchedule::load(&folder);
        let file = SingleFile::open(&folder.join(FILES[2]), Some(Prediction::Epsilon));
        if let Ok(file) = file {
            let _ = file.networks(DType::F32, &Device::Cpu);
        }
        let _ = std::fs::remove_dir_all(&folder);
    }
});
