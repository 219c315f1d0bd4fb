//! Compiles the kernels for NVIDIA GPUs, with `--features cuda` alone.

use std::path::PathBuf;
use std::process::Command;

/// Sources and their architectures: PTX runs on that one and on every later one, the driver compiles it for the GPU at hand.
const SOURCES: [(&str, &str); 2] = [("kernels", "compute_75"), ("flash", "compute_80")];

fn main() {
    println!("cargo:rerun-if-changed=src/cuda");
    if std::env::var_os("CARGO_FEATURE_CUDA").is_none() {
        return;
    }
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let nvcc = std::env::var_os("NVCC").unwrap_or_else(|| "nvcc".into());
    for (name, architecture) in SOURCES {
        let mut command = Command::new(&nvcc);
        command
            .args(["-ptx", "-O3", "-arch", architecture])
            .arg(format!("src/cuda/{name}.cu"))
            .arg("-o")
            .arg(out.join(name).with_extension("ptx"));
        match command.status() {
            Ok(status) if status.success() => {}
            Ok(status) => panic!("{command:?}: {status}"),
            Err(e) => panic!(
                "{}: {e}; --features cuda needs CUDA's toolkit: put nvcc on the PATH, or its path into NVCC",
                nvcc.display()
            ),
        }
    }
}
