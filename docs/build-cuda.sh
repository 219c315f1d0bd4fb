#!/usr/bin/env bash
# Builds the executables for a machine with an NVIDIA GPU so that they start on one without a driver, too.
#   docs/build-cuda.sh [arguments of cargo build]        in the repository's root; nvcc has to be on the PATH
# candle-core 0.11.1 asks cudarc to link CUDA's libraries, so that a binary does not start where they are missing. Here
# a copy of it asks for loading them at run time. The copy and the lock file's change stay out of the repository.
set -euo pipefail
copy=${CARGO_TARGET_DIR:-target}/candle-core-loading
cargo fetch --locked -q
source=$(ls -d "${CARGO_HOME:-$HOME/.cargo}"/registry/src/*/candle-core-0.11.1 | head -n 1)
mkdir -p "$copy" && rm -rf "$copy" && cp -r "$source" "$copy"
sed -i 's/"dynamic-linking"/"dynamic-loading"/' "$copy/Cargo.toml"
lock=$(mktemp); cp Cargo.lock "$lock"; trap 'cp "$lock" Cargo.lock; rm -f "$lock"' EXIT
cargo build --release --features cuda --config "patch.crates-io.candle-core.path=\"$(realpath "$copy")\"" "$@"
