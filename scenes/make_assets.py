"""Makes every file of ``scenes/assets``: meshes, textures, the labels of the chart and the light probes.

    python scenes/make_assets.py [--suzi package/models/suzi.glb.js] [--probes DIR]

The meshes of revolution, the knot, the cloth and all textures are computed here and need no input. Two things
come from outside; each is left as it is when its option is not given:

``--suzi``    ``models/suzi.glb.js`` of npm's ``@pmndrs/assets`` 1.7.0 (``npm pack @pmndrs/assets``; CC0). The
              mesh in it is Draco-compressed: needs ``pip install DracoPy``.
``--probes``  a folder with ``interior.exr`` and ``forest.exr``, 1024x512, of Debian's ``blender-data`` (CC0,
              Greg Zaal, HDRI Haven; there in ``datafiles/studiolights/world``). Needs Mitsuba and
              ``pip install OpenEXR``.

The same inputs and the same versions of NumPy, SciPy, Pillow and Matplotlib (its font) give the same bytes.
"""

import argparse
import base64
import json
import re
import struct
from pathlib import Path

import numpy as np
from make_materials import FLOOR, LABELS
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

ASSETS = Path(__file__).with_name("assets")
PROBE_LIMIT = 200.0  # radiance above which a probe is cut: some pixels of bare lamps, all noise

# profiles: (radius, height), from the centre of the bottom, up the outside, over the rim and down the inside
VASE = [
    (0, 0.012), (0.24, 0.012), (0.27, 0), (0.29, 0.012), (0.29, 0.05), (0.40, 0.28), (0.50, 0.62),
    (0.47, 0.92), (0.30, 1.20), (0.175, 1.40), (0.165, 1.52), (0.23, 1.68), (0.30, 1.745),
    (0.305, 1.76), (0.285, 1.765), (0.21, 1.69), (0.14, 1.52), (0.15, 1.38), (0.27, 1.17),
    (0.40, 0.92), (0.42, 0.6), (0.25, 0.1), (0, 0.08),
]  # fmt: skip
BOWL = [
    (0, 0.012), (0.22, 0.012), (0.25, 0), (0.27, 0.012), (0.29, 0.04), (0.47, 0.14), (0.62, 0.30),
    (0.70, 0.47), (0.715, 0.505), (0.705, 0.515), (0.69, 0.505), (0.675, 0.47), (0.595, 0.315),
    (0.45, 0.17), (0.25, 0.075), (0, 0.05),
]  # fmt: skip
JAR = [
    (0, 0), (0.38, 0), (0.408, 0.006), (0.42, 0.03), (0.42, 0.30), (0.42, 0.575), (0.41, 0.598),
    (0.392, 0.606), (0.392, 0.616), (0.412, 0.622), (0.424, 0.645), (0.412, 0.68), (0.30, 0.74),
    (0.16, 0.772), (0.065, 0.785), (0.045, 0.805), (0.05, 0.835), (0.085, 0.875), (0.09, 0.915),
    (0.062, 0.95), (0, 0.962),
]  # fmt: skip
PEAR = [
    (0, 0.03), (0.07, 0.006), (0.16, 0.012), (0.29, 0.09), (0.355, 0.24), (0.345, 0.40),
    (0.27, 0.57), (0.185, 0.72), (0.145, 0.84), (0.115, 0.93), (0.06, 0.975), (0.02, 0.965),
    (0, 0.945),
]  # fmt: skip

# --- meshes -----------------------------------------------------------------------------------------------


def write_ply(name, position, normal, uv, faces):
    """Write a binary PLY: (n, 3) positions and unit normals, (n, 2) uv, (m, 3) counter-clockwise faces."""
    fields = ["x", "y", "z", "nx", "ny", "nz", "u", "v"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(position)}"]
    header += [f"property float {f}" for f in fields]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    vertices = np.hstack([position, normal, uv]).astype("<f4")
    packed = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    packed["n"], packed["i"] = 3, faces
    (ASSETS / name).write_bytes("\n".join(header).encode() + vertices.tobytes() + packed.tobytes())


