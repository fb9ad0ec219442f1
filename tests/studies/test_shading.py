"""``tradeoff shading``: materials, trouble of trainings, the zoom, equal errors of renders."""

from types import SimpleNamespace

import numpy as np
import pytest

from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.studies import example_maps, shading
from mi_diffind.studies import material_renders as renders
from mi_diffind.tasks.shading.material import material_effects


def test_generated_materials():
    """They repeat, have unit normals and are what they are called."""
    for name in example_maps.MATERIALS:
        found = {m.name: m for m in example_maps.generated_source(name, 64).maps}
        normal = 2 * found["normal"].values - 1
        assert np.linalg.norm(normal, axis=-1) == pytest.approx(1, abs=0.02)
        assert found["albedo"].color_space == "srgb" and found["albedo"].values.std() > 0.02
        for axis in (0, 1):
            inside = np.abs(np.diff(normal, axis=axis)).mean()
            across = np.abs(np.take(normal, 0, axis) - np.take(normal, -1, axis)).mean()
            assert across < 1.5 * inside
        assert ("metallic" in found) == (name == "hammered")
    assert example_maps.generated_source("lacquer", 64).digest == example_maps.generated_source("lacquer", 64).digest
    assert {m.name: m.values.mean() for m in example_maps.generated_source("lacquer", 64).maps}["roughness"] < 0.35


def history(losses, values):
    return [{"step": i, "loss": loss, "shaded_converged_db": v} for i, (loss, v) in enumerate(zip(losses, values))]  # noqa: B905


@pytest.mark.parametrize(
    "changes, trouble",
    [
        ({}, []),
        ({"restarts": 2}, ["restarts"]),
        ({"history": history([1, 1, float("nan")], [20, 21, 22])}, ["nan"]),
        ({"history": history([1, 200, 1], [20, 21, 22])}, ["spike"]),
        ({"history": history([1, 1, 1], [20, 23, 22])}, ["drift"]),
        ({"C": {"mean_db": 19.0}}, ["below"]),
        ({"C": {"mean_db": float("nan")}}, ["nan"]),
        ({"history": []}, ["diverged"]),
    ],
)
def test_trouble(changes, trouble):
    run = {"history": history([2, 1, 1], [20, 21, 22]), "restarts": 0, "C": {"mean_db": 22.0}, **changes}
    assert shading.troubles(run, {"C": {"mean_db": 20.0}}) == trouble


def test_the_zoom_is_what_the_camera_sees(mi_rgb):
    """Pixels of a frame, against a ray of a pinhole camera above the plane; points stay where they are."""
    source = example_maps.generated_source("lacquer", 64)
    pyramid = Pyramid.from_source(source, types=array_module(mi_rgb.variant()))
    view = shading.ShadedZoom(pyramid, material_effects(pyramid.layout)[0], 3, 8)
    spacings = [2 ** view.lanes(k)[2].numpy()[0] for k in range(3)]
    assert spacings == pytest.approx([shading.FAR, np.sqrt(shading.FAR * shading.NEAR), shading.NEAR], rel=1e-5)
    u, v, _, wi, wo = view.lanes(2)
    height = 4 * spacings[2] / np.tan(np.radians(shading.FOV / 2))  # of the camera, in texels
    camera = np.array([32, 32, height])
    for pixel in (0, 7, 37, 63):
        way = np.array([wi.x.numpy()[pixel], wi.y.numpy()[pixel], wi.z.numpy()[pixel]])
        hit = camera - way * height / way[2]
        place = np.array([u.numpy()[pixel], v.numpy()[pixel]]) * 64
        assert (hit[:2] - place + 32) % 64 - 32 == pytest.approx(0, abs=1e-3)
    assert np.linalg.norm([c.numpy()[0] for c in wo]) == pytest.approx(1)
    frames = []
    for k in range(3):  # a pattern of the plane that is linear, which bilinear reads keep
        u, v = (np.arange(8) + 0.5 - 4) * spacings[k], (np.arange(8) + 0.5 - 4) * spacings[k]
        frames.append(np.stack(np.broadcast_arrays(u[None], v[:, None], 0.0), -1))
    aligned = view.aligned(np.stack(frames))
    inner = np.abs(aligned[2]).max(axis=-1) < 3.4 * shading.NEAR
    np.testing.assert_allclose(aligned[0][inner], aligned[2][inner], atol=1e-3)


def test_extras_in_equal_bytes(mi_rgb):
    """Extras and the smaller arrays beside them take the bytes of the arrays alone, or a sentence says they cannot."""
    settings = SimpleNamespace(lambdas=[0.0, 0.9], ways=["clip, schedule"], seeds=1, length=0, pretraining=1,
                               unit="steps", frames=2, quick=True, preset="ours", extras=True)  # fmt: skip
    context = shading.ShadingContenders("lacquer", example_maps.generated_source("lacquer", 64), settings)
    sizes = [context.fit_texture(context.pyramid, 1, 0, False, extras)[0].nbytes for extras in (False, True)]
    budget = context.source.nbytes / 12
    assert sizes[1] + 4 * 8 * 8 * 3 <= budget and sizes[0] <= budget and sizes[0] > sizes[1]
    small = shading.ShadingContenders("lacquer", example_maps.generated_source("lacquer", 16), settings)
    with pytest.raises(UsageError, match="--extras: found 149 bytes for all arrays, extras alone need"):
        small.fit_texture(small.pyramid, 1, 0, False, True)


def test_equal_errors():
    """Four times the samples and the time have a quarter of the error, 6.02 dB; stratified ones an eighth."""

    def points(name, counts, slope):
        return [{"name": name, "spp": n, "psnr_db": 20 + slope * np.log10(n), "cpu_ms": {"median": 10.0 * n}}
                for n in counts]  # fmt: skip

    ours = [{"name": "ours", "spp": 1, "psnr_db": 20 + 10 * np.log10(8), "cpu_ms": {"median": 20.0}},
            {"name": "better", "spp": 1, "psnr_db": 50.0, "cpu_ms": {"median": 20.0}}]  # fmt: skip
    peers = points(renders.PEER, (1, 4, 16, 64), 10) + points(renders.MULTIJITTERED, (1, 4, 16, 64), 15)
    shares = renders.equal_errors(peers + ours)
    assert shares["ours"][renders.PEER] == pytest.approx({"share": 0.25, "spp": 8, "bound": False})
    assert shares["ours"][renders.MULTIJITTERED] == pytest.approx({"share": 0.5, "spp": 4, "bound": False})
    assert shares["better"][renders.PEER] == pytest.approx({"share": 1 / 32, "spp": 64, "bound": True})
