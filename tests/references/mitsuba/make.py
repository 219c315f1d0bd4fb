"""Reference pictures made with Mitsuba 3: foreground and shadow ratio of small scenes.

    python3 -m venv venv && venv/bin/pip install mitsuba==3.9.1 numpy
    DRJIT_LIBLLVM_PATH=<libLLVM 16 or later> venv/bin/python make.py

writes, beside this file, `sphere.obj` and `knot.obj` (flat-shaded triangle meshes standing on
the plane y = 0), `sun.exr` and `soft.exr` (piecewise-constant environment maps) and one
layered EXR a case: the mean and the standard error of BATCHES independent renders.

    foreground.R/G/B    premultiplied radiance of the object, at most 4 interactions
    foreground_se.R/G/B its standard error
    A                   coverage of the object
    shadow.R/G/B        irradiance of the plane with the object over irradiance without it
    shadow_se.R/G/B     its standard error

Conventions that differ and what is done about them: Mitsuba's `envmap` interpolates between
texels and puts row i at i / (H - 1), so a map is evaluated as piecewise constant on a grid
UPSAMPLE times finer before it is handed over; metals use `roughconductor` with the Fresnel
term switched off, separable Smith masking and no compensation for multiple scattering.
"""
import os
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

HERE = os.path.dirname(os.path.abspath(__file__))
SIZE = 40
BATCHES = 24
SPP = 256
DEPTH = 4
UPSAMPLE = 16
CAMERA = dict(origin=[2.2, 1.9, 3.4], target=[0.0, 0.45, 0.0], fov=30.0)


def icosphere(levels, radius, center):
    t = (1 + 5**0.5) / 2
    v = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t),
         (0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]
    v = [np.array(p, float) / np.linalg.norm(p) for p in v]
    f = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
         (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
         (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    for _ in range(levels):
        middle, g = {}, []

        def mid(a, b):
            k = (min(a, b), max(a, b))
            if k not in middle:
                p = v[a] + v[b]
                v.append(p / np.linalg.norm(p))
                middle[k] = len(v) - 1
            return middle[k]

        for a, b, c in f:
            ab, bc, ca = mid(a, b), mid(b, c), mid(c, a)
            g += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        f = g
    return np.array(v) * radius + np.array(center), np.array(f)


def knot(sides=10, rings=120, tube=0.14):
    """A trefoil tube: concave, with parts that shadow and light each other."""
    s = np.linspace(0, 2 * np.pi, rings, endpoint=False)

    def curve(s):
        return np.stack([np.sin(s) + 2 * np.sin(2 * s), np.sin(3 * s) * -1.0,
                         np.cos(s) - 2 * np.cos(2 * s)], -1) * 0.25

    c, d = curve(s), curve(s + 1e-4) - curve(s - 1e-4)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    n = np.cross(d, [0.0, 1.0, 0.0])
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    b = np.cross(d, n)
    a = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    v = c[:, None] + tube * (np.cos(a)[None, :, None] * n[:, None] + np.sin(a)[None, :, None] * b[:, None])
    f = []
    for i in range(rings):
        for j in range(sides):
            p, q = i * sides + j, i * sides + (j + 1) % sides
            r, t = ((i + 1) % rings) * sides + j, ((i + 1) % rings) * sides + (j + 1) % sides
            f += [(p, r, q), (q, r, t)]
    v = v.reshape(-1, 3)
    v[:, 1] -= v[:, 1].min()
    f = np.array(f)
    # Outward: the signed volume of a closed, outward-facing mesh is positive.
    volume = np.einsum("ij,ij->", v[f[:, 0]], np.cross(v[f[:, 1]], v[f[:, 2]]))
    return v, f if volume > 0 else f[:, ::-1]


def write_obj(path, v, f):
    with open(path, "w") as out:
        out.writelines("v %.6f %.6f %.6f\n" % tuple(p) for p in v)
        out.writelines("f %d %d %d\n" % tuple(t + 1) for t in f)


def read_obj(path):
    v, f = [], []
    for line in open(path):
        w = line.split()
        (v if w[0] == "v" else f).append([float(x) for x in w[1:]])
    return np.array(v, np.float32), np.array(f, np.int64) - 1


def direction(theta, phi):
    return np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], -1)


def environment(kind):
    """Radiance of each texel, float32."""
    h, w = (64, 128) if kind == "sun" else (16, 32)
    theta = (np.arange(h) + 0.5) / h * np.pi
    phi = (np.arange(w) + 0.5) / w * 2 * np.pi
    d = direction(*np.meshgrid(theta, phi, indexing="ij"))
    up = d[..., 1:2]
    sky = np.where(up > 0, np.array([0.35, 0.55, 0.9]) * (0.6 + 0.4 * up) , np.array([0.22, 0.19, 0.15]))
    if kind == "sun":
        sky[13, 38] = [9.0e3, 8.0e3, 6.5e3]
    else:
        glow = np.exp(4 * (d @ np.array([0.6, 0.7, 0.39]) - 1))[..., None]
        sky = sky + glow * np.array([2.0, 1.6, 1.2])
    return sky.astype(np.float32)