def grid_faces(rows, columns):
    """Two triangles for each cell of a grid of rows x columns vertices."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    return np.vstack([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def grid_normals(position):
    """Return unit normals of a (rows, columns, 3) grid, matching the winding of `grid_faces`."""
    du = np.gradient(position, axis=1)
    dv = np.gradient(position, axis=0)
    n = np.cross(dv, du)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def drop_degenerate(position, faces):
    """Faces without those of zero area (at the poles of a surface of revolution)."""
    p = position[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    return faces[area > 1e-10]


def revolve(name, profile, segments=64, samples=64, swap=False):
    """Surface of revolution about y of a profile of (radius, height) points, from the bottom centre up.

    The profile becomes a monotone cubic curve, read at equal steps of arc length; u runs around, v along it,
    or the other way round with `swap`.
    """
    profile = np.array(profile)
    knots = np.r_[0, np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))]
    curve = PchipInterpolator(knots, profile)
    dense = np.linspace(0, knots[-1], 4000)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(curve(dense), axis=0), axis=1))]
    v = np.linspace(0, 1, samples)
    at = np.interp(v * length[-1], length, dense)
    (r, y), (dr, dy) = curve(at).T, curve.derivative()(at).T
    scale = np.hypot(dr, dy)
    u = np.linspace(0, 1, segments + 1)
    cos, sin = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)
    r = np.maximum(r, 0)[:, None]
    full = np.ones_like(u)
    position = np.stack([r * cos, y[:, None] * full, r * sin], -1).reshape(-1, 3)
    nr, ny = (dy / scale)[:, None], (-dr / scale)[:, None]
    normal = np.stack([nr * cos, ny * full, nr * sin], -1).reshape(-1, 3)
    uv = np.stack(np.meshgrid(u, v)[:: -1 if swap else 1], -1).reshape(-1, 2)
    faces = drop_degenerate(position, grid_faces(samples, segments + 1))
    write_ply(name, position, normal, uv, faces)


def knot(name, p=2, q=3, tube=0.17, segments=180, sides=20):
    """Return a (p, q) torus knot that lies on the floor y = 0; u runs around the tube, v along it."""
    t = np.linspace(0, 2 * np.pi, segments + 1)
    r = 0.5 * (1 + 0.5 * np.cos(q * t))
    centre = np.stack([r * np.cos(p * t), 0.3 * np.sin(q * t), r * np.sin(p * t)], -1)
    dr = -0.25 * q * np.sin(q * t)
    tangent = np.stack(
        [
            dr * np.cos(p * t) - r * p * np.sin(p * t),
            0.3 * q * np.cos(q * t),
            dr * np.sin(p * t) + r * p * np.cos(p * t),
        ],
        -1,
    )
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # a frame that closes: the direction away from the torus' core circle, made orthogonal to the tangent
    core = 0.5 * np.stack([np.cos(p * t), 0 * t, np.sin(p * t)], -1)
    e1 = centre - core
    e1 -= (e1 * tangent).sum(1, keepdims=True) * tangent
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(tangent, e1)
    phi = np.linspace(0, 2 * np.pi, sides + 1)
    normal = e1[:, None] * np.cos(phi)[:, None] + e2[:, None] * np.sin(phi)[:, None]
    position = centre[:, None] + tube * normal
    position[..., 1] -= position[..., 1].min()
    uv = np.stack(np.meshgrid(phi / (2 * np.pi), t / (2 * np.pi)), -1)
    faces = grid_faces(segments + 1, sides + 1)[:, ::-1]
    write_ply(name, position.reshape(-1, 3), normal.reshape(-1, 3), uv.reshape(-1, 2), faces)


def cloth(name, half=0.8, radius=0.42, height=0.38, n=88):
    """Return a square cloth draped over a round stand, an open surface; its corners lie on y = 0."""
    g = np.linspace(-half, half, n)
    x, z = np.meshgrid(g, g)
    s, theta = np.hypot(x, z), np.arctan2(z, x)
    # profile by arc length: flat top, round edge, fall, round turn, floor
    bend = 0.07
    arc = np.pi / 2 * bend
    flat, fall = radius - bend, height - 2 * bend
    a = np.clip((s - flat) / bend, 0, np.pi / 2)
    down = np.clip(s - flat - arc, 0, fall)
    b = np.clip((s - flat - arc - fall) / bend, 0, np.pi / 2)
    out = np.clip(s - flat - 2 * arc - fall, 0, None)
    r = np.minimum(s, flat) + bend * np.sin(a) + 0.12 * down + bend * (1 - np.cos(b)) + out
    y = height - bend * (1 - np.cos(a)) - down - bend * np.sin(b)
    # folds grow with the length that hangs, and die out again where the cloth lies
    hang = np.clip((s - flat) / (arc + fall), 0, None)
    grow = np.clip(hang, 0, 1.25) ** 1.6 * np.exp(-1.2 * np.clip(hang - 1.25, 0, None))
    wave = np.cos(9 * theta + 0.8 * np.sin(2 * theta + 0.4)) + 0.35 * np.cos(14 * theta + 1.1)
    r = r + 0.062 * grow * wave
    lift = np.clip(hang - 1, 0, None)
    y = y + 0.022 * np.minimum(lift * 2, 1) * (1 + np.cos(9 * theta + 0.8 * np.sin(2 * theta + 0.4)))
    position = np.stack([r * np.cos(theta), y + 0.006, r * np.sin(theta)], -1)
    uv = np.stack([x, z], -1) / (2 * half) + 0.5
    faces = grid_faces(n, n)
    write_ply(name, position.reshape(-1, 3), grid_normals(position).reshape(-1, 3), uv.reshape(-1, 2), faces)


def suzanne(name, source):
    """Suzanne out of the .glb.js of @pmndrs/assets, her lowest point on y = 0, with uv around the y axis."""
    import DracoPy

    glb = base64.b64decode(re.search(r"base64,([A-Za-z0-9+/=]+)", Path(source).read_text()).group(1))
    json_size = struct.unpack_from("<I", glb, 12)[0]
    view = json.loads(glb[20 : 20 + json_size])["bufferViews"][0]
    start = 20 + json_size + 8 + view.get("byteOffset", 0)
    mesh = DracoPy.decode(glb[start : start + view["byteLength"]])
    position = np.array(mesh.points, dtype=np.float64)
    normal = np.array(mesh.normals, dtype=np.float64)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = position / np.linalg.norm(position, axis=1, keepdims=True)
    u = np.arctan2(direction[:, 0], direction[:, 2]) / (2 * np.pi) + 0.5
    v = np.arcsin(np.clip(direction[:, 1], -1, 1)) / np.pi + 0.5
    position[:, 1] -= position[:, 1].min()
    write_ply(name, position, normal, np.stack([u, v], 1), np.array(mesh.faces))


# --- textures ---------------------------------------------------------------------------------------------


def noise(rng, shape, scale_y, scale_x, octaves=1):
    """Periodic Gaussian noise, zero mean and unit variance; its features have scale_y x scale_x pixels."""
    total = np.zeros(shape)
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.fftfreq(shape[1])[None, :]
    for octave in range(octaves):
        sy, sx = scale_y / 2**octave, scale_x / 2**octave
        low_pass = np.exp(-2 * ((np.pi * fy * sy / 2) ** 2 + (np.pi * fx * sx / 2) ** 2))
        layer = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * low_pass).real
        total += layer / layer.std() / 1.7**octave
    return (total - total.mean()) / total.std()


def save(name, image):
    """Save values in [0, 1] as an 8-bit PNG, (h, w) grey or (h, w, 3) RGB."""
    data = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(data).save(ASSETS / name, optimize=True)


def ramp(t, stops):
    """Colour ramp: t in [0, 1] through equally spaced sRGB colours."""
    stops = np.array(stops) / 255.0
    at = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(t, at, stops[:, c]) for c in range(3)], -1)


def wood(size=512, planks=4):
    """Planks along u: colour (sRGB) and roughness. Periodic."""
    rng = np.random.default_rng(1)
    width = size // planks
    color, rough = np.empty((size, size, 3)), np.empty((size, size))
    for k in range(planks):
        rows = slice(k * width, (k + 1) * width)
        broad = noise(rng, (size, size), 40, 420)[:width]
        rings = 0.5 + 0.5 * np.sin(2 * np.pi * (np.linspace(0, 2.3, width)[:, None] + 0.75 * broad))
        fibre = noise(rng, (size, size), 1.6, 90)[:width]
        pores = np.clip(noise(rng, (size, size), 1.3, 22)[:width] - 1.5, 0, 1)
        t = 0.50 + 0.20 * (rings - 0.5) + 0.055 * fibre - 0.22 * pores + 0.10 * rng.uniform(-1, 1)
        color[rows] = ramp(np.clip(t, 0, 1), [(58, 34, 20), (112, 71, 42), (156, 108, 68), (190, 146, 102)])
        r = 0.36 - 0.10 * (rings - 0.5) + 0.03 * fibre + 0.25 * pores + 0.05 * rng.uniform(-1, 1)
        seam = np.exp(-(np.minimum(np.arange(width), width - 1 - np.arange(width))[:, None] ** 2) / 1.5)
        joint = (np.arange(size) - rng.integers(size)) % size
        seam = np.maximum(seam, np.exp(-(np.minimum(joint, size - joint)[None, :] ** 2) / 1.2))
        color[rows] *= 1 - 0.75 * seam[..., None]
        rough[rows] = r + 0.4 * seam
    save("wood_color.png", color)
    save("wood_roughness.png", np.clip(rough, 0.15, 0.95))


def vase(size=512):
    """Blue painting on white porcelain, sRGB; u runs around the vase, v (downwards) along its profile."""
    rng = np.random.default_rng(2)
    v, u = np.mgrid[0:size, 0:size] / size
    wobble = 0.0022 * noise(rng, (size, size), 24, 24)
    v = v + wobble
    ink = np.zeros((size, size))

    def paint(mask):
        np.maximum(ink, mask, out=ink)

    def line(distance, width):
        return np.clip(0.5 + (width - np.abs(distance)) * size / 1.5, 0, 1)

    for at, width in [(0.165, 0.003), (0.185, 0.007), (0.365, 0.007), (0.385, 0.003), (0.475, 0.008)]:
        paint(line(v - at, width))
    # scales between the lower lines: overlapping circles
    cells = 16
    cu = (u * cells) % 1 - 0.5
    for radius in (0.50, 0.36, 0.20):
        d = np.hypot(cu, (v - 0.215) * cells) - radius
        paint(line(d / cells, 0.0022) * (v > 0.19))
    # a wave of leaves around the belly
    stem = 0.315 + 0.022 * np.sin(2 * np.pi * 4 * u)
    paint(line(v - stem, 0.0028))
    for k in range(24):
        at = (k + 0.5) / 24
        du = (u - at + 0.5) % 1 - 0.5
        base = 0.315 + 0.022 * np.sin(2 * np.pi * 4 * at)
        side = 1 if k % 2 else -1
        x = du * 2.2
        y = (v - base) * side
        leaf = np.hypot((x - 0.35 * y) / 0.013, (y - 0.017) / 0.015) - 1
        paint(np.clip(0.5 - leaf * 6, 0, 1) * 0.85)
    # neck: vertical petals
    petal = np.abs((u * 20) % 1 - 0.5) * 2
    reach = np.clip((v - 0.39) / 0.075, 0, 1)
    paint(np.clip(0.5 + (np.sqrt(1 - reach) * 0.8 - petal) * 8, 0, 1) * (v > 0.39) * (v < 0.465) * 0.9)
    tone = 0.86 + 0.10 * noise(rng, (size, size), 12, 12)
    ink = np.clip(ink * np.clip(tone, 0, 1), 0, 1)[..., None]
    white = np.array([238, 234, 224]) / 255 + 0.006 * noise(rng, (size, size), 30, 30, 3)[..., None]
    save("vase_color.png", white * (1 - ink) + np.array([24, 52, 128]) / 255 * ink)


def hammered(size=256, dents=90):
    """Return a normal map of hammered metal: the height is the distance to the nearest of many dents. Periodic."""
    rng = np.random.default_rng(3)
    centres = rng.uniform(0, size, (4 * dents, 2))
    keep = []
    for c in centres:  # a loose Poisson-disc choice, so that dents are of like size
        d = [np.hypot(*((c - o + size / 2) % size - size / 2)) for o in keep]
        if len(keep) < dents and (not d or min(d) > 0.72 * size / np.sqrt(dents)):
            keep.append(c)
    tree = cKDTree(np.array(keep), boxsize=size)
    y, x = np.mgrid[0:size, 0:size] + 0.5
    near = tree.query(np.stack([y, x], -1), k=2)[0]
    # spherical dents that meet in soft ridges
    height = 0.5 * (near[..., 0] ** 2)
    soft = 1 / (1 + np.exp(-(near[..., 1] - near[..., 0]) / 1.5))
    height *= soft / np.sqrt(size / 2)
    lp = np.exp(-2 * (np.pi * np.fft.fftfreq(size) * 1.5) ** 2)
    height = np.fft.ifft2(np.fft.fft2(height) * lp[:, None] * lp[None, :]).real
    slope = 0.42
    dx = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) / 2 * slope
    dy = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) / 2 * slope
    normal = np.stack([-dx, -dy, np.ones_like(dx)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    save("hammered_normal.png", normal * 0.5 + 0.5)


def weave(size=256, threads=32):
    """Height of a plain weave, for a bump map: threads over and under one another. Periodic."""
    v, u = np.mgrid[0:size, 0:size] / size * threads
    over = ((np.floor(u) + np.floor(v)) % 2).astype(bool)
    warp = np.abs(np.sin(np.pi * u)) * (0.55 + 0.45 * np.abs(np.sin(np.pi * v)))
    weft = np.abs(np.sin(np.pi * v)) * (0.55 + 0.45 * np.abs(np.sin(np.pi * u)))
    save("weave_height.png", np.where(over, warp, weft))


def labels(size=512):
    """Names of the rows of materials.xml, one in each tenth of the height, dark on the floor's albedo."""
    font = ImageFont.truetype(str(Path(get_data_path(), "fonts/ttf/DejaVuSans.ttf")), 44)
    image = Image.new("L", (size, size), round(255 * FLOOR))
    draw = ImageDraw.Draw(image)
    for i, text in enumerate(LABELS):
        draw.text((2, i * size / len(LABELS) + 34), text, font=font, fill=8, anchor="ls")
    image.save(ASSETS / "labels.png", optimize=True)


