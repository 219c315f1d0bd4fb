"""The numbers of lpips.rs: the package of the paper's authors with weights that are a formula.

    pip install torch torchvision lpips pillow numpy && python lib/evaluation/tests/reference_lpips.py
"""
import pathlib

import lpips
import numpy as np
import torch
from PIL import Image

LAYERS = ["net.slice1.0", "net.slice2.3", "net.slice3.6", "net.slice4.8", "net.slice5.10"]


def noise(count, seed):
    """Numbers in [-0.5, 0.5), the same in any language."""
    i = np.arange(count, dtype=np.uint64) + np.uint64(seed * 1_000_003)
    h = (i * np.uint64(2_654_435_761)) & np.uint64(0xFFFFFFFF)
    h = (h ^ (h >> np.uint64(15))) * np.uint64(2_246_822_519) & np.uint64(0xFFFFFFFF)
    h ^= h >> np.uint64(13)
    return torch.from_numpy((h.astype(np.float64) / 2**32 - 0.5).astype(np.float32))


network = lpips.LPIPS(pretrained=False, pnet_rand=True, net="alex", verbose=False)
state = network.state_dict()
for k, name in enumerate(LAYERS):
    weight, bias, linear = f"{name}.weight", f"{name}.bias", f"lin{k}.model.1.weight"
    fan_in = state[weight][0].numel()
    gain = np.float32(np.sqrt(24.0 / fan_in))
    state[weight] = noise(state[weight].numel(), 3 * k).reshape(state[weight].shape) * gain
    state[bias] = noise(state[bias].numel(), 3 * k + 1) * np.float32(0.2)
    state[linear] = (noise(state[linear].numel(), 3 * k + 2) + 0.5).reshape(state[linear].shape)
    state[linear.replace("lin", "lins.", 1)] = state[linear]
network.load_state_dict(state)
network.eval()

folder = pathlib.Path(__file__).parents[2] / "imaging/tests/pictures"
a, b = (
    torch.from_numpy(np.asarray(Image.open(folder / f"{name}.png").convert("RGB"), dtype=np.float32) / 255.0)
    .permute(2, 0, 1)[None]
    for name in ("changed", "reference")
)
with torch.no_grad():
    print("changed, reference", repr(float(network(a, b, normalize=True))))
    print("reference, its mirror image", repr(float(network(b, b.flip(3), normalize=True))))
