"""Measured spectra and Mueller matrices as colours, against Mitsuba's spectral variants; files by a script."""

import numpy as np
import pytest
from arrays import aligned, numpy_of
from bsdf_queries import random_directions
from variants import set_variant

import mi_diffind
from mi_diffind.core import tensor_files
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.bsdf import measured
from mi_diffind.tasks.bsdf.truth import truth_of

#: Wavelengths of the files, nm.
WAVELENGTHS = np.array([400, 470, 560, 610, 700])


def measured_fields(name, channels):
    """Fields of a file of ``measured`` with random values, whose warp is that of an even distribution of normals."""
    rng, theta = np.random.default_rng(2), np.linspace(0, 1.57, 8)
    ones = np.ones((1, len(theta), 8, 8))
    fields = {
        "phi_i": np.zeros(1), "theta_i": theta, "ndf": np.ones((8, 8)), "sigma": np.ones((8, 8)), "vndf": ones,
        "luminance": ones, name: rng.uniform(0.2, 1, (1, len(theta), channels, 8, 8)),
    }  # fmt: skip
    fields = {name: np.ascontiguousarray(value, np.float32) for name, value in fields.items()}
    return {**fields, "jacobian": np.ones(1, np.uint8), "description": "random"}


def spectral_file(path):
    """A file of ``measured`` of random spectra."""
    fields = measured_fields("spectra", len(WAVELENGTHS))
    tensor_files.write(path, {**fields, "wavelengths": WAVELENGTHS.astype(np.float32)})


def polarised_file(path):
    """A file of ``measured_polarized`` of random matrices, which fall with θ_h; some are invalid."""
    rng = np.random.default_rng(3)
    phi_d, theta_d, theta_h = (np.linspace(-np.pi, np.pi, 9), np.linspace(0, 1.5708, 5), np.linspace(0, 1.5708, 7))
    m = (0.2 + rng.random((9, 5, 7, 5, 4, 4))) * np.exp(-theta_h)[:, None, None, None]
    m[4, 2, 3] = np.nan
    angles = {"phi_d": phi_d, "theta_d": theta_d, "theta_h": theta_h}
    fields = {name: a[None].astype(np.float32) for name, a in angles.items()}
    tensor_files.write(path, {**fields, "wvls": WAVELENGTHS.astype(np.uint16), "M": m.astype(np.float32)})


def spectrum(mi, plugin, path, wi, wo, wavelengths):
    """f cos θ_o of Mitsuba's plugin, ``(wavelengths, n)``."""
    bsdf = mi.load_dict({"type": plugin, "filename": str(path)})
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(aligned(wi.T))
    rows = []
    for k in range(0, len(wavelengths), 4):
        si.wavelengths = mi.UnpolarizedSpectrum(*np.resize(wavelengths[k : k + 4], 4).tolist())
        rows += list(numpy_of(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(aligned(wo.T)))).T)
    return np.array(rows[: len(wavelengths)])


