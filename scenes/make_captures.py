"""Write capture_group.xml, capture_thin.xml and capture_glossy.xml, and the meshes ``cage.ply`` and ``leaves.ply``.

``mi-diffind capture`` renders views of these scenes for radiance fields: objects in the light of a probe, with nothing
below or behind them. See README.md.
"""

from pathlib import Path

import numpy as np
from make_assets import drop_degenerate, grid_faces, write_ply
from scene_xml import environment, head, mesh, place, plugin, principled, turn, write

FOLDER = Path(__file__).resolve().parent

ABOUT = """{what}, in the light of {light}: to be captured from all sides
(mi-diffind capture), so that there is nothing below or behind. Written by make_captures.py: change that file."""

CAMERA = (2.6, 2.6, 5.6), (0, 0.85, 0)


def bitmap(name: str, file: str):
    """Return a texture."""
    return plugin("texture", "bitmap", name=name, filename=f"assets/{file}")


# -- meshes of the thin scene ------------------------------------------------------------------------------------------


def tube(points: np.ndarray, radius: float, sides: int = 6) -> tuple:
    """Positions, normals and triangles of a tube around a line through ``points`` ``(n, 3)``, open at its ends."""
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.eye(3)[np.argmin(np.abs(along).max(axis=0))]
    u = np.cross(along, side)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(along, u)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[None, :, None]
    normal = np.cos(angle) * u[:, None] + np.sin(angle) * v[:, None]
    position = points[:, None] + radius * normal
    return position.reshape(-1, 3), normal.reshape(-1, 3), grid_faces(len(points), sides + 1)


def joined(parts: list[tuple]) -> tuple:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(p) for p, _, _ in parts)])
    positions, normals = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    return positions, normals, np.concatenate([f + s for (_, _, f), s in zip(parts, starts, strict=False)])


def cage(name: str, radius: float = 0.95, wire: float = 0.014) -> None:
    """Return a globe of wires, on y = 0: meridians and circles of latitude, and a ring on top."""
    t = np.linspace(0, 2 * np.pi, 65)
    lines = []
    for k in range(8):
        a = np.pi * k / 8
        flat = np.sin(t)
        lines.append(np.stack([flat * np.cos(a), np.cos(t), flat * np.sin(a)], axis=1))
    for height in (-0.6, 0.0, 0.6):
        r = np.sqrt(1 - height**2)
        lines.append(np.stack([r * np.cos(t), height + 0 * t, r * np.sin(t)], axis=1))
    centre = np.array([0, radius, 0])
    parts = [tube(radius * line + centre, wire) for line in lines]
    ring = 0.12 * np.stack([np.cos(t), np.sin(t), 0 * t], axis=1) + [0, 2 * radius + 0.12, 0]
    position, normal, faces = joined([*parts, tube(ring, wire)])
    write_ply(name, position, normal, np.zeros((len(position), 2)), faces)


def leaf(base, direction, length: float, width: float, droop: float) -> tuple:
    """Positions, normals and triangles of a thin leaf, ``direction`` in the plane, that bends down towards its tip."""
    s = np.linspace(0, 1, 9)[:, None]
    direction = np.array(direction) / np.linalg.norm(direction)
    spine = np.array(base) + length * (s * direction + [0, 1, 0] * (0.5 * s - droop * s**2))
    across = np.cross(direction, [0, 1, 0])
    w = width * np.sin(np.pi * np.clip(s, 0.02, 1)) ** 0.8 * (1 - 0.35 * s)
    fold = np.array([0, 0.25, 0])
    rows = np.stack([spine + k * w * across + abs(k) * w * fold for k in (-1, -0.5, 0, 0.5, 1)], axis=1)
    du, dv = np.gradient(rows, axis=1), np.gradient(rows, axis=0)
    n = np.cross(dv, du)
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)
    position = rows.reshape(-1, 3)
    return position, n.reshape(-1, 3), drop_degenerate(position, grid_faces(*rows.shape[:2]))


