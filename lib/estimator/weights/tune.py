"""Turns the backbone's last blocks to light: a scale and a bias for each output of the layers of blocks 9 to 14.

usage: dipir-pretrain folds PANORAMAS > folds.tsv
       tune.py PANORAMAS folds.tsv tuned.safetensors [STEPS]        (*.hdr; needs numpy and torch, and a GPU to be quick)

One tuning for each fold, trained on photographs of the places of all others: `tuned.FOLD.block.N.LAYER.scale` and `.bias`
(float32); `left_out` in the metadata names the places that each fold left out. A head of two hidden layers, which is
thrown away, tells from the means of both maps how bright 26 surfaces are; the loss compares display values."""
import json, math, os, re, struct, sys
import numpy as np, torch
from torch import nn
import torch.nn.functional as F

HERE = os.path.dirname(os.path.abspath(__file__))
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
SIDE, BATCH, HEADINGS, FIRST = 192, 128, 64, 9
BLOCKS = [(3, 1), (3, 2), (3, 1), (5, 2), (5, 1), (3, 2), (3, 1), (3, 1), (5, 1), (5, 1), (5, 1), (5, 2), (5, 1), (5, 1), (5, 1)]
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], device=DEVICE)
NORMALS = np.array([[k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1] for k in range(27) if k != 13], np.float64)
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
MIRRORED = [int(np.argmin(((NORMALS - n * [-1, 1, 1]) ** 2).sum(1))) for n in NORMALS]
# How much of each surface a camera sees that looks down a little, and a fifth of the weight for all alike.
SEEN = np.maximum(NORMALS @ (np.array([0, 0.25, 1]) / math.hypot(0.25, 1)), 0)
STRENGTH = torch.tensor(0.8 * SEEN / SEEN.sum() * 26 + 0.2, device=DEVICE, dtype=torch.float32)


def read_hdr(path):
    """Radiance file with runs, as 512 x 1024 x 3."""
    data = open(path, "rb").read()
    at = data.index(b"\n\n") + 2
    end = data.index(b"\n", at)
    size, at = data[at:end].split(), end + 1
    height, width = int(size[1]), int(size[3])
    raw, rgbe = np.frombuffer(data, np.uint8), np.zeros((height, width, 4), np.uint8)
    for y in range(height):
        at += 4
        for c in range(4):
            x = 0
            while x < width:
                n, at = data[at], at + 1
                if n > 128:
                    n -= 128
                    rgbe[y, x : x + n, c], at = data[at], at + 1
                else:
                    rgbe[y, x : x + n, c], at = raw[at : at + n], at + n
                x += n
    exponent = rgbe[..., 3].astype(np.int32)
    rgb = rgbe[..., :3] * np.where(exponent > 0, np.ldexp(1.0, exponent - 136), 0)[..., None]
    if height != 512:
        log = torch.tensor(np.log(np.maximum(rgb, 1e-6))).permute(2, 0, 1)[None]
        rgb = F.interpolate(log, (512, 1024), mode="bilinear")[0].permute(1, 2, 0).exp().numpy()
    return rgb


def irradiance(rgb):
    """Irradiance over pi of the 26 surfaces for each heading: HEADINGS x 26 x 3."""
    size = np.sin((np.arange(512) + 0.5) / 512 * np.pi) * (np.pi / 512) * (2 * np.pi / 1024)
    cells = (rgb * size[:, None, None]).reshape(128, 4, 256, 4, 3).sum((1, 3)).reshape(-1, 3)
    down, around = (np.arange(128) + 0.5) / 128 * np.pi, (np.arange(256) + 0.5) / 256 * 2 * np.pi
    all = np.zeros((HEADINGS, 26, 3), np.float32)
    for h in range(HEADINGS):
        a = around - h / HEADINGS * 2 * np.pi
        d = np.stack([np.outer(np.sin(down), np.sin(a)), np.outer(np.cos(down), np.ones(256)), -np.outer(np.sin(down), np.cos(a))], -1)
        all[h] = (np.maximum(d.reshape(-1, 3) @ NORMALS.T, 0) / np.pi).T @ cells
    return all


def srgb(x):
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp(min=1e-8) ** (1 / 2.4) - 0.055)


def linear(y):
    return torch.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)