@pytest.mark.parametrize("illuminant", measured.ILLUMINANTS)
@pytest.mark.parametrize("plugin", ["measured", "measured_polarized"])
def test_colours_are_those_of_spectral_variants(tmp_path, rng, plugin, illuminant):
    """Colours are integrals of what Mitsuba shows at many wavelengths; white is white under D65."""
    mi = set_variant("llvm_ad_rgb")
    path = tmp_path / ("a.bsdf" if plugin == "measured" else "a.pbsdf")
    if plugin == "measured":
        spectral_file(path)
    else:
        polarised_file(path)
    wi, wo = random_directions(rng, 400, 0.2), random_directions(rng, 400, 0.2)
    truth = truth_of(path, array_module(), illuminant=illuminant)
    assert truth.remark == f"spectra as linear sRGB under the illuminant {illuminant}"
    types = array_module()
    colours = numpy_of(truth.value(types.Array3f(aligned(wi.T)), types.Array3f(aligned(wo.T))))

    mi = set_variant("llvm_ad_spectral")
    grid = np.arange(360, 831, 5.0)  # values are linear between the wavelengths of the file
    shown = spectrum(mi, plugin, path, wi, wo, grid)
    nodes = mi.Float(grid.astype(np.float32))
    observer = numpy_of(mi.cie1931_xyz(nodes))
    light = numpy_of([mi.cie_d65(nodes)])[:, 0] if illuminant == "D65" else np.ones(len(grid))
    xyz = np.einsum("wn,wk,w->nk", shown, observer, light) / (light @ observer[:, 1])
    expected = xyz @ np.array([[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556],
                               [0.055648, -0.204043, 1.057311]]).T  # fmt: skip
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert np.median(colours) > 0.01
    np.testing.assert_allclose(colours / scale, np.maximum(expected, 0) / scale, atol=0.01)
    set_variant("llvm_ad_rgb")
    white = measured.colour_weights(WAVELENGTHS, illuminant).sum(axis=0)
    np.testing.assert_allclose(white, 1 if illuminant == "D65" else [1.205, 0.948, 0.909], atol=2e-3)


def fields_of(folder, polarised=False):
    """Fields of a small file, of colours or of matrices, as arrays."""
    path = folder / "whole.pbsdf"
    if polarised:
        polarised_file(path)
        return {name: np.array(array) for name, array in tensor_files.read(path).items()}
    return measured_fields("rgb", 3)


