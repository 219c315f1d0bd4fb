"""Times a UNet forward, a LoRA step and an encoding of a whole model here and in diffusers.

    python make.py --full sd21 FOLDER
    cargo build --release -p dipir-diffusion --example model_times
    python time_model.py ../../../../target/release/examples/model_times FOLDER

Prints wall and processor seconds of both, the smaller of TURNS (2) turns each, taken
alternately, and the peak memory. With PROCESSOR=1 in the environment both use
one thread: then processor time is the figure to compare, and other work on
the machine disturbs it least. PRECISION=bf16 has the model in bf16 on both sides.
"""

import os
import pathlib
import resource
import subprocess
import sys
import time

import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from peft import LoraConfig


PROCESSOR = os.environ.get("PROCESSOR") == "1"
TURNS = int(os.environ.get("TURNS", "2"))
PRECISION = os.environ.get("PRECISION", "f32")
DTYPE = dict(f32=torch.float32, bf16=torch.bfloat16)[PRECISION]


def ours_of(program, folder):
    environment = dict(os.environ)
    if PROCESSOR:
        environment |= dict(RAYON_NUM_THREADS="1", CANDLE_NUM_THREADS="1")
    precision = ["bf16"] if PRECISION == "bf16" else []
    out = subprocess.run([program, folder, *precision], capture_output=True, text=True, check=True, env=environment)
    return {line.split()[0]: [float(n) for n in line.split()[1:]] for line in out.stdout.splitlines()}


def smaller(a, b):
    return [min(x, y) for x, y in zip(a, b)] if a else b


def main():
    program, folder = sys.argv[1:]
    if PROCESSOR:
        torch.set_num_threads(1)
    unet = UNet2DConditionModel.from_pretrained(pathlib.Path(folder) / "unet", torch_dtype=DTYPE)
    unet.requires_grad_(False)
    sample = torch.randn(1, 4, 64, 64, dtype=DTYPE)
    context = torch.randn(1, 77, unet.config.cross_attention_dim, dtype=DTYPE)
    vae = AutoencoderKL.from_pretrained(pathlib.Path(folder) / "vae", torch_dtype=DTYPE).requires_grad_(False)
    image = torch.randn(1, 3, 512, 512, dtype=DTYPE)

    def timed(run):
        run()
        wall, processor = time.perf_counter(), time.process_time()
        run()
        return [time.perf_counter() - wall, time.process_time() - processor]

    def forward():
        with torch.no_grad():
            unet(sample, 500, context)

    def step():
        optimizer.zero_grad()
        (unet(sample, 500, context).sample - sample).square().mean().backward()
        optimizer.step()

    def encode():
        with torch.no_grad():
            vae.encode(image)

    def gradient():
        seen = image.clone().requires_grad_()
        vae.encode(seen).latent_dist.mean.backward(sample)

    ours, theirs = {}, {}
    for turn in range(TURNS):
        for name, numbers in ours_of(program, folder).items():
            ours[name] = smaller(ours.get(name), numbers)
        if turn > 0:
            unet.disable_adapters()
            unet.eval()
        theirs["forward"] = smaller(theirs.get("forward"), timed(forward))
        if turn == 0:
            unet.add_adapter(LoraConfig(r=4, lora_alpha=4, target_modules=["to_q", "to_k", "to_v", "to_out.0"]))
            unet.enable_gradient_checkpointing()
            optimizer = torch.optim.AdamW([p for p in unet.parameters() if p.requires_grad])
        else:
            unet.enable_adapters()
        unet.train()
        theirs["step"] = smaller(theirs.get("step"), timed(step))
        theirs["encode"] = smaller(theirs.get("encode"), timed(encode))
        theirs["gradient"] = smaller(theirs.get("gradient"), timed(gradient))
    for name in ["forward", "step", "encode", "gradient"]:
        (wall, processor), (wall2, processor2) = ours[name], theirs[name]
        print(f"{name:8} here {wall:7.2f} s wall {processor:7.2f} s processor   diffusers {wall2:7.2f} {processor2:7.2f}   ratio {wall / wall2:.2f} {processor / processor2:.2f}")
    print(f"of the step here, the text encoder: {ours['text'][0]:.2f} s wall {ours['text'][1]:.2f} s processor")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory: here {ours['peak_mib'][0]:.0f} MiB (text encoder and autoencoder included), diffusers {peak:.0f} MiB (no text encoder)")


if __name__ == "__main__":
    main()