class Photographs:
    """Photographs of any camera, drawn as lib/places draws them."""

    def __init__(self, panoramas, lights, seed):
        self.texels, self.lights = panoramas, lights
        self.random = torch.Generator(device=DEVICE).manual_seed(seed)

    def between(self, low, high, *shape):
        return low + (high - low) * torch.rand(BATCH, *shape, generator=self.random, device=DEVICE)

    def spread(self, d):
        return d * sum(self.between(-1, 1) for _ in range(3))

    def take(self, places):
        """Display values, what is known of the camera, mean luminance, and how surfaces of reflectance .3 are to look."""
        place = places[torch.randint(len(places), (BATCH,), generator=self.random, device=DEVICE)]
        pitch, longer, aspect = self.between(-40, 20), torch.tan(torch.deg2rad(self.between(25, 90)) / 2), torch.exp(self.between(-0.45, 0.6))
        half_x, half_y = torch.where(aspect > 1, longer, longer * aspect), torch.where(aspect > 1, longer / aspect, longer)
        roll, heading = self.spread(2.5), torch.randint(HEADINGS, (BATCH,), generator=self.random, device=DEVICE)
        line = (torch.arange(SIDE, device=DEVICE) + 0.5) / SIDE * 2 - 1
        wide = lambda v: v.view(-1, 1, 1)
        x, y = line[None, None, :] * wide(half_x), -line[None, :, None] * wide(half_y)
        x, y = torch.broadcast_tensors(x, y)
        r = 1 / torch.sqrt(x * x + y * y + 1)
        x, y, z = x * r, y * r, -r
        c, s = torch.cos(wide(torch.deg2rad(roll))), torch.sin(wide(torch.deg2rad(roll)))
        x, y = c * x - s * y, s * x + c * y
        c, s = torch.cos(wide(torch.deg2rad(pitch))), torch.sin(wide(torch.deg2rad(pitch)))
        y, z = c * y - s * z, s * y + c * z
        seen = self.looked_up(place, torch.atan2(x, -z) / (2 * math.pi) + wide(heading / HEADINGS), torch.acos(y.clamp(-1, 1)) / math.pi)
        average = (seen * LUMINANCE.view(1, 3, 1, 1)).sum(1).clamp(min=1e-6).log().mean((1, 2)).exp()
        exposure = 0.18 / 0.82 / average * torch.exp2(self.spread(0.5))
        white = torch.stack([self.spread(0.08).exp(), torch.ones_like(exposure), self.spread(0.08).exp()], 1)
        gain = white * exposure[:, None]
        shares = self.between(0, 1, 4) ** 3 + 1e-3
        shares = shares / shares.sum(1, keepdim=True)

        def develop(x):
            y = 0.6 * x
            film = (y * (2.51 * y + 0.03) / (y * (2.43 * y + 0.59) + 0.14)).clamp(max=1)
            curves = [x / (1 + x), 1 - torch.exp(-1.2 * x), x.clamp(max=1), film]
            return sum(c * shares[:, k].view(-1, *[1] * (x.dim() - 1)) for k, c in enumerate(curves))

        noise = 1 + self.between(0, 0.05).view(-1, 1, 1, 1) * 1.73 * self.between(-1, 1, 1, SIDE, SIDE)
        photo = linear(torch.round(srgb(develop(seen * gain.view(BATCH, 3, 1, 1) * noise)) * 255) / 255)
        small = F.interpolate(F.avg_pool2d(photo, 2), size=(SIDE, SIDE), mode="bilinear", align_corners=False)
        photo = torch.where(self.between(0, 1).view(-1, 1, 1, 1) < 0.5, small, photo)
        mean = photo.mean((2, 3))
        reference = mean @ LUMINANCE
        camera = [torch.deg2rad(pitch), half_x.log(), half_y.log(), reference.log(), (mean[:, 0] / mean[:, 2].clamp(min=1e-4)).log()]
        return srgb(photo), torch.stack(camera, 1), reference, develop(0.3 * self.lights[place, heading] * gain[:, None]) / 0.3

    def looked_up(self, place, u, v):
        u, v = torch.remainder(u, 1.0) * 1024 - 0.5, (v * 512 - 0.5).clamp(0, 511)
        left, top = torch.floor(u), torch.floor(v).clamp(max=510)
        a, b = (u - left)[..., None], (v - top)[..., None]
        row, left = (place.view(-1, 1, 1) * 512 + top.long()) * 1024, left.long()
        at = lambda down, right: self.texels[row + 1024 * down + torch.remainder(left + right, 1024)].float()
        above, below = (at(d, 0) * (1 - a) + at(d, 1) * a for d in (0, 1))
        return (above * (1 - b) + below * b).permute(0, 3, 1, 2)


