"""Writes the models of docs/gallery.md beside this file: python3 docs/gallery/models.py"""
import json
import math
import struct
from pathlib import Path

HERE = Path(__file__).parent
CAR = HERE.parent.parent / "data/demo/car.glb"


def grid(point, columns, rows):
    """Positions and triangles of a surface point(u, v) over [0, 1]^2; seams are closed by equal positions."""
    points = [point(i / columns, j / rows) for j in range(rows + 1) for i in range(columns + 1)]
    triangles = []
    for j in range(rows):
        for i in range(columns):
            a = j * (columns + 1) + i
            b, c, d = a + 1, a + columns + 1, a + columns + 2
            triangles += [(a, b, d), (a, d, c)]
    return points, triangles


def normals(point, columns, rows, step=1e-4):
    """Normals of the same grid by central differences."""
    out = []
    for j in range(rows + 1):
        for i in range(columns + 1):
            u, v = i / columns, min(max(j / rows, 2 * step), 1 - 2 * step)
            du = [b - a for a, b in zip(point(u - step, v), point(u + step, v))]
            dv = [b - a for a, b in zip(point(u, v - step), point(u, v + step))]
            n = [du[1] * dv[2] - du[2] * dv[1], du[2] * dv[0] - du[0] * dv[2], du[0] * dv[1] - du[1] * dv[0]]
            length = math.sqrt(sum(x * x for x in n)) or 1.0
            out.append(tuple(x / length for x in n))
    return out


def knot(u, v, p=2, q=3, radius=0.62, tube=0.19, height=2.02):
    """A torus knot that stands upright; the tube follows a frame that does not twist at the seam."""
    t, s = 2 * math.pi * u, 2 * math.pi * v

    def centre(t):
        r = radius * (1 + 0.5 * math.cos(q * t))
        return r * math.cos(p * t), height + r * math.sin(p * t), 0.5 * radius * math.sin(q * t)

    a, b = centre(t - 1e-3), centre(t + 1e-3)
    along = [y - x for x, y in zip(a, b)]
    length = math.sqrt(sum(x * x for x in along))
    along = [x / length for x in along]
    c = centre(t)
    # The axis of the torus, made perpendicular to the tube.
    dot = along[2]
    side = [-dot * along[0], -dot * along[1], 1 - dot * along[2]]
    length = math.sqrt(sum(x * x for x in side))
    side = [x / length for x in side]
    other = [along[1] * side[2] - along[2] * side[1], along[2] * side[0] - along[0] * side[2],
             along[0] * side[1] - along[1] * side[0]]
    return tuple(c[k] + tube * (math.cos(s) * side[k] + math.sin(s) * other[k]) for k in range(3))


def sphere(x, z, radius):
    def point(u, v):
        a, b = 2 * math.pi * u, math.pi * v
        return (x + radius * math.sin(b) * math.cos(a), radius - radius * math.cos(b), z - radius * math.sin(b) * math.sin(a))
    return point


def plinth(u, v, side=0.62, height=0.95, rounding=0.035):
    """A square block with rounded edges: a superellipse that is swept upwards and closed."""
    a = 2 * math.pi * u
    c, s = math.cos(a), math.sin(a)
    square = [math.copysign(abs(c) ** 0.12, c), math.copysign(abs(s) ** 0.12, s)]
    # Outwards along the bottom, up the side, inwards over the top.
    if v < 0.1:
        share, y = v / 0.1 * 0.96, 0.0
    elif v < 0.9:
        w = (v - 0.1) / 0.8
        lift = min(w, 1 - w) / 0.1
        share, y = 1 - 0.04 * max(0.0, 1 - lift) ** 2, w * height
    else:
        share, y = (1 - v) / 0.1 * 0.96, height
    return side * share * square[0], y, -side * share * square[1]


def write_glb(name, parts):
    """One node; parts are (point, columns, rows, material)."""
    blob, views, accessors, primitives, materials = b"", [], [], [], []
    for point, columns, rows, material in parts:
        positions, triangles = grid(point, columns, rows)
        normal = normals(point, columns, rows)
        low, high = ([f(p[k] for p in positions) for k in range(3)] for f in (min, max))
        data = [b"".join(struct.pack("<3f", *p) for p in positions), b"".join(struct.pack("<3f", *n) for n in normal),
                b"".join(struct.pack("<3I", *t) for t in triangles)]
        at = len(accessors)
        for kind, bytes_ in enumerate(data):
            views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(bytes_)})
            blob += bytes_
            accessors.append({"bufferView": at + kind, "componentType": 5125 if kind == 2 else 5126,
                              "count": 3 * len(triangles) if kind == 2 else len(positions),
                              "type": "SCALAR" if kind == 2 else "VEC3"})
        accessors[at].update({"min": low, "max": high})
        primitives.append({"attributes": {"POSITION": at, "NORMAL": at + 1}, "indices": at + 2, "material": len(materials)})
        materials.append(material)
    document = {
        "asset": {"version": "2.0", "generator": "docs/gallery/models.py"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": primitives}], "materials": materials,
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(blob)}]}
    # glTF allows no empty list.
    if used := sorted({e for m in materials for e in m["extensions"]}):
        document["extensionsUsed"] = used
    write(name, document, blob)


def write(name, document, blob):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    size = 12 + 8 + len(text) + 8 + len(blob)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    (HERE / name).write_bytes(struct.pack("<4sII", b"glTF", 2, size) + chunks)


def material(name, colour, metallic, roughness, extensions=None):
    return {"name": name, "extensions": extensions or {}, "doubleSided": True, "pbrMetallicRoughness": {
        "baseColorFactor": [*colour, 1.0], "metallicFactor": metallic, "roughnessFactor": roughness}}


def blue_car():
    """The demo's car with another paint."""
    data = CAR.read_bytes()
    length, = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20:20 + length])
    for m in document["materials"]:
        if m["name"] == "paint":
            m["pbrMetallicRoughness"]["baseColorFactor"] = [0.02, 0.07, 0.19, 1.0]
    start = 20 + length
    size, = struct.unpack_from("<I", data, start)
    write("blue_car.glb", document, data[start + 8:start + 8 + size])


brass = material("brass", [0.89, 0.66, 0.32], 1.0, 0.22)
granite = material("granite", [0.23, 0.22, 0.21], 0.0, 0.55)
chrome = material("chrome", [0.78, 0.79, 0.8], 1.0, 0.04)
clay = material("clay", [0.52, 0.2, 0.11], 0.0, 0.8)
glaze = material("glaze", [0.04, 0.2, 0.22], 0.0, 0.5,
                 {"KHR_materials_clearcoat": {"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 0.05}})
write_glb("knot.glb", [(plinth, 240, 60, granite), (knot, 480, 48, brass)])
write_glb("spheres.glb", [(sphere(-1.5, 0.0, 0.75), 192, 96, chrome), (sphere(0.35, 0.75, 0.42), 160, 80, glaze),
                          (sphere(1.55, -0.35, 0.62), 160, 80, clay)])
blue_car()
