"""One example of each registered plugin, in a small scene, and the parameters that the scene exposes.

Plugins are those of the registry: one that needs no parameters needs no entry here.
"""

from importlib.util import find_spec
from pathlib import Path

import drjit as dr
import numpy as np
from arrays import aligned

from mi_diffind import plugins
from mi_diffind.core import compat, discovery

ASSETS = Path(__file__).resolve().parents[2] / "scenes" / "assets"

#: Plugin → parameters of its example: files that ship, and values that let each exposed parameter have an effect.
PARAMETERS = {
    "disney": {"base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}, "roughness": 0.4, "metallic": 0.3,
               "anisotropic": 0.4, "spec_tint": 0.3, "sheen": 0.5, "sheen_tint": 0.4, "flatness": 0.3,
                "clearcoat": 0.6, "clearcoat_gloss": 0.4},
    "mipmap": {"filename": "tiles_albedo.png"},
    "neural_bsdf": {"filename": "library/copper.npz", "scale": 0.9},
    "neural_field": {"filename": "group.npz"},
    "neural_ggx": {"alpha": 0.3, "eta": 0.4, "k": 2.0},
    "neural_image": {"filename": "tiles.npz", "channels": "albedo"},
    "neural_material": {"filename": "rust_shaded.npz"},
    "neural_sdf": {"filename": "knot.npz"},
    "neural_texture": {"filename": "tiles_filtered.npz", "channels": "albedo"},
}  # fmt: skip
PARAMETERS["neural_disney"] = PARAMETERS["disney"]
PARAMETERS["neural_material"] |= {
    name: value for name, value in PARAMETERS["disney"].items() if name not in ("base_color", "roughness", "metallic")
}

#: Centre of the scenes.
CENTRE = (0.1, 0.6, 0.0)


def names() -> list[str]:
    """Return the names of the modules that declare a plugin, without a variant: none of them is imported."""
    modules = discovery.modules(plugins.__name__, plugins.IGNORED)
    return [n for n, m in modules.items() if "\nPLUGIN = " in Path(find_spec(m).origin).read_text(encoding="utf-8")]


def refusal(mi, name: str, storage: str = "") -> str:
    """Return the sentence with which an example refuses the variant that is set, "" if it loads.

    Only refusals of a variant count, and of arrays to be optimised where the example is a grid that Mitsuba traces
    (:func:`scene_parts`); any other error is raised.
    """
    try:
        load(mi, name, storage)
    except RuntimeError as e:
        sentence = compat.one_sentence(e)
        if "variant" not in sentence and 'trace="grid" has no arrays' not in sentence:
            raise
        return sentence
    return ""


def example(name: str, storage: str = "", **more) -> dict:
    """Return the description of a plugin's example for ``mi.load_dict``."""
    description = {"type": name, **PARAMETERS.get(name, {}), **({"storage": storage} if storage else {}), **more}
    if "filename" in description:
        description["filename"] = str(ASSETS / description["filename"])
    return description


def sensor(mi, angle: float = 20.0, size: int = 12) -> dict:
    """Return a sensor that sees the example from an azimuth in degrees."""
    at, centre = np.radians(angle), np.array(CENTRE)
    origin = centre + 4 * np.array([np.sin(at), 0.35, np.cos(at)])
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin.tolist(), centre.tolist(), [0, 1, 0])
    return {"type": "perspective", "fov": 40, "to_world": to_world, "film": film}


def scene_parts(mi, name: str, storage: str = "", **more) -> dict:
    """Return a scene that shows a plugin's example, as a dictionary: integrator, shapes and lights, without sensors."""
    object_type = plugins.declared()[name].object_type
    polarized = "polarized" in mi.variant()
    if object_type == "shape" and polarized:  # only integrators without polarisation trace its arrays
        more = {"trace": "grid", **more}
    subject, plain = example(name, storage, **more), "path" if polarized else "path_footprint"
    ball = {"type": "sphere", "center": list(CENTRE), "radius": 0.7}
    solid = "neural_sdf" if name == "path_sdf" else None
    parts = {
        "type": "scene",
        "integrator": {"type": plain, "max_depth": 4},
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "point", "position": [2.0, 3.0, 4.0], "intensity": 20.0},
    }
    if object_type == "bsdf":
        parts["shape"] = {**ball, "bsdf": subject}
    elif object_type == "texture":
        parts["shape"] = {**ball, "bsdf": {"type": "diffuse", "reflectance": subject}}
    elif object_type == "shape":
        parts["shape"] = subject
        parts["integrator"] = {"type": "path" if polarized else "path_sdf", "max_depth": 4}
    elif object_type == "integrator":
        parts["shape"] = example(solid) if solid else {**ball, "radius": 0.4}
        parts["integrator"] = {**subject, "id": "integrator"}
    else:
        raise AssertionError(f"no scene for the plugin {name}, a {object_type}: add one to {Path(__file__).name}")
    return parts


def load(mi, name: str, storage: str = "", sensors=(20.0,), **more):
    """Load the scene of an example with a sensor at each of these azimuths."""
    views = {f"sensor{i}": sensor(mi, angle) for i, angle in enumerate(sensors)}
    return mi.load_dict({**scene_parts(mi, name, storage, **more), **views}, parallel=False)


def exposed(mi, scene, name: str):
    """Return ``mi.traverse(scene)`` and the keys of the plugin's example: shape and material, or integrator."""
    params = mi.traverse(scene)
    start = "integrator." if plugins.declared()[name].object_type == "integrator" else "shape."
    beside = ("vertex_", "faces", "sampling_weight", "silhouette")
    subject = "" if plugins.declared()[name].object_type in ("integrator", "shape") else "bsdf."
    keys = [k for k in params.keys() if k.startswith(start + subject) and not any(w in k for w in beside)]
    return params, keys


def copied(value):
    """Return a copy of the value of a parameter. (A tensor made of ``numpy()`` would use memory that Dr.Jit frees.)"""
    return type(value)(aligned(value.numpy())) if dr.is_tensor_v(value) else type(value)(value)
