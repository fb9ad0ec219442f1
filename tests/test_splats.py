"""Views of 3D Gaussians: against compositing in NumPy; their files, crops and refusals."""

import json

import numpy as np
import pytest
from commands import refused
from PIL import Image
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from mi_diffind.arrays.tables import load_table
from mi_diffind.commands import cli
from mi_diffind.core.errors import UsageError
from mi_diffind.scenes.capture import CaptureSettings
from mi_diffind.scenes.splats import Splats, SplatSubject
from mi_diffind.tasks.radiance import views as view_files
from mi_diffind.tasks.radiance.views import load_views

COUNT = 6


def gaussians(rng, spacing=1.0):
    """Gaussians one behind the other along z, in the order of their file: properties by name."""
    axes = Rotation.random(COUNT, rng=rng)
    return {
        "centres": np.stack([*rng.uniform(-0.1, 0.1, (2, COUNT)), np.arange(COUNT)[::-1]], axis=1) * spacing,
        "axes": axes.as_matrix(),
        "quaternions": axes.as_quat()[:, [3, 0, 1, 2]] * rng.uniform(0.5, 2, (COUNT, 1)),
        "scales": rng.uniform(0.05, 0.2, (COUNT, 3)) * spacing,
        "opacities": rng.uniform(0.2, 0.6, COUNT),
        "colours": rng.normal(0, 0.4, (COUNT, 16, 3)),
    }


def columns(g):
    rest = g["colours"][:, 1:].swapaxes(1, 2).reshape(COUNT, -1)  # all of red first
    table = dict(zip("xyz", g["centres"].T, strict=True))
    table |= {f"f_dc_{i}": g["colours"][:, 0, i] for i in range(3)}
    table |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    table |= {"opacity": np.log(g["opacities"] / (1 - g["opacities"]))}
    table |= {f"scale_{i}": np.log(g["scales"][:, i]) for i in range(3)}
    return table | {f"rot_{i}": g["quaternions"][:, i] for i in range(4)}


def write(path, table, text=False):
    rows = np.stack(list(table.values()), axis=1).astype("<f4")
    header = "".join(f"property float {name}\n" for name in table)
    style = "ascii" if text else "binary_little_endian"
    header = f"ply\nformat {style} 1.0\nelement vertex {len(rows)}\n{header}end_header\n"
    body = "\n".join(" ".join(f"{x:.9g}" for x in row) for row in rows).encode() if text else rows.tobytes()
    path.write_bytes(header.encode() + body)
    return path


def harmonics(d):
    """Real spherical harmonics of degree 0 to 3 with the signs of Condon and Shortley, ``(16, N)``."""
    polar, azimuth, values = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0]), []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(order), polar, azimuth)
            part = y.imag if order < 0 else y.real
            values.append(part * (np.sqrt(2) if order else 1))
    return np.array(values)


def composited(g, o, d):
    """sRGB in front of black, and alpha, ``(N, 4)``, of rays that meet the Gaussians in the order of their depth."""
    result, transmittance, basis = np.zeros((len(d), 4)), np.ones(len(d)), harmonics(d)
    for i in np.argsort(g["centres"] @ d.mean(axis=0)):
        inverse = g["axes"][i] @ np.diag(g["scales"][i] ** -2.0) @ g["axes"][i].T
        to = g["centres"][i] - o
        along = (d @ inverse @ to) / np.einsum("ni,ij,nj->n", d, inverse, d)
        off = along[:, None] * d - to
        falloff = np.exp(-0.5 * np.einsum("ni,ij,nj->n", off, inverse, off))
        alpha = g["opacities"][i] * falloff
        colour = np.maximum(basis.T @ g["colours"][i] + 0.5, 0)
        result[:, :3] += (transmittance * alpha)[:, None] * colour
        transmittance = transmittance * (1 - alpha)
    result[:, 3] = 1 - transmittance
    return result


