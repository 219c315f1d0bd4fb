"""Times layers here and in PyTorch on the same cores, in turns, in one run.

    cargo build --release -p dipir-diffusion --example layer_times
    python time_layers.py ../../../../target/release/examples/layer_times

Prints milliseconds of both, the smallest over all turns, and their ratio
(below 1: faster than PyTorch). With PROCESSOR=1 in the environment both use
one thread and what is compared is processor time, which other work on the
machine disturbs less.
"""

import os
import subprocess
import sys
import time

import torch
import torch.nn.functional as F

CASES = ["linear", "conv320", "conv64", "conv128", "conv1280", "groupnorm", "attention", "unet"]
TURNS = int(os.environ.get("TURNS", "2"))


def case(name, train):
    parameter = lambda *shape: (0.05 * torch.randn(shape)).requires_grad_(train)
    if name == "linear":
        w, b = parameter(1280, 320), parameter(1280)
        return (4096, 320), lambda x: F.linear(x, w, b)
    if name.startswith("conv"):
        batch, channels, side = {"conv320": (1, 320, 64), "conv64": (8, 64, 32), "conv128": (8, 128, 16), "conv1280": (1, 1280, 16)}[name]
        w, b = parameter(channels, channels, 3, 3), parameter(channels)
        return (batch, channels, side, side), lambda x: F.conv2d(x, w, b, padding=1)
    if name == "groupnorm":
        w, b = parameter(320), parameter(320)
        return (1, 320, 64, 64), lambda x: F.silu(F.group_norm(x, 32, w, b))
    if name == "attention":
        def attention(x):
            h = x.view(1, 4096, 8, 40).transpose(1, 2)
            return F.scaled_dot_product_attention(h, h, h).transpose(1, 2).reshape(x.shape)
        return (1, 4096, 320), attention
    from diffusers import UNet2DConditionModel  # The layers need torch alone.

    unet = UNet2DConditionModel(
        in_channels=4, block_out_channels=(64, 128, 128), cross_attention_dim=64, attention_head_dim=8,
        down_block_types=("CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"))
    unet.requires_grad_(train)
    context = torch.randn(8, 16, 64)
    return (8, 4, 32, 32), lambda x: unet(x, 500, context).sample


PROCESSOR = os.environ.get("PROCESSOR") == "1"
clock = time.process_time if PROCESSOR else time.perf_counter


def best_of(layer, x, mode, repetitions):
    best = float("inf")
    with torch.no_grad():
        gradient = torch.randn_like(layer(x))
    for _ in range(repetitions + 1):
        start = clock()
        if mode == "forward":
            with torch.no_grad():
                layer(x)
        else:
            x.grad = None
            layer(x.requires_grad_()).backward(gradient)
        best = min(best, 1e3 * (clock() - start))
    return best


def ours_of(program, name, mode, repetitions):
    environment = dict(os.environ)
    if PROCESSOR:
        environment |= dict(RAYON_NUM_THREADS="1", CANDLE_NUM_THREADS="1")
    out = subprocess.run([program, name, mode, str(repetitions)], capture_output=True, text=True, check=True, env=environment)
    wall, processor = map(float, out.stdout.split()[2:])
    return processor if PROCESSOR else wall


def main():
    if PROCESSOR:
        torch.set_num_threads(1)
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads")
    names = sys.argv[2:] or CASES
    for name in names:
        for mode in ["forward", "frozen", "train"]:
            if name == "attention" and mode == "train" or name == "unet" and mode == "frozen":
                continue
            shape, layer = case(name, mode == "train")
            x = torch.randn(shape)
            repetitions = 3 if name in ("unet", "conv1280") else 8
            ours = theirs = float("inf")
            for _ in range(TURNS):
                ours = min(ours, ours_of(sys.argv[1], name, mode, repetitions))
                theirs = min(theirs, best_of(layer, x, mode, repetitions))
            print(f"{name:10} {mode:8} here {ours:9.2f} ms   torch {theirs:9.2f} ms   ratio {ours / theirs:.2f}", flush=True)


if __name__ == "__main__":
    main()
