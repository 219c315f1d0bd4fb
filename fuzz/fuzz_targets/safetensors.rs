#![no_main]
use candle_core::{DType, Device};
use dipir_diffusion::weights::Weights;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let name = format!("dipir-fuzz-safetensors-{}", std::process::id());
    let path = std::env::temp_dir().join(name);
    if std::fs::write(&path, bytes).is_ok() {
        if let Ok(weights) = Weights::open_file(&path) {
            let names: Vec<String> = weights.names().map(str::to_owned).collect();
            for name in names {
                if let Ok(Some(tensor)) = weights.tensor(&name, DType::F32, &Device::Cpu) {
                    assert_eq!(Some(tensor.dims()), weights.shape(&name));
                }
            }
        }
        let _ = std::fs::remove_file(&path);
    }
});
