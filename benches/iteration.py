"""One iteration of light optimisation, forward and adjoint: recorded transport beside Mitsuba 3's prb.

    python3 -m venv venv && venv/bin/pip install mitsuba==3.9.1 numpy
    DRJIT_LIBLLVM_PATH=<libLLVM 16 or later> venv/bin/python benches/iteration.py

Both work on the scene of `lib/render/benches/transport.rs`, diffuse: a trefoil of 32,768 triangles on a
plane, 384 x 256 pixels, a map of 128 x 64 texels with a sun of 2 degrees. An iteration is the
foreground and the shadow ratio, and the gradient of one loss over both with respect to every
texel. Mitsuba traces 128 samples a pixel anew each time; ours replays what was recorded once. The
gradient's noise is half the squared difference of two seeds, relative to the gradient, for texels
and for sums over 16 x 8 regions. Compilation of Mitsuba's kernels is left out.
"""
import json
import os
import subprocess
import sys
import tempfile
import time

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
WIDTH, HEIGHT, SPP, DEPTH = 384, 256, 128, 3
ROOT = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..")


def dipir(*arguments):
    command = ["cargo", "bench", "-q", "-p", "dipir-render", "--bench", "transport", "--"]
    if len(sys.argv) > 1:  # An executable that is built already.
        command = [sys.argv[1]]
    command += map(str, arguments)
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def scenes(folder):
    base = {
        "type": "scene",
        "emitter": {"type": "envmap", "filename": os.path.join(folder, "light.exr")},
        "sensor": {
            "type": "perspective", "fov": float(np.degrees(0.7)), "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at([0, 2, 4], [0, 0.5, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"},
                     "pixel_format": "rgba"},
        },
    }

    def build(depth, colour, **more):
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
        mesh = {"type": "obj", "filename": os.path.join(folder, "mesh.obj"), "bsdf": bsdf}
        path = {"type": "prb", "max_depth": depth + 1, "rr_depth": 100, "hide_emitters": True}
        return mi.load_dict({**base, "integrator": path, "object": mesh, **more})

    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(1e4),
             "bsdf": white}
    return build(DEPTH, [0.8, 0.4, 0.2]), build(1, [0.0, 0.0, 0.0], plane=plane)


def iteration(scene, pattern, scale, seed):
    params = mi.traverse(scene)
    data = dr.detach(params["emitter.data"])
    dr.enable_grad(data)
    dr.set_grad(data, 0.0)
    params["emitter.data"] = data
    params.update()
    image = mi.render(scene, params, spp=SPP, seed=seed)
    weights = mi.TensorXf(pattern * scale)
    dr.backward(dr.sum(image[..., :3] * weights, axis=None))
    # Mitsuba repeats columns at both sides of the seam.
    return np.array(image)[..., :3], np.array(dr.grad(data))[:, 1:129, :3]


def on_plane(light):
    """Radiance of the bare white plane, and its derivative by texel: the closed-form denominator."""
    edges = np.cos(np.pi * np.arange(65) / 64)
    # Integral of cosine times solid angle over a row, for the upper hemisphere.
    rows = 0.5 * (edges[:-1] ** 2 - edges[1:] ** 2) * (2 * np.pi / 128)
    rows[32:] = 0.0
    weight = (rows / np.pi)[:, None, None]
    return (light * weight).sum((0, 1)), weight


def mitsuba(folder):
    foreground, numerator = scenes(folder)
    p = np.arange(WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH, 1)
    wave = np.concatenate([np.sin(p * 0.017 * k) for k in (1.0, 1.3, 0.7)], -1) + 0.5
    light = np.array(mi.Bitmap(os.path.join(folder, "light.exr")))[..., :3]
    bare, weight = on_plane(light)
    gradients, seconds = [], []
    for seed in range(4):
        start = time.perf_counter()
        _, g = iteration(foreground, wave, 1.0, 2 * seed)
        numerator_image, on_numerator = iteration(numerator, wave, 1.0 / bare, 2 * seed + 1)
        through_denominator = (wave * numerator_image).sum((0, 1)) / bare**2 * weight
        g = g + on_numerator - through_denominator
        if seed > 0:  # The first compiles.
            seconds.append(time.perf_counter() - start)
            gradients.append(g)
    return float(np.median(seconds)), gradients


def noise(a, b):
    return np.sqrt(((a - b) ** 2).sum() / (a**2).sum() / 2)


def regions(g):
    return g.reshape(8, 8, 16, 8, 3).sum((1, 3))


def main():
    with tempfile.TemporaryDirectory() as folder:
        dipir("export", folder)
        ours = {s: json.loads(dipir("iteration", s)) for s in (54, 128, 256)}
        seconds, g = mitsuba(folder)
        again = {s: json.loads(dipir("iteration", s)) for s in ours}
    print("| | samples | one iteration, ms | 600 iterations and the record, s | noise per texel | per region |")
    print("|---|---|---|---|---|---|")
    print(f"| Mitsuba prb | {SPP} | {1e3 * seconds:.0f} | {600 * seconds:.0f} | {noise(g[0], g[1]):.1%} "
          f"| {noise(regions(g[0]), regions(g[1])):.1%} |")
    for s, first in ours.items():
        ms = min(first["iteration_ms"], again[s]["iteration_ms"])
        record = min(first["record_s"], again[s]["record_s"])
        total = 0.6 * ms + record
        print(f"| recorded ({first['bytes'] / 1e6:.1f} MB, recorded in {record:.1f} s) | {s} "
              f"| {ms:.2f} ({1e3 * seconds / ms:.0f}x) | {total:.1f} ({600 * seconds / total:.0f}x) "
              f"| {first['texel_noise']:.1%} | {first['region_noise']:.1%} |")


if __name__ == "__main__":
    main()
