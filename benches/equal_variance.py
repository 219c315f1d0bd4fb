"""Foreground and shadow ratio at equal variance: dipir beside Mitsuba 3, in one run.

    python3 -m venv venv && venv/bin/pip install mitsuba==3.9.1 numpy
    DRJIT_LIBLLVM_PATH=<libLLVM 19> venv/bin/python benches/equal_variance.py

Both render the scene of `benches/equal_variance.rs` (a trefoil of 96,000 triangles on a plane,
512 x 512, a sky with a half-degree sun at 6e4) with several seeds, in turn. Monte Carlo variance
falls as one over time, so time x variance is what a renderer costs at any variance; low-discrepancy
samples do better than that, so the sample counts are chosen for similar variance. A further row
has samples where they are needed for an error, as composites do. Values are
clamped to [0, 1] before the variance is taken. Scene loading, BVH building and (for Mitsuba)
kernel compilation are left out of the times. CPU seconds are those of all threads together, in which
other load on the machine hardly shows.
"""
import json
import os
import subprocess
import sys
import tempfile
import time

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
SIZE, FOV, DEPTH = 512, 32.0, 4
POSITION, TARGET = [2.6, 2.0, 3.8], [0.0, 0.6, 0.0]
SEEDS = 6
MATERIALS = sys.argv[1:] or ["diffuse", "metal", "glossy", "glass", "textured"]
SAMPLES = {"dipir": 16, "mitsuba": 64}
ERROR = 0.004 # Of the standard preset.
ROOT = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..")


def dipir(*arguments):
    command = ["cargo", "bench", "-q", "--bench", "equal_variance", "--", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def scenes(folder, material):
    colour = {"type": "rgb", "value": [0.8, 0.5, 0.2]}
    bsdf = {
        "diffuse": {"type": "diffuse", "reflectance": colour},
        "metal": {"type": "roughconductor", "distribution": "ggx", "alpha": 0.09, "material": "none",
                  "specular_reflectance": colour},
        "glossy": {"type": "principled", "base_color": colour, "roughness": 0.3, "eta": 1.5},
        "glass": {"type": "thindielectric", "int_ior": 1.5},
        "textured": {"type": "diffuse", "reflectance": {
            "type": "bitmap", "filename": os.path.join(folder, "squares.png")}},
    }[material]
    base = {
        "type": "scene",
        "emitter": {"type": "envmap", "filename": os.path.join(folder, "sky.exr")},
        "sensor": {
            "type": "perspective", "fov": FOV, "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at(POSITION, TARGET, [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"},
                     "pixel_format": "rgba"},
        },
    }

    def build(depth, bsdf, hide=True, **more):
        mesh = {"type": "obj", "filename": os.path.join(folder, "mesh.obj"), "bsdf": bsdf}
        path = {"type": "path", "max_depth": depth + 1, "rr_depth": 100, "hide_emitters": hide}
        return mi.load_dict({**base, "integrator": path, "object": mesh, **more})

    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(1e4),
             "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}}
    bare = mi.load_dict({**base, "integrator": {"type": "path", "max_depth": 2}, "plane": plane})
    irradiance = np.array(mi.render(bare, spp=64, seed=99))[..., :3].mean((0, 1))
    # Emitters behind thin glass count as hidden, too: there they are shown, and what is beside the object is cut off.
    hide = material != "glass"
    alpha = np.array(mi.render(build(DEPTH, {"type": "diffuse"}), spp=256, seed=98))[..., 3:4]
    return build(DEPTH, bsdf, hide), build(1, black, plane=plane), irradiance, alpha


def mitsuba(folder, material):
    foreground, numerator, irradiance, alpha = scenes(folder, material)
    spp = SAMPLES["mitsuba"]
    films, seconds, cpu = [], [], []
    for seed in range(SEEDS + 1):
        start, cpu_start = time.perf_counter(), time.process_time()
        # Converting to numpy waits for the kernel.
        fg = np.array(mi.render(foreground, spp=spp, seed=2 * seed))
        sh = np.array(mi.render(numerator, spp=spp, seed=2 * seed + 1))[..., :3]
        if seed > 0:  # The first compiles.
            seconds.append(time.perf_counter() - start)
            cpu.append(time.process_time() - cpu_start)
            fg = fg[..., :3].clip(0, 1) * (alpha if material == "glass" else 1)
            films.append((fg, (sh / irradiance).clip(0, 1) * (1 - alpha)))
    variance = [np.var([f[i] for f in films], axis=0, ddof=1).mean() for i in range(2)]
    mean = [np.mean([f[i] for f in films]) for i in range(2)]
    return {"seconds": float(np.median(seconds)), "cpu_seconds": float(np.mean(cpu)),
            "mean_foreground": mean[0], "mean_shadow": mean[1],
            "foreground": variance[0], "shadow": variance[1]}


def main():
    print("| material | renderer | samples | seconds | CPU seconds | mean fg | mean shadow | variance fg "
          "| variance shadow | CPU seconds x variance | Mitsuba / this |")
    print("|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    with tempfile.TemporaryDirectory() as folder:
        dipir("export", folder)
        for material in MATERIALS:
            peer = mitsuba(folder, material)
            render = lambda stop, denoise: json.loads(dipir("render", stop, SEEDS, material, denoise))
            spp, error = SAMPLES["dipir"], f"error={ERROR}"
            rows = [("Mitsuba", SAMPLES["mitsuba"], peer), ("dipir", spp, render(spp, "false")),
                    ("dipir", error, render(error, "false")), ("dipir, denoised", spp, render(spp, "true"))]
            cost = lambda r: r["cpu_seconds"] * (r["foreground"] + r["shadow"])
            for name, spp, r in rows:
                print(f"| {material} | {name} | {spp} | {r['seconds']:.2f} | {r['cpu_seconds']:.2f} "
                      f"| {r['mean_foreground']:.4f} | {r['mean_shadow']:.4f} | {r['foreground']:.2e} "
                      f"| {r['shadow']:.2e} | {cost(r):.2e} | {cost(peer) / cost(r):.1f} |", flush=True)


if __name__ == "__main__":
    main()