# --- light probes -----------------------------------------------------------------------------------------


def probe(name, folder):
    """Convert a 1024x512 probe to 512x256 half-float EXR: 2x2 means, cut at PROBE_LIMIT."""
    import mitsuba as mi
    import OpenEXR

    mi.set_variant("scalar_rgb")
    source = mi.Bitmap(str(Path(folder, name)))
    image = np.array(source.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
    h, w = image.shape[0] // 2, image.shape[1] // 2
    small = np.minimum(image.reshape(h, 2, w, 2, 3).mean((1, 3)), PROBE_LIMIT).astype(np.float16)
    header = {"compression": OpenEXR.DWAB_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": small}).write(str(ASSETS / name))


def main():
    """Parse the command line, and write the assets whose inputs are given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suzi", help="models/suzi.glb.js of npm's @pmndrs/assets")
    parser.add_argument("--probes", help="folder with interior.exr and forest.exr of blender-data")
    args = parser.parse_args()
    ASSETS.mkdir(exist_ok=True)
    revolve("vase.ply", VASE, samples=80)
    revolve("bowl.ply", BOWL, samples=56)
    revolve("jar.ply", JAR, samples=72, swap=True)
    revolve("pear.ply", PEAR, segments=48, samples=44)
    knot("knot.ply")
    cloth("cloth.ply")
    wood()
    vase()
    hammered()
    weave()
    labels()
    if args.suzi:
        suzanne("suzanne.ply", args.suzi)
    if args.probes:
        for name in ("interior.exr", "forest.exr"):
            probe(name, args.probes)


if __name__ == "__main__":
    main()