@pytest.mark.parametrize("size", [1e-4, 1, 1e4])
def test_rays_agree_with_numpy_at_every_size(mi_rgb, tmp_path, rng, size):
    """Gaussians of a scene of 1e-4 are all nearer to one another than the steps of Mitsuba's integrator."""

    g = gaussians(rng, size)
    camera = SplatSubject(write(tmp_path / "s.ply", columns(g)), CaptureSettings())
    camera.prepare()
    d = np.concatenate([rng.uniform(-0.02, 0.02, (200, 2)), np.full((200, 1), -1.0)], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = np.array([0, 0, 14.0]) * size
    seen, truth = camera.trace((o - camera.centre) * camera.scale, d), composited(g, o, d)
    assert 0.5 < truth[:, 3].max() < 0.99
    # Gaussians end at three standard deviations or little behind, where they have 1% of their opacity
    assert np.abs(seen - truth).max() < 0.02 and np.abs(seen - truth).mean() < 1e-3


def test_views_hold_what_is_displayed(mi_rgb, tmp_path, rng):
    """One opaque ball of a single colour: sRGB is what the file says, alpha 1 inside and 0 outside."""

    g = gaussians(rng)
    g["centres"] *= 0.01
    g["scales"][:], g["opacities"][:] = 0.3, 0.9999
    g["colours"][:] = 0
    g["colours"][:, 0] = (np.array([0.8, 0.4, 0.1]) - 0.5) / 0.28209479177387814
    path = write(tmp_path / "s.ply", columns(g))
    options = ["--views", "3", "--test", "1", "--resolution", "24"]
    assert cli.main(["capture", str(path), "-o", str(tmp_path / "views"), *options]) == 0
    pixels = np.array(Image.open(tmp_path / "views" / "train" / "r_001.png"))
    assert pixels.shape == (24, 24, 4) and pixels[12, 12, 3] == 255 and pixels[0, 0, 3] == 0
    assert np.abs(pixels[12, 12, :3] - 255 * np.array([0.8, 0.4, 0.1])).max() <= 1
    some = pixels[..., 3] > 20
    assert np.abs(pixels[some][:, :3] - 255 * np.array([0.8, 0.4, 0.1])).max() <= 3  # not darker at the edge
    views = load_views(tmp_path / "views")
    assert views.has_alpha and (views.box[0] < -0.4).all() and (views.box[1] > 0.4).all()
    assert views.notes == load_views(tmp_path / "views", "test").notes == ()
    record = json.loads((tmp_path / "views" / "capture.json").read_text())
    assert record["settings"]["spp"] == 4 and record["scene"] == "s.ply"


def test_text_files_and_other_orders_of_properties(tmp_path, rng):
    g = gaussians(rng)
    binary = Splats.read(write(tmp_path / "b.ply", columns(g)))
    text = Splats.read(write(tmp_path / "t.ply", dict(reversed(columns(g).items())), text=True))
    for name in ("centres", "scales", "opacities", "colours"):
        np.testing.assert_allclose(getattr(binary, name), g[name], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(getattr(text, name), getattr(binary, name), rtol=1e-5, atol=1e-6)
    turned = Rotation.from_quat(binary.quaternions).as_matrix()
    np.testing.assert_allclose(turned, g["axes"], atol=1e-5)
    corners = np.abs(np.einsum("nij,nj->nij", g["axes"], g["scales"]))
    reach = np.sqrt(2 * np.log(g["opacities"] / 0.05))[:, None]
    np.testing.assert_allclose(binary.extents(), reach * np.linalg.norm(corners, axis=2), rtol=1e-5)


def test_strays_and_faint_gaussians_are_left_out(tmp_path, rng):
    g = gaussians(rng)
    g["centres"] = rng.uniform(-1, 1, (COUNT, 3))
    table = {name: np.tile(values, 50) for name, values in columns(g).items()}
    for name in "xyz":
        table[name] = rng.uniform(-1, 1, 50 * COUNT)
    table["x"][:2], table["opacity"][7] = (40, -90), -20
    splats = Splats.read(write(tmp_path / "s.ply", table))
    kept = splats.crop()
    assert len(kept) == 50 * COUNT - 3 and np.abs(kept.centres).max() <= 1
    half = splats.crop((-2, -2, -2, 0, 2, 2))
    assert len(half) == np.count_nonzero((table["x"] > -2) & (table["x"] < 0) & (table["opacity"] > -10))
    with pytest.raises(UsageError, match=r"box: holds none of the 300 Gaussians of .*s.ply, most lie in \(-1"):
        splats.crop((50, 0, 0, 60, 1, 1))


def test_damaged_files_are_refused(tmp_path, rng):
    path = write(tmp_path / "s.ply", columns(gaussians(rng)))
    content = path.read_bytes()
    for damaged in (content[:-40], b"", content[:200], b"PK" + content[9:], b"solid ball\n"):
        path.write_bytes(damaged)
        with pytest.raises(UsageError, match=r"s.ply: cannot be read as 3D Gaussians, or is damaged \("):
            Splats.read(path)


def without(table, *names):
    return {name: values for name, values in table.items() if name not in names}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: {n: t[n] for n in "xyz"}, "holds no 3D Gaussians, its vertices lack scale_0, .*opacity, f_dc_0"),
        (lambda t: without(t, "rot_3"), "holds no 3D Gaussians, its vertices lack rot_3"),
        (lambda t: {n.replace("t_7", "t_45"): v for n, v in t.items()}, "its vertices lack f_rest_7"),
        (lambda t: without(t, "f_rest_44"), r"has 44 properties f_rest_\*, allowed are 0, 9, 24, 45"),
        (lambda t: t | {"y": np.full(COUNT, np.nan)}, "has 6 y that are NaN or infinite"),
        (lambda t: t | {"f_rest_3": np.full(COUNT, np.inf)}, "has 6 f_rest_3 that are NaN or infinite"),
        (lambda t: t | {f"rot_{i}": np.zeros(COUNT) for i in range(4)}, "has 6 rotations of length 0"),
        (lambda t: t | {"scale_1": np.full(COUNT, 200.0)}, "has places or scales above 1e18"),
        (lambda t: {n: v[:0] for n, v in t.items()}, "holds no Gaussians"),
        (lambda t: t | {"packed_position": t["x"]}, "holds compressed Gaussians"),
    ],
)
def test_other_files_are_refused(tmp_path, rng, change, message):
    with pytest.raises(UsageError, match=message):
        Splats.read(write(tmp_path / "s.ply", change(columns(gaussians(rng)))))