class Layer(nn.Module):
    def __init__(self, file, name, side, step, alone, tuned):
        super().__init__()
        weight, bias = file[name + ".weight"], file[name + ".bias"]
        n = len(bias)
        weight = weight.reshape(side, side, n).permute(2, 0, 1)[:, None] if alone else weight.reshape(side, side, -1, n).permute(3, 2, 0, 1)
        self.register_buffer("weight", weight.contiguous())
        self.bias, self.scale = nn.Parameter(bias, requires_grad=tuned), nn.Parameter(torch.ones(n), requires_grad=tuned)
        self.side, self.step, self.groups = side, step, n if alone else 1

    def forward(self, x):
        def pad(n):
            outside = max((-(-n // self.step) - 1) * self.step + self.side - n, 0)
            return [outside // 2, outside - outside // 2]

        weight = self.weight * self.scale.view(-1, 1, 1, 1)
        x = F.pad(x, pad(x.shape[3]) + pad(x.shape[2])) if self.side > 1 else x
        return F.conv2d(x, weight.to(x.dtype), self.bias.to(x.dtype), self.step, 0, 1, self.groups)


class Network(nn.Module):
    def __init__(self, file):
        super().__init__()
        self.stem, self.blocks = Layer(file, "stem", 3, 2, False, False), nn.ModuleList()
        for n, (side, step) in enumerate(BLOCKS):
            layer = lambda name, *rest: Layer(file, f"block.{n}.{name}", *rest, n >= FIRST)
            expand = layer("expand", 1, 1, False) if n else None
            self.blocks.append(nn.ModuleList([expand, layer("depthwise", side, step, True), layer("project", 1, 1, False)]))
        self.register_buffer("mean", torch.zeros(309))
        self.register_buffer("deviation", torch.ones(309))
        self.head = nn.ModuleList([nn.Linear(309, 96), nn.Linear(96, 96), nn.Linear(96, 78)])
        nn.init.zeros_(self.head[2].weight), nn.init.zeros_(self.head[2].bias)

    def features(self, picture, camera):
        x, kept = ((picture * 255 - 127) / 128).to(memory_format=torch.channels_last), []
        with torch.autocast(DEVICE, torch.bfloat16, enabled=DEVICE == "cuda"):
            x = F.relu6(self.stem(x))
            for n, (expand, depthwise, project) in enumerate(self.blocks):
                y = project(F.relu6(depthwise(F.relu6(expand(x)) if expand is not None else x)))
                x = x + y if x.shape == y.shape else y
                if n in (10, 14):
                    kept.append(x.float().mean((2, 3)))
        return torch.cat([*kept, camera], 1)

    def forward(self, picture, camera):
        x = ((self.features(picture, camera) - self.mean) / self.deviation).clamp(-5, 5)
        x = torch.cat([F.dropout(x[:, :-5], 0.5, self.training), x[:, -5:]], 1)
        h = F.dropout(F.silu(self.head[0](x)), 0.4, self.training)
        h = h + F.dropout(F.silu(self.head[1](h)), 0.4, self.training)
        return self.head[2](h).view(-1, 26, 3).clamp(-6, 6).exp()


def shown(x):
    return (1 - torch.exp(-0.6 * x.clamp(min=1e-6))) ** (1 / 2.2)


def train(file, photographs, places, steps, seed):
    torch.manual_seed(seed)
    network = Network(file).to(DEVICE).to(memory_format=torch.channels_last)
    with torch.no_grad():
        first = torch.cat([network.features(*photographs.take(places)[:2]) for _ in range(8)])
        network.mean.copy_(first.mean(0)), network.deviation.copy_(first.std(0) + 1e-3)
    head = list(network.head.parameters())
    tuned = [p for p in network.blocks.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW([dict(params=head, lr=2e-3, weight_decay=0.3), dict(params=tuned, lr=1e-3, weight_decay=0.0)], betas=(0.9, 0.99))
    rates = [group["lr"] for group in optimizer.param_groups]
    mean = [p.detach().clone() for p in tuned]
    for step in range(steps):
        for group, rate in zip(optimizer.param_groups, rates):
            group["lr"] = rate * min(1, (step + 1) / 50) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        with torch.no_grad():
            picture, camera, reference, truth = photographs.take(places)
        if step % 2:
            picture, truth = picture.flip(3), truth[:, MIRRORED]
        off = shown(network(picture, camera) * reference.view(-1, 1, 1)) - shown(truth)
        loss = 10 * (STRENGTH.view(1, -1, 1) * off.square()).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(tuned + head, 1.0)
        optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(mean, [p.detach() for p in tuned], 1 - min(0.99, (1 + step) / (10 + step)))
        if step % max(1, steps // 10) == 0:
            print(f"  step {step}: loss {loss.item():.4f}", flush=True)
    with torch.no_grad():
        for p, m in zip(tuned, mean):
            p.copy_(m)
    found = {}
    for n in range(FIRST, len(BLOCKS)):
        for name, layer in zip(("expand", "depthwise", "project"), network.blocks[n]):
            found[f"block.{n}.{name}.scale"], found[f"block.{n}.{name}.bias"] = layer.scale, layer.bias
    return {name: value.detach().float().cpu().numpy() for name, value in found.items()}


def read_safetensors(path):
    data = open(path, "rb").read()
    (n,) = struct.unpack("<Q", data[:8])
    kinds = {"F16": np.float16, "F32": np.float32}
    tensor = lambda t: torch.tensor(np.frombuffer(data[8 + n :][slice(*t["data_offsets"])], kinds[t["dtype"]]).reshape(t["shape"]).astype(np.float32))
    return {name: tensor(t) for name, t in json.loads(data[8 : 8 + n]).items() if name != "__metadata__"}


def write_safetensors(path, tensors, metadata):
    header, data = {"__metadata__": metadata}, b""
    for name, t in sorted(tensors.items()):
        header[name] = {"dtype": "F32", "shape": list(t.shape), "data_offsets": [len(data), len(data) + t.nbytes]}
        data += t.tobytes()
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as f:
        f.write(struct.pack("<Q", len(text)) + text + data)


def main():
    folder, table, out = sys.argv[1:4]
    steps = int(sys.argv[4]) if len(sys.argv) > 4 else 1500
    folds = [line.split("\t") for line in open(table).read().splitlines()]
    files = {re.sub(r"_[124]k$", "", f[:-4]): os.path.join(folder, f) for f in sorted(os.listdir(folder)) if f.endswith(".hdr")}
    if missing := [name for name, _ in folds if name not in files]:
        sys.exit(f"{folder} has no .hdr file of {', '.join(missing)}; other formats are not read here: save them as Radiance HDR")
    texels, lights = [], []
    for name, _ in folds:
        rgb = read_hdr(files[name])
        rgb = rgb / np.exp(np.log(np.maximum(rgb @ LUMINANCE.cpu().numpy(), 1e-6)).mean())
        lights.append(irradiance(rgb))
        texels.append(torch.tensor(np.minimum(rgb, 3e4), dtype=torch.float16).reshape(-1, 3))
    photographs = lambda seed: Photographs(torch.cat(texels).to(DEVICE), torch.tensor(np.array(lights), device=DEVICE), seed)
    backbone = read_safetensors(os.path.join(HERE, "../../backbone/weights/lite0.safetensors"))
    tensors, left_out = {}, []
    for fold in range(1 + max(int(f) for _, f in folds)):
        print(f"fold {fold}")
        places = torch.tensor([k for k, (_, f) in enumerate(folds) if int(f) != fold], device=DEVICE)
        found = train(backbone, photographs(11 + fold), places, steps, 11 + fold)
        tensors |= {f"tuned.{fold}.{name}": value for name, value in found.items()}
        left_out.append([name for name, f in folds if int(f) == fold])
    write_safetensors(out, tensors, {"left_out": json.dumps(left_out)})


if __name__ == "__main__":
    main()
