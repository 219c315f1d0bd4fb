"""Foreground and shadow ratio at equal variance: dipir beside Mitsuba 3, in one run.

    python3 -m venv venv && venv/bin/pip install mitsuba==3.9.1 numpy
    DRJIT_LIBLLVM_PATH=<libLLVM 16 or later> venv/bin/python benches/equal_variance.py

Both render the scene of `benches/equal_variance.rs` (a trefoil of 96,000 triangles on a plane,
512 x 512, a sky with a half-degree sun at 6e4) with several seeds, in turn. Monte Carlo variance
falls as one over time, so time x variance is what a renderer costs at any variance; low-discrepancy
samples do better than that, so the sample counts are chosen for similar variance. Values are
clamped to [0, 1] before the variance is taken. Scene loading, BVH building and (for Mitsuba)
kernel compilation are left out of the times. CPU seconds are those of all threads together, in which
other load on the machine hardly shows.
"""
import json
import os
import subprocess
import tempfile
import time

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
SIZE, FOV, DEPTH = 512, 32.0, 4
POSITION, TARGET = [2.6, 2.0, 3.8], [0.0, 0.6, 0.0]
SEEDS = 6
SAMPLES = {"dipir": {"diffuse": 16, "metal": 16}, "mitsuba": {"diffuse": 64, "metal": 64}}
ROOT = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..")


def dipir(*arguments):
    command = ["cargo", "bench", "-q", "--bench", "equal_variance", "--", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def scenes(folder, material):
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}
    if material == "metal":
        bsdf = {"type": "roughconductor", "distribution": "ggx", "alpha": 0.09, "material": "none",
                "specular_reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}
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

    def build(depth, bsdf, **more):
        mesh = {"type": "obj", "filename": os.path.join(folder, "mesh.obj"), "bsdf": bsdf}
        path = {"type": "path", "max_depth": depth + 1, "rr_depth": 100, "hide_emitters": True}
        return mi.load_dict({**base, "integrator": path, "object": mesh, **more})

    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(1e4),
             "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}}
    bare = mi.load_dict({**base, "integrator": {"type": "path", "max_depth": 2}, "plane": plane})
    irradiance = np.array(mi.render(bare, spp=64, seed=99))[..., :3].mean((0, 1))
    return build(DEPTH, bsdf), build(1, black, plane=plane), irradiance


def mitsuba(folder, material):
    foreground, numerator, irradiance = scenes(folder, material)
    spp = SAMPLES["mitsuba"][material]
    films, seconds, cpu = [], [], []
    for seed in range(SEEDS + 1):
        start, cpu_start = time.perf_counter(), time.process_time()
        # Converting to numpy waits for the kernel.
        fg = np.array(mi.render(foreground, spp=spp, seed=2 * seed))
        sh = np.array(mi.render(numerator, spp=spp, seed=2 * seed + 1))[..., :3]
        if seed > 0:  # The first compiles.
            seconds.append(time.perf_counter() - start)
            cpu.append(time.process_time() - cpu_start)
            films.append((fg[..., :3].clip(0, 1), (sh / irradiance).clip(0, 1) * (1 - fg[..., 3:4])))
    variance = [np.var([f[i] for f in films], axis=0, ddof=1).mean() for i in range(2)]
    return {"seconds": float(np.median(seconds)), "cpu_seconds": float(np.mean(cpu)),
            "foreground": variance[0], "shadow": variance[1]}


def main():
    print("| material | renderer | samples | seconds | CPU seconds | variance fg | variance shadow "
          "| CPU seconds x variance |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        dipir("export", folder)
        for material in ("diffuse", "metal"):
            cost, seconds = {}, {}
            for name in ("dipir", "mitsuba"):
                spp = SAMPLES[name][material]
                r = (json.loads(dipir("render", spp, SEEDS, material)) if name == "dipir"
                     else mitsuba(folder, material))
                cost[name] = r["cpu_seconds"] * (r["foreground"] + r["shadow"])
                seconds[name] = r["cpu_seconds"]
                print(f"| {material} | {name} | {spp} | {r['seconds']:.3f} | {r['cpu_seconds']:.3f} "
                      f"| {r['foreground']:.2e} | {r['shadow']:.2e} | {cost[name]:.2e} |")
            print(f"| {material} | Mitsuba / dipir | | | {seconds['mitsuba'] / seconds['dipir']:.2f} | | "
                  f"| {cost['mitsuba'] / cost['dipir']:.2f} |")


if __name__ == "__main__":
    main()
