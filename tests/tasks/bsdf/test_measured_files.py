"""Measured spectra and Mueller matrices as colours, against Mitsuba's spectral variants; files by a script."""

import numpy as np
import pytest
from arrays import aligned, numpy_of
from learned_bsdfs import handmade
from variants import set_variant

import mi_diffind
from mi_diffind.errors import UsageError
from mi_diffind.runtime import array_module
from mi_diffind.tables import save_table
from mi_diffind.tasks.bsdf import measured_files, tensor_file
from mi_diffind.tasks.bsdf.truth import truth_of

#: Wavelengths of the files, nm.
WAVELENGTHS = np.array([400, 470, 560, 610, 700])


def directions(rng, n=400):
    z, phi = 0.2 + 0.8 * rng.random((2, n)), 2 * np.pi * rng.random((2, n))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32)


def spectral_file(mi, path, folder, monkeypatch):
    """A file of ``measured`` whose colours are another BSDF's, times a spectrum that depends on the half vector."""
    monkeypatch.setattr(tensor_file, "THETAS", 8)
    monkeypatch.setattr(tensor_file, "SIDE", 8)
    save_table(folder / "learned.npz", handmade())
    fields = mi_diffind.open(folder / "learned.npz").decode()
    rgb = fields.pop("rgb")
    shares = np.random.default_rng(2).random((3, len(WAVELENGTHS))).astype(np.float32)
    spectra = np.einsum("ptcyx,cw->ptwyx", rgb, shares)
    tensor_file.write(path, {**fields, "spectra": spectra, "wavelengths": WAVELENGTHS.astype(np.float32)})


def polarised_file(path):
    """A file of ``measured_polarized`` of random matrices, which fall with θ_h; some are invalid."""
    rng = np.random.default_rng(3)
    phi_d, theta_d, theta_h = (np.linspace(-np.pi, np.pi, 9), np.linspace(0, 1.5708, 5), np.linspace(0, 1.5708, 7))
    m = (0.2 + rng.random((9, 5, 7, 5, 4, 4))) * np.exp(-theta_h)[:, None, None, None]
    m[4, 2, 3] = np.nan
    angles = {"phi_d": phi_d, "theta_d": theta_d, "theta_h": theta_h}
    fields = {name: a[None].astype(np.float32) for name, a in angles.items()}
    tensor_file.write(path, {**fields, "wvls": WAVELENGTHS.astype(np.uint16), "M": m.astype(np.float32)})


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


@pytest.mark.parametrize("illuminant", measured_files.ILLUMINANTS)
@pytest.mark.parametrize("plugin", ["measured", "measured_polarized"])
def test_colours_are_those_of_spectral_variants(tmp_path, rng, monkeypatch, plugin, illuminant):
    """Colours are integrals of what Mitsuba shows at many wavelengths; white is white under D65."""
    mi = set_variant("llvm_ad_rgb")
    path = tmp_path / ("a.bsdf" if plugin == "measured" else "a.pbsdf")
    if plugin == "measured":
        spectral_file(mi, path, tmp_path, monkeypatch)
    else:
        polarised_file(path)
    wi, wo = directions(rng)
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
    white = measured_files.colour_weights(WAVELENGTHS, illuminant).sum(axis=0)
    np.testing.assert_allclose(white, 1 if illuminant == "D65" else [1.205, 0.948, 0.909], atol=2e-3)


def test_damaged_files(mi_rgb, tmp_path):
    path = tmp_path / "a.pbsdf"
    polarised_file(path)
    content = path.read_bytes()
    other = r"is no tensor file of a measured material \(another format\)"
    for damaged, message in ((content[:200], "is no tensor file"), (content[:-100], "is no"), (b"x" + content, other)):
        path.write_bytes(damaged)
        with pytest.raises(UsageError, match=message):
            truth_of(path, array_module())
    tensor_file.write(path, {"M": np.zeros((2, 2, 2, 2, 4, 3), np.float32)})
    with pytest.raises(UsageError, match="is no file of measured Mueller matrices"):
        truth_of(path, array_module())
    tensor_file.write(tmp_path / "a.bsdf", {"wavelengths": np.zeros(3, np.float32), "spectra": np.zeros(4, np.float32)})
    with pytest.raises(UsageError, match=r"a.bsdf: is no file of measured spectra"):
        truth_of(tmp_path / "a.bsdf", array_module())
