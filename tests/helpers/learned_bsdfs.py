"""Table files of learned BSDFs that no training made, and their formula in NumPy."""

import math

import numpy as np

from mi_diffind.arrays.tables import StoredArray, Table, byte_array
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


def unit(theta, phi) -> np.ndarray:
    """Return directions ``(n, 3)`` of angles."""
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


def about_normal(w, angle: float) -> np.ndarray:
    """Return directions ``(n, 3)`` after a rotation about the normal."""
    cos, sin = math.cos(angle), math.sin(angle)
    return w @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


def formula(table: Table, wi, wo) -> np.ndarray:
    """Return f without the cosine, ``(n, 3)``, of directions ``(n, 3)``, by angles and rotations."""
    form, arrays = table.settings["form"], table.arrays
    wi, wo = (about_normal(w, -form["angle"]) for w in (wi, wo))
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
    numbers = interpolated(arrays["cascaded"], np.concatenate([first, second], axis=1))
    low, high = np.array(form["range"])
    roots = np.exp(low / 4), np.exp(high / 4)
    value *= (
        (roots[0] + (roots[1] - roots[0]) * numbers) ** 4 if form["terms"] else np.exp(low + (high - low) * numbers)
    )
    for direction in (wi, wo):
        value *= interpolated(arrays["energy"], np.sqrt(direction[:, 2:]))
    return value


#: Parameters of a family: a logarithmic and a linear one.
FAMILY = ({"name": "roughness", "low": 0.05, "high": 0.8}, {"name": "metallic", "low": 0.0, "high": 1.0})


def handmade_family(**changes) -> Table:
    """Return a table of a family over :data:`FAMILY` with smooth proxies and random bytes; ``changes`` of its form."""
    rng, rank = np.random.default_rng(6), 2
    form = Form(**{"range": (-0.6, 0.5), **changes})
    arrays = {name: byte_array(rng.integers(0, 256, shape), 1 / 255) for name, shape in SIZES.items()}
    arrays["cascaded"] = byte_array(rng.integers(0, 256, (*SIZES["cascaded"][:3], 3 * rank)), 1 / 255)
    arrays["mixing"] = byte_array(rng.integers(80, 176, (4, 3, rank)), 1 / 255)
    values = np.exp(logarithms())
    proxy = np.empty((4, 3, PARAMETERS + 2))
    for i, j in np.ndindex(4, 3):
        alpha = 0.05 * 4 ** (i / 1.5)
        proxy[i, j, :PARAMETERS] = values * (1 - 0.3 * j / 2)
        for channel in (3, 4, 5, 6, 13, 14, 15):
            proxy[i, j, channel] = np.log(values[channel] * (1 + 0.1 * j))
        proxy[i, j, 4:6], proxy[i, j, 13:15] = np.log(alpha), np.log(min(1, 2.5 * alpha))
        proxy[i, j, PARAMETERS:] = np.log(0.8 * alpha)
    arrays["proxy"] = StoredArray(proxy.astype(np.float16))
    arrays["weights"] = byte_array(rng.integers(50, 256, (16, 3, 2, 3)), 1 / 255)
    arrays["energy"] = byte_array(rng.integers(0, 256, (32, 3, 2, 1)), 0.1 / 255, 0.9)
    settings = {"form": form.to_json(), "family": list(FAMILY), "factors": [1.0, 1.4]}
    return Table("bsdf", arrays, "ours", settings)


def member(table: Table, roughness: float, metallic: float) -> Table:
    """Return the table of one material that a member of :func:`handmade_family` is, of entries as floats."""
    low, high = FAMILY[0]["low"], FAMILY[0]["high"]
    x = np.array([[math.log(roughness / low) / math.log(high / low), metallic]])

    def at(name):
        return interpolated(table.arrays[name], x)[0]

    form = dict(table.settings["form"])
    proxy = at("proxy")
    form["scale"] = np.exp(proxy[PARAMETERS:]).tolist()
    for channel in (0, 1, 2, *range(7, 13), *range(16, 22)):
        proxy[channel] = np.log(proxy[channel])
    arrays = {name: table.arrays[name] for name in ("primary_uv", "primary_vw")}
    arrays["proxy"] = StoredArray(proxy[:PARAMETERS, None].astype(np.float32))
    low, high = np.exp(np.array(form["range"]) / 4)
    zero = (1 - low) / (high - low)
    residuals = table.arrays["cascaded"].values.astype(np.float64)
    residuals = residuals.reshape(*residuals.shape[:3], -1, 3) - zero
    factors = 2 * at("mixing") - 1
    arrays["cascaded"] = StoredArray((zero + np.einsum("r,uvwrc->uvwc", factors, residuals)).astype(np.float32))
    energy = table.arrays["energy"].values
    columns = [interpolated(StoredArray(row), x)[0] for row in energy]
    arrays["energy"] = StoredArray(np.float32(columns))
    return Table("bsdf", arrays, settings={"form": form})