def leaves(name: str, count: int = 26) -> None:
    """Return a plant: leaves around three stems, in the spiral of a sunflower, smaller towards the top."""
    parts, rng = [], np.random.default_rng(15)
    for stem in range(3):
        lean = 2.1 * stem + 0.4
        t = np.linspace(0, 1, 17)[:, None]
        bend = np.array([np.cos(lean), 0, np.sin(lean)])
        height = (1.45, 1.2, 1.05)[stem]
        line = [0, 0.06, 0] + t * [0, height, 0] + 0.32 * t**1.6 * bend
        parts.append(tube(line, 0.012))
        for i in range(count // 2 if stem else count):
            at = 0.3 + 0.68 * i / (count // 2 if stem else count)
            angle = 2.39996 * i + stem + rng.uniform(-0.2, 0.2)
            base = line[int(at * 16)] + (at * 16 % 1) * (line[min(int(at * 16) + 1, 16)] - line[int(at * 16)])
            size = 0.6 - 0.3 * at
            parts.append(leaf(base, (np.cos(angle), 0, np.sin(angle)), size, 0.24 * size, rng.uniform(0.4, 0.75)))
    position, normal, faces = joined(parts)
    write_ply(name, position, normal, np.zeros((len(position), 2)), faces)


# -- scenes ------------------------------------------------------------------------------------------------------------


def scene(name: str, what: str, light: str, lighting, content: list) -> None:
    """Write a scene that looks at the origin."""
    top = head(480, 480, {}, fov=28.0, camera=CAMERA)
    write(FOLDER / f"capture_{name}.xml", ABOUT.format(what=what, light=light), [*top, light[0].upper() + light[1:],
          lighting, "What is captured", *content])  # fmt: skip


def main() -> None:
    """Write the files."""
    clay = principled(base_color=(0.62, 0.31, 0.2), roughness=0.55, specular=0.4)
    porcelain = principled(bitmap("base_color", "vase_color.png"), roughness=0.35, specular=0.5)
    blue = principled(base_color=(0.07, 0.2, 0.5), roughness=0.4, specular=0.5)
    green = principled(base_color=(0.42, 0.5, 0.12), roughness=0.5, specular=0.4)
    park = "a park in the afternoon"
    scene("group", "Suzanne, a vase, a knot and a pear", park, environment("forest.exr", 0.8, 40.0), [
        mesh("suzanne", clay, scale={"value": 0.82}, rotate=turn("y", 12), translate=place(-0.5, 0, -0.35)),
        mesh("vase", porcelain, rotate=turn("y", 40), translate=place(0.72, 0, -0.45)),
        mesh("knot", blue, scale={"value": 0.6}, rotate=turn("y", 60), translate=place(-0.42, 0, 0.72)),
        mesh("pear", green, scale={"value": 0.95}, translate=place(0.55, 0, 0.6)),
    ])  # fmt: skip

    cage("cage.ply")
    leaves("leaves.ply")
    wire = principled(base_color=(0.55, 0.5, 0.42), metallic=0.6, roughness=0.45, specular=0.5)
    foliage = plugin("bsdf", "twosided", principled(base_color=(0.24, 0.5, 0.08), roughness=0.5, specular=0.4))
    scene("thin", "A plant in a cage of wire", park, environment("forest.exr", 0.9, -30.0), [
        mesh("cage", wire), mesh("leaves", foliage),
    ])  # fmt: skip

    gold = plugin("bsdf", "roughconductor", material="Au", alpha=0.18)
    paint = principled(base_color=(0.5, 0.02, 0.03), metallic=0.3, roughness=0.4, clearcoat=1.0, clearcoat_gloss=0.9)
    steel = plugin("bsdf", "roughconductor", material="Cr", alpha=0.25)
    plastic = principled(base_color=(0.05, 0.22, 0.3), roughness=0.2, specular=0.6)
    scene("glossy", "Painted, golden and steel things", "a hotel room by day", environment("interior.exr", 0.5, 60.0), [
        mesh("suzanne", paint, scale={"value": 0.82}, rotate=turn("y", 12), translate=place(-0.5, 0, -0.35)),
        mesh("jar", gold, scale={"value": 1.3}, translate=place(0.72, 0, -0.4)),
        mesh("bowl", steel, scale={"value": 0.65}, translate=place(-0.45, 0, 0.72)),
        mesh("pear", plastic, scale={"value": 0.9}, translate=place(0.55, 0, 0.6)),
    ])  # fmt: skip


if __name__ == "__main__":
    main()
