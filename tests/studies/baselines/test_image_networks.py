"""Hash grid and network of an image in given bytes."""

import numpy as np
import pytest

from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import fit
from mi_diffind.fitting.settings import FitSettings
from mi_diffind.maps.source import from_arrays
from mi_diffind.studies.baselines import image_networks


def ramps(width: int = 48, height: int = 32):
    """Two maps whose orientation cannot be mistaken: brightness along x and y, and one channel of both."""
    y, x = np.mgrid[:height, :width]
    albedo = np.stack([x / width, y / height, 0 * x + 0.25], axis=-1)
    maps = {"albedo": albedo, "roughness": (0.5 * x / width + 0.5 * y / height)[..., None]}
    return from_arrays({name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()})


@pytest.mark.parametrize("nbytes", [6000, 20000, 100000])
def test_a_network_takes_no_more_than_its_bytes(mi_rgb, nbytes):
    """Two bytes a parameter, counted on the allocated network, are at most the bytes asked for, and most of them."""
    types = array_module(mi_rgb.variant())
    problem = image_networks.ImageNetworkProblem(image_networks.network(ramps(), nbytes), types, ramps())
    assert problem.net.parameters * 2 <= nbytes
    full = image_networks.network(ramps(), 10**7).alloc(types.TensorXf, 2)
    assert problem.net.parameters * 2 > 0.9 * min(nbytes, 2 * full.parameters)


def test_too_few_bytes_are_refused():
    with pytest.raises(ValueError, match="200 bytes are too few"):
        image_networks.network(ramps(), 200)


def test_a_network_learns_the_maps(mi_rgb):
    """After a short training, decoded maps are the source's, in its shape and orientation."""
    source, types = ramps(), array_module(mi_rgb.variant())
    problem = image_networks.ImageNetworkProblem(image_networks.network(source, 20000), types, source)
    settings = FitSettings(steps=150, batch=1024, lr=1e-2, schedule="cosine", loss="mse", measure_every=50)
    result = fit(problem, settings, progress=False)
    decoded = problem.decode(problem.net)
    for m in source.maps:
        assert decoded[m.name].shape == m.values.shape
        assert np.abs(decoded[m.name] - m.values).mean() < 0.03, m.name
    error = np.mean(np.concatenate([(decoded[m.name] - m.values).ravel() ** 2 for m in source.maps]))
    assert result.measured["psnr_db"] == pytest.approx(-10 * np.log10(error), abs=1.5)


def test_the_study_of_images_compares_with_a_network(mi_rgb):
    """The plan has a network in the bytes of a compression ratio, with errors; of tiny images it has none."""
    from mi_diffind.studies.image import plan

    settings = plan.ImageStudySettings(compressions=(2.0,), seconds=(1.0,), astc="fast", astc_choice="fast")
    source = ramps(96, 96)
    (job,) = [j for j in plan.plan(source, "ramps", settings).jobs if isinstance(j, plan.NetworkImage)]
    record = job.run(None, False)
    assert 0.5 * source.nbytes / 2 < record["bytes"] <= source.nbytes / 2
    assert record["errors"]["psnr_db"] > 5 and record["details"]["steps"] > 0
    tiny = plan.plan(ramps(16, 16), "ramps", settings).jobs
    assert tiny and not any(isinstance(j, plan.NetworkImage) for j in tiny)