def for_mitsuba(texels):
    """The piecewise-constant map at the points between which `envmap` interpolates."""
    h, w = texels.shape[0], texels.shape[1]
    rows, columns = h * UPSAMPLE + 1, w * UPSAMPLE
    j = ((np.arange(columns) + 0.5) / columns * w).astype(int)
    # Rows that lie on a border between texels take the mean of both sides: the interpolated
    # step is then centred on the border, and no energy moves.
    position = np.arange(rows) / UPSAMPLE
    below = np.minimum(np.floor(position).astype(int), h - 1)
    above = np.maximum(np.ceil(position).astype(int) - 1, 0)
    fine = 0.5 * (texels[below] + texels[above])
    return np.ascontiguousarray(fine[:, j])


def mesh(name, v, f, bsdf):
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    props["face_normals"] = True
    m = mi.Mesh(name, len(v), len(f), props=props)
    p = mi.traverse(m)
    p["vertex_positions"] = np.ravel(v).astype(np.float32)
    p["faces"] = np.ravel(f).astype(np.uint32)
    p.update()
    return m


def scene(shapes, texels, depth):
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth + 1, "rr_depth": 100, "hide_emitters": True},
        "emitter": {"type": "envmap", "bitmap": mi.Bitmap(for_mitsuba(texels))},
        "sensor": {
            "type": "perspective", "fov": CAMERA["fov"], "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at(CAMERA["origin"], CAMERA["target"], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"},
                     "pixel_format": "rgba", "component_format": "float32"},
            "sampler": {"type": "independent", "sample_count": SPP},
        },
        **shapes,
    })


def renders(s, first_seed):
    return np.stack([np.array(mi.render(s, spp=SPP, seed=first_seed + i)) for i in range(BATCHES)])


def mean_and_se(x):
    return x.mean(0), x.std(0, ddof=1) / np.sqrt(len(x))


def write_layers(path, layers):
    names, planes = [], []
    for name, a in layers.items():
        a = a if a.ndim == 3 else a[..., None]
        names += [name] if a.shape[-1] == 1 else [f"{name}.{c}" for c in "RGB"]
        planes.append(a)
    data = np.concatenate(planes, -1).astype(np.float32)
    mi.Bitmap(data, mi.Bitmap.PixelFormat.MultiChannel, channel_names=names).write(path)


def main():
    write_obj(os.path.join(HERE, "sphere.obj"), *icosphere(4, 0.6, [0, 0.6, 0]))
    write_obj(os.path.join(HERE, "knot.obj"), *knot())
    maps = {k: environment(k) for k in ("sun", "soft")}
    for k, texels in maps.items():
        mi.Bitmap(texels).write(os.path.join(HERE, f"{k}.exr"))
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}

    def metal(r):
        return {"type": "roughconductor", "distribution": "ggx", "alpha": r * r, "material": "none"}

    cases = {
        "diffuse_sphere": ("sphere", diffuse), "diffuse_knot": ("knot", diffuse),
        "metal_sphere_01": ("sphere", metal(0.1)), "metal_sphere_03": ("sphere", metal(0.3)),
        "metal_sphere_08": ("sphere", metal(0.8)),
    }
    plane = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}},
             "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(1e4)}
    shadows, seed = {}, 1
    for light, texels in maps.items():
        bare, _ = mean_and_se(renders(scene({"plane": plane}, texels, 1), seed))
        bare = bare[..., :3].mean((0, 1))
        for name, (shape, bsdf) in cases.items():
            v, f = read_obj(os.path.join(HERE, f"{shape}.obj"))
            seed += 1000
            rgba, se = mean_and_se(renders(scene({"o": mesh(shape, v, f, bsdf)}, texels, DEPTH), seed))
            if (light, shape) not in shadows:
                seed += 1000
                black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
                with_object = renders(scene({"o": mesh(shape, v, f, black), "plane": plane}, texels, 1), seed)
                shadows[light, shape] = mean_and_se(with_object[..., :3] / bare)
            shadow, shadow_se = shadows[light, shape]
            write_layers(os.path.join(HERE, f"{name}_{light}.exr"), {
                "foreground": rgba[..., :3], "foreground_se": se[..., :3], "A": rgba[..., 3],
                "shadow": shadow, "shadow_se": shadow_se,
            })
            print(name, light, rgba[..., :3].mean(), shadow.mean(), file=sys.stderr)


if __name__ == "__main__":
    main()