def changed(array, damage):
    return {
        "missing": None,
        "flat": array[None],
        "short": np.ascontiguousarray(array[..., : array.shape[-1] // 2]),
        "empty": array[:0],
        "nan": np.full_like(array, np.nan) if array.dtype.kind == "f" else None,
        "falling": array[..., ::-1].copy(),
        "dark": 0 * array,
        "below": array - array.max() / 2,
        "micrometres": array / 1000,
    }[damage]


DAMAGED = {
    "theta_i": {"missing": 'no field "theta_i"', "flat": "1 dimensions are needed", "short": "is needed",
                "empty": "has the shape", "nan": "8 values that are not finite", "falling": "does not increase",
                "below": "angles down to -0.[0-9]+, at least 0 are needed"},
    "ndf": {"missing": 'no field "ndf"', "flat": "2 dimensions are needed", "nan": "not finite",
            "dark": "or none above 0"},
    "vndf": {"nan": "not finite", "empty": "has the shape"},
    "luminance": {"short": "is needed"},
    "rgb": {"missing": 'no field "rgb"', "short": "is needed", "nan": "not finite"},
    "phi_d": {"missing": 'no field "phi_d"', "falling": "does not increase", "empty": "has the shape",
              "nan": "not finite"},
    "M": {"short": "is needed", "nan": "not finite"},
    "wvls": {"micrometres": "no wavelength between 300 and 1000 nm"},
}  # fmt: skip


@pytest.mark.parametrize("name, damage", [(name, damage) for name, damages in DAMAGED.items() for damage in damages])
def test_files_with_a_damaged_field(mi_rgb, tmp_path, name, damage):
    """The sentence names file and field, of a source and of a scene; Mitsuba reads some of the files as they are."""
    polarised = name in ("phi_d", "M", "wvls")
    fields = fields_of(tmp_path, polarised)
    array = changed(fields.pop(name), damage)
    path = tmp_path / ("a.pbsdf" if polarised else "a.bsdf")
    tensor_files.write(path, {**fields, **({} if array is None else {name: array})})
    sentence = rf"a\.p?bsdf: is no file of measured (colours|Mueller matrices): .*{DAMAGED[name][damage]}"
    with pytest.raises(UsageError, match=sentence):
        truth_of(path, array_module())
    if array is not None or not polarised:
        plugin = "measured_polarized" if polarised else "measured"
        with pytest.raises(UsageError, match=sentence):
            mi_diffind.load_dict({"type": "sphere", "b": {"type": plugin, "filename": str(path)}})


def test_a_file_with_an_empty_description(mi_rgb, tmp_path):
    tensor_files.write(tmp_path / "a.bsdf", {**fields_of(tmp_path), "description": ""})
    assert truth_of(tmp_path / "a.bsdf", array_module()).name == "a.bsdf"


def test_damaged_files(mi_rgb, tmp_path):
    path = tmp_path / "a.pbsdf"
    polarised_file(path)
    content = path.read_bytes()
    other = r"is no tensor file of a measured material \(another format\)"
    for damaged, message in ((content[:200], "is no tensor file"), (content[:-100], "is no"), (b"x" + content, other)):
        path.write_bytes(damaged)
        with pytest.raises(UsageError, match=message):
            truth_of(path, array_module())
    tensor_files.write(path, {"M": np.zeros((2, 2, 2, 2, 4, 3), np.float32)})
    with pytest.raises(UsageError, match="is no file of measured Mueller matrices"):
        truth_of(path, array_module())
    tensor_files.write(
        tmp_path / "a.bsdf", {"wavelengths": np.zeros(3, np.float32), "spectra": np.zeros(4, np.float32)}
    )
    with pytest.raises(UsageError, match=r"a.bsdf: is no file of measured spectra"):
        truth_of(tmp_path / "a.bsdf", array_module())
    fields = fields_of(tmp_path)
    tensor_files.write(tmp_path / "a.bsdf", {**fields, "rgb": fields["rgb"].astype(np.float64)})
    with pytest.raises(UsageError, match=r"a.bsdf: cannot be loaded \(\[Measured\] Invalid file structure"):
        truth_of(tmp_path / "a.bsdf", array_module())


def test_measured_files_of_one_azimuth_are_isotropic(mi_rgb, tmp_path, rng):
    """Values do not depend on the quadrant, nor does the density of samples."""
    fields = measured_fields("rgb", 3)
    fields["vndf"] = np.ascontiguousarray(0.5 + np.random.default_rng(4).random((1, 8, 8, 8)), np.float32)
    tensor_files.write(tmp_path / "a.bsdf", fields)
    types = array_module()
    truth = truth_of(tmp_path / "a.bsdf", types)
    assert truth.isotropic
    wi, wo = random_directions(rng, 300, 0.1), random_directions(rng, 300, 0.1)
    first = numpy_of(truth.value(*(types.Array3f(aligned(w.T)) for w in (wi, wo))))
    for angle in (0.7, 2.0, 3.5, 5.0):
        c, s = np.cos(angle), np.sin(angle)
        turned = [(w @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32) for w in (wi, wo)]
        value = numpy_of(truth.value(*(types.Array3f(aligned(w.T)) for w in turned)))
        np.testing.assert_allclose(value, first, rtol=0.02, atol=1e-3)
    two = {name: np.repeat(a, 2, axis=0) if name in ("vndf", "luminance", "rgb") else a for name, a in fields.items()}
    tensor_files.write(tmp_path / "b.bsdf", {**two, "phi_i": np.array([-1, 1], np.float32)})
    assert truth_of(tmp_path / "b.bsdf", types).isotropic
    two["rgb"] = two["rgb"] * np.array([1, 2], np.float32)[:, None, None, None, None]
    tensor_files.write(tmp_path / "c.bsdf", {**two, "phi_i": np.array([-1, 1], np.float32)})
    with pytest.raises(UsageError, match=r'c.bsdf: the field "rgb" differs between 2 azimuths'):
        truth_of(tmp_path / "c.bsdf", types)


def test_files_in_degrees(mi_rgb, tmp_path):
    polarised_file(tmp_path / "whole.pbsdf")
    fields = {name: np.array(array) for name, array in tensor_files.read(tmp_path / "whole.pbsdf").items()}
    tensor_files.write(tmp_path / "a.pbsdf", {**fields, "theta_h": np.degrees(fields["theta_h"])})
    with pytest.raises(UsageError, match=r'the field "theta_h" has angles up to 90, radians up to 1.6 are needed'):
        truth_of(tmp_path / "a.pbsdf", array_module())