@pytest.mark.parametrize("name", ["s.spz", "s.sog", "s.KSPLAT", "meta.json", "s.ply"])
def test_other_formats_are_refused_by_name(mi_rgb, tmp_path, capsys, name):
    """Compressed PLY is PlayCanvas' header: chunks of bounds before vertices without a property x."""
    bounds = "".join(f"property float {end}_{axis}\n" for end in ("min", "max") for axis in "xyz")
    packed = "".join(f"property uint packed_{part}\n" for part in ("position", "rotation", "scale", "color"))
    header = f"ply\nformat binary_little_endian 1.0\nelement chunk 1\n{bounds}element vertex 4\n{packed}end_header\n"
    (tmp_path / name).write_bytes(header.encode() + bytes(24 + 64))
    error = refused(capsys, "capture", str(tmp_path / name), "-o", str(tmp_path / "o.npz"))
    assert "an uncompressed PLY file is needed" in error
    assert f'"splat-transform {name} OUTPUT.ply"' in error
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_is_not_used_of_a_file_is_named(mi_rgb, tmp_path, rng, capsys):
    """Not the normals that the reference implementation writes, which are 0."""
    table = columns(gaussians(rng)) | {"nx": np.zeros(COUNT), "filter_3D": np.full(COUNT, 0.1)}
    path = write(tmp_path / "s.ply", table)
    note = "s.ply: keys that are not used: filter_3D"
    assert Splats.read(path).notes == (note,)
    options = ["--views", "2", "--test", "0", "--resolution", "4", "--spp", "1", "--json", str(tmp_path / "s.json")]
    assert cli.main(["capture", str(path), "-o", str(tmp_path / "v"), *options]) == 0
    assert f"  {note}\n" in capsys.readouterr().out
    assert json.loads((tmp_path / "s.json").read_text())["notes"] == [note]
    content = path.read_bytes().replace(b"end_header\n", b"element intrinsic 1\nproperty float f\nend_header\n")
    path.write_bytes(content + bytes(4))
    assert Splats.read(path).notes == (f"{note}, intrinsic",)
    assert not Splats.read(write(tmp_path / "t.ply", without(table, "filter_3D"))).notes


def test_options_of_scenes_are_refused(mi_rgb, tmp_path, rng, capsys):
    path = str(write(tmp_path / "s.ply", columns(gaussians(rng))))
    scene = tmp_path / "s.xml"
    scene.write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    box, out = ["--box", *"000111"], ["-o", str(tmp_path / "v")]
    for command, message in (
        (["capture", path, *out, "--objects", "a"], "objects: given with the 3D Gaussians"),
        (["capture", path, *out, "-D", "a=1"], "defines: given with the 3D Gaussians"),
        (["capture", str(scene), *out, *box], "box: given with a scene"),
        (["capture", path, *out, "--box", *"000110"], "box: found no box"),
        (["capture", path, *out, "--variant", "llvm_ad_mono"], "the variant llvm_ad_mono shows no Gaussians"),
    ):
        assert message in refused(capsys, *command)
    assert not (tmp_path / "v").exists()


def test_a_field_of_gaussians(mi_rgb, tmp_path, rng, monkeypatch, capsys):
    """Views of the Gaussians, and the field of the views; the file itself is refused with the command that captures."""

    monkeypatch.setattr(view_files, "SEARCH", 16)
    g = gaussians(rng)
    g["centres"] *= 0.1
    g["scales"][:], g["opacities"][:] = 0.3, 0.99
    path, views, out = write(tmp_path / "s.ply", columns(g)), tmp_path / "s_views", tmp_path / "field.npz"
    fit = ["--preset", "grid", "--resolution", "16", "--steps", "30", "--batch", "512", "-o", str(out)]
    assert "mi-diffind capture s.ply -o s_views --views" in refused(capsys, "fit", "field", str(path), *fit)
    assert cli.main(["capture", str(path), "-o", str(views), "--views", "6", "--test", "2", "--resolution", "20"]) == 0
    assert cli.main(["fit", "field", str(views), *fit]) == 0
    assert load_table(out, "field").settings["capture_path"] == "s_views"
