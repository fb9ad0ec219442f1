"""Models in glTF files as scenes of Mitsuba's plugins: meshes, materials, a camera that frames them, and lights."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import re
import tempfile
from pathlib import Path
from urllib.parse import unquote
from xml.sax.saxutils import quoteattr

import mitsuba as mi
import numpy as np

from .. import plugins
from ..core import compat
from ..core.errors import DiffindError, missing_package, reason
from ..core.files import OutputError, cache_folder, shown, writable_folder
from ..core.units import check_memory
from ..maps.entries import IDENTITY, SourceError
from ..maps.gltf import material_names, read_content
from ..maps.source import Map, load_source

#: Extensions of files of models.
MODELS = (".gltf", ".glb")

#: Begins of the names of extensions of glTF that a file may require.
EXTENSIONS = ("KHR_materials_", "KHR_texture_", "KHR_lights_")

#: Bytes of memory for each element of an accessor, and for each vertex of a mesh at each of its places.
ELEMENT_BYTES = 64

#: Field of view of the camera, degrees, and the direction from the model to it; glTF has y up and z in front.
FOV, VIEW = 30.0, (0.45, 0.3, 1.0)

#: Least share of triangles with mirrored texture coordinates that a warning names.
LEAST_MIRRORED = 0.005

#: Code of numbers of single precision.
FLOAT = 5126

#: Modes of primitives that trimesh reads: points, lines, triangles, strips of triangles.
MODES = (0, 1, 4, 5)

#: Largest coordinate whose square single precision holds, and longest part of a name, in characters.
LARGEST, LONGEST = 1e18, 40

#: Name of a map → the parameter of ``principled``.
PARAMETERS = {"albedo": "base_color", "roughness": "roughness", "metallic": "metallic"}

#: Text of a scene. The lights are for a model in a sphere of radius 1 about the origin, and are moved with it.
SCENE = """<scene version="3.0.0">
    <!-- {name} -->
    <default name="spp" value="64"/>
    <default name="width" value="640"/>
    <default name="height" value="640"/>
    <integrator type="path"><integer name="max_depth" value="8"/></integrator>
    <sensor type="perspective" id="camera">
        <float name="fov" value="{fov}"/><float name="near_clip" value="{near}"/><float name="far_clip" value="{far}"/>
        <transform name="to_world"><lookat origin="{eye}" target="{centre}" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm"><integer name="width" value="$width"/><integer name="height" value="$height"/></film>
    </sensor>
    <emitter type="constant" id="sky"><rgb name="radiance" value="0.5"/></emitter>
    <shape type="rectangle" id="key"><transform name="to_world"><lookat origin="2.5, 3.5, 3" target="0, 0, 0"
        up="0, 1, 0"/>{place}</transform><emitter type="area"><rgb name="radiance" value="10"/></emitter></shape>
    <shape type="rectangle" id="fill"><transform name="to_world"><lookat origin="-4, 1.5, 2" target="0, 0, 0"
        up="0, 1, 0"/>{place}</transform><emitter type="area"><rgb name="radiance" value="2"/></emitter></shape>
    <shape type="rectangle" id="rim"><transform name="to_world"><lookat origin="-1.5, 3, -4" target="0, 0, 0"
        up="0, 1, 0"/>{place}</transform><emitter type="area"><rgb name="radiance" value="8"/></emitter></shape>
{objects}</scene>
"""

#: Ids of other objects of a scene.
RESERVED = ("camera", "sky", "key", "fill", "rim")


def is_model(path) -> bool:
    """Return whether a path is that of a model."""
    return isinstance(path, (str, os.PathLike)) and Path(path).suffix.lower() in MODELS


def model_scene(path: str | os.PathLike, folder: str | os.PathLike | None = None) -> Path:
    """Write a model as a scene, with its meshes and images, and return the path of the scene file.

    - ``path``: a glTF file. Its materials are those that :func:`.load_source` reads; notes on the rest are warnings.
    - ``folder``: folder of the scene, which is made and holds no other files (``None``: one of the user's cache, by the
      content of the file).

    Images have 8 bits a channel. Raises :class:`.SourceError` and :class:`.OutputError`.
    """
    path = Path(path)
    content, _ = read_content(path)
    target = Path(folder) if folder is not None else None
    try:
        _check(path, content)
        target = target or cache_folder() / f"{_name(path.stem)}_{_digest(path, content)}"
        if folder is None and (target / "scene.xml").is_file():
            return target / "scene.xml"
        with tempfile.TemporaryDirectory(dir=writable_folder(target, create=True), prefix=".unfinished") as temporary:
            files = _Writer(path, content, Path(temporary)).write()
            others = {file.name for file in target.glob("[!.]*")} - {file.name for file in files}
            if others:
                raise OutputError(f"{target}: holds {min(others)}, which is not of {path.name}: remove the folder")
            for file in files:  # the scene last
                os.replace(file, target / file.name)
    except DiffindError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as e:
        raise SourceError(f"{shown(path)}: is no valid glTF file ({type(e).__name__}: {reason(e)})") from None
    finally:
        if target is not None:
            with contextlib.suppress(OSError):  # does not exist, or is not empty
                target.rmdir()
    return target / "scene.xml"


def _check(path: Path, content: dict) -> None:
    """Refuse a file that trimesh cannot read, or not within the memory of this machine; warn of unused parts."""
    required = [name for name in content.get("extensionsRequired", []) if not str(name).startswith(EXTENSIONS)]
    if required:
        raise SourceError(f"{shown(path)}: requires the extension {required[0]}, which is not read")
    nodes, accessors = content.get("nodes", []), content.get("accessors", [])
    counts = [accessor.get("count", 0) for accessor in accessors]
    check_memory("model", f"{sum(counts):,} elements", ELEMENT_BYTES * sum(counts))
    primitives = _primitives(content)
    if any("camera" in node and ("mesh" in node or "children" in node) for node in nodes):
        raise SourceError(f"{shown(path)}: a node with a camera holds meshes or other nodes, which is not read")
    coordinates = {part["attributes"].get("TEXCOORD_0") for part in primitives} - {None}
    if any(accessors[index]["componentType"] != FLOAT for index in coordinates):
        raise SourceError(f"{shown(path)}: has texture coordinates in whole numbers, allowed are floats")
    if any("sparse" in accessor for accessor in accessors):
        raise SourceError(f"{shown(path)}: has sparse accessors, which are not read")
    unused = [
        (any("skin" in node for node in nodes), "skins"),
        (any("targets" in part for part in primitives), "morph targets"),
        (any("COLOR_0" in part["attributes"] for part in primitives), "colours of vertices"),
        (any(part.get("mode", 4) not in MODES for part in primitives), "fans of triangles and loops of lines"),
        *((key in content, key) for key in ("animations", "cameras")),
        ("KHR_lights_punctual" in content.get("extensions", {}), "lights"),
    ]
    if names := ", ".join(name for is_there, name in unused if is_there):
        plugins.warn(f"{path}: not used: {names}")


def _primitives(content: dict) -> list[dict]:
    return [part for mesh in content.get("meshes", []) for part in mesh["primitives"]]


def _digest(path: Path, content: dict) -> str:
    """Return a digest of a file, and of the times and sizes of the files that it names."""
    digest = hashlib.sha256(SCENE.encode() + path.read_bytes())
    for part in (*content.get("buffers", []), *content.get("images", [])):
        names = {part.get("uri", ""), unquote(part.get("uri", ""))}
        for file in sorted(path.parent / name for name in names if len(name) < 256):
            if file.is_file():
                digest.update(f"{file} {file.stat().st_size} {file.stat().st_mtime_ns}".encode())
    return digest.hexdigest()[:10]


def _name(text: str) -> str:
    """Return a text as part of the name of a file or of an object."""
    return re.sub(r"[^\w-]+", "_", text)[:LONGEST] or "unnamed"


def _load(path: Path):
    """Return the file as a ``trimesh.Scene``."""
    import trimesh

    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        return trimesh.load(path, process=False, force="scene")
    except MemoryError:
        raise
    except ImportError as e:
        raise SourceError(f"{shown(path)}: needs {missing_package(e.name or 'trimesh[easy]')}") from None
    except Exception as e:  # whatever a damaged file leads to
        raise SourceError(f"{shown(path)}: cannot be read as a model ({type(e).__name__}: {reason(e)})") from None
    finally:
        logger.setLevel(level)


class _Writer:
    """Writer of one model into a ``folder``."""

    def __init__(self, path: Path, content: dict, folder: Path):
        self.path, self.content, self.folder = path, content, folder
        self.files: list[Path] = []
        self.images: dict[bytes, str] = {}
        #: Number of a material → its id in the scene.
        self.ids: dict[int | None, str] = {}
        self.taken = {*RESERVED}

    def write(self) -> list[Path]:
        """Write all files, and return their paths, that of the scene last."""
        placed, materials, shapes, boxes = self._placed(), {}, [], []
        names = [f"{_name(geometry)}_{number}" for number, (geometry, *_) in enumerate(placed)]
        self.taken.update(names)
        for name, (_, mesh, matrix, material) in zip(names, placed, strict=True):
            if material not in materials:
                materials[material] = self._material(material)
            boxes.append(self._mesh(mesh, matrix, f"{name}.ply"))
            reference = quoteattr(self.ids[material])
            flat = "" if "vertex_normals" in mesh._cache.cache else '<boolean name="face_normals" value="true"/>'
            file = f'<string name="filename" value="{name}.ply"/>'
            shapes.append(f'    <shape type="ply" id="{name}">{file}{flat}<ref id={reference}/></shape>\n')
        box = np.concatenate(boxes)
        low, high = box.min(axis=0), box.max(axis=0)
        centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
        distance = radius / np.sin(np.radians(FOV / 2))
        eye = centre + distance * np.array(VIEW) / np.linalg.norm(VIEW)
        place = f'<scale value="{radius:.9g}"/><translate value="{_listed(centre)}"/>'
        text = SCENE.format(
            name=re.sub("--+", "-", self.path.name), fov=FOV, near=distance / 1000, far=distance * 100,
            eye=_listed(eye), centre=_listed(centre), place=place, objects="".join([*materials.values(), *shapes]),
        )  # fmt: skip
        self._add("scene.xml").write_text(text, encoding="utf-8")
        return self.files

    def _add(self, name: str) -> Path:
        self.files.append(self.folder / name)
        return self.files[-1]

    def _placed(self) -> list[tuple]:
        """Return the names of meshes, the meshes, their matrices, ``(4, 4)``, and the numbers of their materials."""
        import trimesh

        loaded, placed, left_out = _load(self.path), [], 0
        parts = [part for part in _primitives(self.content) if part.get("mode", 4) in MODES]
        materials = {name: part.get("material") for name, part in zip(loaded.geometry, parts, strict=True)}
        for node in sorted(loaded.graph.nodes_geometry):
            matrix, name = loaded.graph[node]
            mesh = loaded.geometry[name]
            if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
                left_out += 1
                continue
            if not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
                raise SourceError(f'{shown(self.path)}: a triangle of "{name}" names a vertex that does not exist')
            placed.append((str(name), mesh, np.asarray(matrix, np.float64), materials[name]))
        if left_out:
            plugins.warn(f"{self.path}: {left_out} of its parts have no triangles, they are left out")
        if not placed:
            raise SourceError(f"{shown(self.path)}: has no triangles")
        check_memory("model", "its meshes", ELEMENT_BYTES * sum(len(mesh.vertices) for _, mesh, *_ in placed))
        return placed

    def _mesh(self, mesh, matrix: np.ndarray, name: str) -> np.ndarray:
        """Write a mesh, and return its box, ``(2, 3)``."""
        linear, uv = matrix[:3, :3], getattr(mesh.visual, "uv", None)
        points = np.asarray(mesh.vertices, np.float64) @ linear.T + matrix[:3, 3]
        if not (np.abs(points) < LARGEST).all():
            raise SourceError(
                f'{shown(self.path)}: the mesh "{name}" has coordinates beyond {LARGEST:g}, or not finite'
            )
        has_normals, faces = "vertex_normals" in mesh._cache.cache, np.asarray(mesh.faces)
        faces = faces[:, ::-1] if np.linalg.det(linear) < 0 else faces
        uv = uv if uv is not None and len(uv) == len(points) else None
        attributes = {"has_vertex_normals": has_normals, "has_vertex_texcoords": uv is not None}
        shape = mi.Mesh(name, len(points), len(faces), **attributes)
        params = mi.traverse(shape)
        compat.set_triangles(params, points, faces)
        if has_normals:
            normals = np.asarray(mesh.vertex_normals) @ np.linalg.pinv(linear)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
            params["vertex_normals"] = mi.Float(normals.ravel().astype(np.float32))
        if uv is not None:
            corners = uv[faces]
            a, b = (corners[:, i] - corners[:, 0] for i in (1, 2))
            mirrored = float(np.mean(a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]))
            if mirrored >= LEAST_MIRRORED and getattr(mesh.visual.material, "normalTexture", None) is not None:
                plugins.warn(f"{self.path}: {mirrored:.0%} of {name} show their normal map mirrored, along y")
            texels = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)  # v is 0 in the first row of an image
            params["vertex_texcoords"] = mi.Float(texels.ravel().astype(np.float32))
        params.update()
        shape.write_ply(str(self._add(name)))
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def _material(self, number: int | None) -> str:
        """Return the element of a material; ``None`` is the default one of glTF."""
        name = "default" if number is None else material_names(self.content)[number]
        own_id = _name(name)
        while own_id in self.taken:
            own_id += "_"
        self.ids[number] = own_id
        self.taken.add(own_id)
        if number is None:
            numbers = "".join(f'<float name="{key}" value="1"/>' for key in ("metallic", "roughness"))
            color = '<rgb name="base_color" value="1"/>'
            return f'    <bsdf type="principled" id="{own_id}">{color}{numbers}</bsdf>\n'
        source = load_source(f"{self.path}#{name}", constant=True)
        for note in source.notes:
            plugins.warn(f"{self.path}#{name}: {note}")
        maps = {m.name: m for m in source.maps}
        known = {key: parameter for key, parameter in PARAMETERS.items() if key in maps}
        values = "".join(self._map(maps[key], parameter, own_id) for key, parameter in known.items())
        inner = f'<bsdf type="principled">{values}</bsdf>'
        if "normal" in maps:
            inner = f'<bsdf type="normalmap">{self._map(maps["normal"], "normalmap", own_id)}{inner}</bsdf>'
        if source.double_sided:
            inner = f'<bsdf type="twosided">{inner}</bsdf>'
        if "opacity" in maps:
            inner = f'<bsdf type="mask">{self._map(maps["opacity"], "opacity", own_id)}{inner}</bsdf>'
        return f"    {inner.replace('>', f' id={quoteattr(own_id)}>', 1)}\n"

    def _map(self, m: Map, parameter: str, material_id: str) -> str:
        """Return the element of a map: numbers if it is constant, else an image, which is written."""
        if not m.depth:
            numbers = np.clip(m.values[0, 0], 0, 1)
            tag = "rgb" if len(numbers) > 1 else "float"
            return f'<{tag} name="{parameter}" value="{_listed(numbers)}"/>'
        values = np.rint(255 * np.clip(m.values, 0, 1)).astype(np.uint8)
        key = hashlib.sha256(values.tobytes() + str(values.shape).encode()).digest()
        if key not in self.images:
            self.images[key] = f"{material_id}_{m.name}.png"
            mi.Bitmap(values).write(str(self._add(self.images[key])))
        raw = "" if m.color_space == "srgb" else '<boolean name="raw" value="true"/>'
        file = f'<string name="filename" value="{self.images[key]}"/>'
        a, b, c, d, e, f = m.transform
        matrix = f"{_listed((a, b, 0, c))}, {_listed((d, e, 0, f))}, 0, 0, 1, 0, 0, 0, 0, 1"
        place = "" if m.transform == IDENTITY else f'<transform name="to_uv"><matrix value="{matrix}"/></transform>'
        return f'<texture type="bitmap" name="{parameter}">{file}{raw}{place}</texture>'


def _listed(numbers) -> str:
    return ", ".join(f"{float(number):.9g}" for number in numbers)
