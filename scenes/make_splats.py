"""Write 3D Gaussians on the surfaces of Suzanne and a vase, as a PLY file of "3D Gaussian Splatting".

    python scenes/make_splats.py out/splats.ply
    mi-diffind fit field out/splats.ply -o out/splats.npz

The colours are those of a painted surface under a sky and a sun, with a little gloss (spherical harmonics of degree 1).
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh

ASSETS = Path(__file__).resolve().parent / "assets"

#: File, number of triangles' worth of Gaussians (a share), move along x, and two colours (sRGB).
OBJECTS = (
    ("suzanne", 0.6, (-0.55, 0, 0), ((0.85, 0.42, 0.16), (0.95, 0.80, 0.45))),
    ("vase", 0.4, (0.95, 0, 0.1), ((0.15, 0.32, 0.62), (0.92, 0.92, 0.88))),
)

SUN = np.array([0.45, 0.75, 0.48]) / np.linalg.norm([0.45, 0.75, 0.48])

#: Constants of spherical harmonics of degree 0 and 1.
C0, C1 = 0.28209479177387814, 0.4886025119029199


def gaussians(file: str, count: int, move, colours, rng) -> dict[str, np.ndarray]:
    """Return properties of the PLY file for ``count`` Gaussians on a mesh."""
    mesh = trimesh.load(ASSETS / f"{file}.ply", process=False)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
    points, normals = np.asarray(points), np.asarray(mesh.face_normals[faces])
    tangents = np.cross(normals, rng.normal(size=normals.shape))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    axes = np.stack([tangents, np.cross(normals, tangents), normals], axis=-1)
    quaternions = np.array([trimesh.transformations.quaternion_from_matrix(a) for a in axes])  # w first
    spacing = np.sqrt(mesh.area / count)
    scales = spacing * np.stack([*rng.uniform(0.5, 1.0, (2, count)), np.full(count, 0.1)], axis=1)
    stripes = (0.5 + 0.5 * np.sin(14 * points[:, 1] + 3 * np.sin(5 * points[:, 0])))[:, None] > 0.5
    paint = np.where(stripes, *np.array(colours)) + rng.normal(0, 0.015, (count, 3))
    light = 0.45 + 0.2 * normals[:, 1] + 0.55 * np.maximum(normals @ SUN, 0)
    mirrored = 2 * (normals @ SUN)[:, None] * normals - SUN  # a camera there sees the sun's reflection
    gloss = 0.18 * np.clip(normals @ SUN, 0, 1)[:, None] * mirrored
    shown = np.clip(paint * light[:, None], 0, 1)
    # Directions point from the camera to the Gaussian; the functions of degree 1 are −y, z, −x
    first = np.stack([gloss[:, 1], -gloss[:, 2], gloss[:, 0]], axis=1) / C1
    properties = dict(zip("xyz", (points + move).T, strict=True))
    properties |= {f"f_dc_{i}": (shown[:, i] - 0.5) / C0 for i in range(3)}
    properties |= {f"f_rest_{3 * channel + i}": first[:, i] for channel in range(3) for i in range(3)}
    properties |= {"opacity": rng.uniform(1, 4, count)}
    properties |= {f"scale_{i}": np.log(scales[:, i]) for i in range(3)}
    properties |= {f"rot_{i}": quaternions[:, i] * 1.7 for i in range(4)}  # lengths do not count
    return properties


def strays(count: int, like: dict[str, np.ndarray], rng) -> dict[str, np.ndarray]:
    """Return faint Gaussians far away, as trainings leave them."""
    chosen = {name: values[:count].copy() for name, values in like.items()}
    chosen |= dict(zip("xyz", rng.normal(0, 12, (3, count)), strict=True))
    return chosen | {"opacity": np.full(count, -1.0)}


def main() -> None:
    """Write the file that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", metavar="FILE.ply")
    parser.add_argument("--count", type=int, default=60000, help="number of Gaussians (default: 60000)")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    parts = [gaussians(f, round(s * arguments.count), m, c, rng) for f, s, m, c in OBJECTS]
    parts.append(strays(arguments.count // 300, parts[0], rng))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    rows = np.stack(list(columns.values()), axis=1).astype("<f4")
    header = "".join(f"property float {name}\n" for name in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{header}end_header\n"
    Path(arguments.output).write_bytes(header.encode() + rows.tobytes())


if __name__ == "__main__":
    main()
