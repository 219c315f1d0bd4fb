"""Times a UNet forward and a LoRA step of a whole model here and in diffusers.

    python make.py --full sd21 FOLDER
    cargo build --release -p dipir-diffusion --example model_times
    python time_model.py ../../../../target/release/examples/model_times FOLDER

Prints wall and processor seconds of both, and the peak memory. Processor time
is the figure to compare when the machine does other work.
"""

import pathlib
import resource
import subprocess
import sys
import time

import torch
from diffusers import UNet2DConditionModel
from peft import LoraConfig


def main():
    program, folder = sys.argv[1:]
    ours = {}
    for line in subprocess.run([program, folder], capture_output=True, text=True, check=True).stdout.splitlines():
        name, *numbers = line.split()
        ours[name] = [float(n) for n in numbers]
    unet = UNet2DConditionModel.from_pretrained(pathlib.Path(folder) / "unet", torch_dtype=torch.float32)
    sample, context = torch.randn(1, 4, 64, 64), torch.randn(1, 77, unet.config.cross_attention_dim)

    def report(name, run):
        run()
        wall, processor = time.perf_counter(), time.process_time()
        run()
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        print(f"{name:8} here {ours[name][0]:7.2f} s wall {ours[name][1]:7.2f} s processor   diffusers {wall:7.2f} {processor:7.2f}   ratio {ours[name][0] / wall:.2f} {ours[name][1] / processor:.2f}", flush=True)

    def forward():
        with torch.no_grad():
            unet(sample, 500, context)

    def step():
        optimizer.zero_grad()
        (unet(sample, 500, context).sample - sample).square().mean().backward()
        optimizer.step()

    report("forward", forward)
    unet.requires_grad_(False)
    unet.add_adapter(LoraConfig(r=4, lora_alpha=4, target_modules=["to_q", "to_k", "to_v", "to_out.0"]))
    unet.enable_gradient_checkpointing()
    unet.train()
    optimizer = torch.optim.AdamW([p for p in unet.parameters() if p.requires_grad])
    report("step", step)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory: here {ours['peak_mib'][0]:.0f} MiB (text encoder and autoencoder included), diffusers {peak:.0f} MiB (UNet alone)")


if __name__ == "__main__":
    main()
