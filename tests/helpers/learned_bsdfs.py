"""Table files of learned BSDFs that no training made, and their formula in NumPy."""

import math

import numpy as np

from mi_diffind.tables import StoredArray, Table, byte_array
from mi_diffind.tasks.bsdf.model import PARAMETERS, Form

SIZES = {"primary_uv": (7, 5, 2), "primary_vw": (4, 3, 1), "cascaded": (6, 5, 4, 3)}

#: Lobes that sample: roughnesses and exponent.
LOBES = ((0.1, 0.1, 2.0), (0.4, 0.3, 6.0))


def logarithms(alpha_u=0.15, alpha_v=0.15) -> np.ndarray:
    """Return a proxy of a blue base, a sharp lobe whose exponent is not GGX's, and a wide one."""
    values = np.empty(PARAMETERS)
    values[:4] = 0.1, 0.2, 0.5, 1.6
    values[4:13] = alpha_u, alpha_v, 1.2, 0.05, 0.06, 0.04, 0.9, 0.8, 1.0
    values[13:22] = 0.5, 0.5, 0.9, 0.2, 0.1, 0.05, 0.3, 0.4, 0.2
    return np.log(values).astype(np.float32)


def handmade(**changes) -> Table:
    """Return a table of random bytes with a proxy; ``changes`` are those of its form."""
    rng = np.random.default_rng(5)
    form = Form(**{"scale": (0.12, 0.12), "range": (-0.4, 0.7), **changes})
    arrays = {name: byte_array(rng.integers(0, 256, shape), 1 / 255) for name, shape in SIZES.items()}
    if form.azimuth == "half":
        for name in ("primary_vw", "cascaded"):
            array = arrays[name]
            arrays[name] = StoredArray(array.entries, (*array.border[:-1], "repeat"), array.scale, array.offset)
    if form.terms:
        proxy = logarithms() if form.isotropic else logarithms(0.08, 0.3)
        arrays["proxy"] = StoredArray(proxy[:, None])
    arrays["weights"] = byte_array(rng.integers(50, 256, (16, 3)), 1 / 255)
    arrays["energy"] = byte_array(rng.integers(0, 256, (32, 1)), 0.1 / 255, 0.9)
    return Table("bsdf", arrays, "ours", {"form": form.to_json(), "lobes": list(map(list, LOBES))})


def interpolated(array: StoredArray, coordinates) -> np.ndarray:
    """Return a multilinear read at coordinates ``(n, d)`` in [0, 1]."""
    values, shape = array.values.astype(np.float64), array.shape[:-1]
    result = np.zeros((len(coordinates), array.shape[-1]))
    for corner in range(2 ** len(shape)):
        index, weight = [], np.ones(len(coordinates))
        for k, n in enumerate(shape):
            repeats = array.border[k] == "repeat"
            x = np.clip(coordinates[:, k], 0, 1) * (n if repeats else n - 1)
            lower = np.floor(x).astype(int) if repeats else np.minimum(x.astype(int), n - 2)
            up = corner >> k & 1
            index.append((lower + up) % n)
            weight = weight * (x - lower if up else 1 - (x - lower))
        result += weight[:, None] * values[tuple(index)]
    return result


def formula(table: Table, wi, wo) -> np.ndarray:
    """Return f without the cosine, ``(n, 3)``, of directions ``(n, 3)``, by angles and rotations."""
    form, arrays = table.settings["form"], table.arrays
    h = wi + wo
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    cos_d = np.einsum("ni,ni->n", wi, h)
    schlick = (1 - cos_d) ** 5
    value = np.ones((len(wi), 3))
    if form["terms"]:
        p = np.exp(arrays["proxy"].values.ravel().astype(np.float64))
        edge = [1 + (p[3] - 1) * (1 - w[:, 2]) ** 5 for w in (wi, wo)]
        value = (edge[0] * edge[1] / np.pi)[:, None] * p[:3] * ("diffuse" in form["terms"])
        for k, name in ((4, "first"), (13, "second")):
            if name not in form["terms"]:
                continue
            a = np.array([p[k], p[k] if form["isotropic"] else p[k + 1]])
            gamma, tan2 = 2 * p[k + 2], ((h[:, 0] / a[0]) ** 2 + (h[:, 1] / a[1]) ** 2) / h[:, 2] ** 2
            d = (1 + 2 / gamma * tan2) ** -gamma / (h[:, 2] ** 4 * np.pi * a[0] * a[1])
            for w in (wi, wo):
                d /= w[:, 2] + np.sqrt(w[:, 2] ** 2 + (a[0] * w[:, 0]) ** 2 + (a[1] * w[:, 1]) ** 2)
            f0, f90 = p[k + 3 : k + 6], p[k + 6 : k + 9]
            value = value + d[:, None] * (f0 + (f90 - f0) * schlick[:, None])
    # The azimuth of wi about h: rotate h to the pole, its meridian to the plane y = 0
    theta, phi = np.arccos(h[:, 2]), np.arctan2(h[:, 1], h[:, 0])
    x = np.cos(phi) * wi[:, 0] + np.sin(phi) * wi[:, 1]
    y = -np.sin(phi) * wi[:, 0] + np.cos(phi) * wi[:, 1]
    phi_d = np.arctan2(y, np.cos(theta) * x - np.sin(theta) * wi[:, 2])
    w = np.cos(phi_d) ** 2 if form["azimuth"] == "mirror" else phi_d / np.pi % 1
    t = (h[:, 0] / form["scale"][0]) ** 2 + (h[:, 1] / form["scale"][1]) ** 2
    u = np.minimum(np.log(1 + t) / math.log(1 + min(form["scale"]) ** -2), 1)
    v = np.sqrt(1 - cos_d)
    first = interpolated(arrays["primary_uv"], np.stack([u, v], axis=1))
    second = interpolated(arrays["primary_vw"], np.stack([v, w], axis=1))
    low, high = np.exp(np.array(form["range"]) / 4)
    value *= (low + (high - low) * interpolated(arrays["cascaded"], np.concatenate([first, second], axis=1))) ** 4
    for direction in (wi, wo):
        value *= interpolated(arrays["energy"], np.sqrt(direction[:, 2:]))
    return value
