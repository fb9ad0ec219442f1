"""Frozen functions (``dr.freeze``): the same pictures as without, after any assignment; and kernels of numbers.

Every exposed parameter of every plugin is assigned a NumPy array, a Dr.Jit array and the value of another scene, and
parameters of other shapes are refused, or have their effect. The pictures are compared with those of a function that is
not frozen.
"""

from itertools import pairwise

import drjit as dr
import learned_bsdfs
import numpy as np
import plugin_examples as examples
import pytest

import mi_diffind
from mi_diffind.arrays.tables import save_table
from mi_diffind.core import compat

#: Seed of all pictures that are compared.
SEED = 3

NAMES = [*examples.names(), "family"]

#: Plugins that read tables.
TABLES = [name for name in NAMES if name.startswith("neural_")]

CASES = [*((n, "") for n in NAMES), *((n, "float32") for n in (*TABLES, "family", "lit field"))]

#: Plugins that expose numbers or a place of their own.
NUMBERS = [name for name in NAMES if name not in ("path_footprint", "path_sdf", "neural_texture")]

#: Arguments of further examples: a family of ``neural_bsdf`` has a file of its own.
EXAMPLES = {"family": {"name": "neural_bsdf"}, "lit field": {"name": "neural_field", "lit": True}}

pytestmark = pytest.mark.usefixtures("no_garbage_collection")


@pytest.fixture(scope="module", autouse=True)
def family(tmp_path_factory):
    EXAMPLES["family"]["filename"] = str(tmp_path_factory.mktemp("families") / "family.npz")
    save_table(EXAMPLES["family"]["filename"], learned_bsdfs.handmade_family())


def picture(mi, scene):
    return np.array(mi.render(scene, spp=2, seed=mi.UInt32(SEED)))


def frozen(mi):
    """A frozen render, as a function of a scene that returns a NumPy array, and the frozen function itself."""
    function = dr.freeze(lambda scene, seed: mi.render(scene, spp=2, seed=seed))
    return lambda scene: np.array(function(scene, dr.opaque(mi.UInt32, SEED))), function


def load(mi, name, storage=""):
    """The scene of an example and its parameters."""
    given = EXAMPLES.get(name, {"name": name})
    scene = examples.load(mi, storage=storage, **given)
    return scene, *examples.exposed(mi, scene, given["name"])


def from_numpy(value, factor):
    """A value of a parameter, multiplied by a factor in NumPy; a place is moved."""
    if hasattr(value, "inverse_transpose"):
        matrix = np.array(value.matrix, np.float64).reshape(value.matrix.shape[0], -1).copy()
        matrix[:-1, -1] += 0.1 * factor
        return type(value)(matrix.tolist())
    if dr.is_tensor_v(value) or dr.depth_v(value) == 1:
        return type(value)(np.array(np.float32(factor) * value.numpy()))
    return type(value)(*(type(x)(np.array(np.float32(factor) * x.numpy())) for x in value))


def from_drjit(value, factor):
    """A value of a parameter, multiplied by a factor in Dr.Jit; a place is moved."""
    if hasattr(value, "inverse_transpose"):
        return from_numpy(value, factor)
    result = type(value)(value.array * factor, value.shape) if dr.is_tensor_v(value) else value * factor
    dr.eval(result)
    return result


@pytest.mark.parametrize(("name", "storage"), CASES)
def test_frozen_pictures_follow_every_parameter(mi, name, storage):
    """Three values in each of three ways. All parameters change at once, each in another way, then each table alone,
    from NumPy: a function that records anew would hide what it does not see. Set back, the picture is the first."""
    scene, params, keys = load(mi, name, storage)
    other = load(mi, name, storage)[1]  # as loaded
    before = {key: examples.copied(params[key]) for key in keys}
    first = picture(mi, scene)
    render, function = frozen(mi)
    np.testing.assert_array_equal(render(scene), first)
    ways = (from_numpy, from_drjit, lambda value, factor: examples.copied(value))
    for turn, factor in enumerate((0.9, 0.6, 0.7)):
        for i, key in enumerate(keys):
            params[key] = ways[(turn + i) % len(ways)](other[key], factor)
        params.update()
        changed = picture(mi, scene)
        np.testing.assert_allclose(render(scene), changed, atol=1e-6, err_msg=f"{turn} {keys}")
        assert not keys or turn + len(keys) == 3 or np.abs(changed - first).max() > 1e-4
    for key in (k for k in keys if dr.is_tensor_v(other[k])):
        recordings = []
        for factor in (0.8, 0.5, 0.3):
            params[key] = from_numpy(other[key], factor)
            params.update()
            np.testing.assert_allclose(render(scene), picture(mi, scene), atol=1e-6, err_msg=f"{key} {factor}")
            recordings.append(function.n_recordings)
        assert recordings[1] == recordings[2], f"{key} is recorded with each change"
    params.update(before)
    # Levels of ``mipmap`` are computed by NumPy when a file is read, on the device after texels were assigned
    np.testing.assert_allclose(picture(mi, scene), first, rtol=2e-6 if name == "mipmap" else 0)
    assert np.isfinite(first).all()


@pytest.mark.parametrize(("name", "storage"), [case for case in CASES if case[1] or case[0] == "neural_ggx"])
def test_other_shapes_are_refused(mi, name, storage):
    """One sentence, and the picture of before, frozen or not: nothing is read beyond an array's end."""
    scene, params, keys = load(mi, name, storage)
    render, _ = frozen(mi)
    before = render(scene)
    tables = [key for key in keys if ".tables." in f".{key}"]
    assert tables
    for key in tables:
        shape = tuple(params[key].shape)
        for other in ((1,), shape[:-1], (shape[0] + 1, *shape[1:]), (max(1, shape[0] // 2), *shape[1:])):
            if other == shape:
                continue
            params[key] = type(params[key])(np.zeros(other, np.float32))
            with pytest.raises(RuntimeError, match=r'parameter "tables\..*has the shape .*, expected'):
                params.update()
            assert tuple(params[key].shape) == shape
    np.testing.assert_allclose(render(scene), before, atol=1e-6)
    np.testing.assert_allclose(picture(mi, scene), before, atol=1e-6)


@pytest.mark.parametrize("name", TABLES)  # of a family, the table of the proxy always is
def test_tables_of_floats_alone_are_parameters(mi, name):
    for storage in ("float32", "uint8"):
        keys = load(mi, name, storage)[2]
        assert any(".tables." in f".{key}" for key in keys) == (storage == "float32"), keys


@pytest.mark.parametrize("name", ["disney", "neural_bsdf"])
def test_several_numbers_are_refused(mi, name):
    scene, params, keys = load(mi, name)
    numbers = [key for key in keys if not key.endswith(".value")]
    assert len(numbers) >= 4
    for key in numbers:
        before = picture(mi, scene)
        value = params[key]
        params[key] = type(value)(mi.Float(value.numpy().ravel()[0], 0.5))
        with pytest.raises(RuntimeError, match=f'parameter "{key.split("bsdf.")[1]}": found 2 values, allowed is one'):
            params.update()
        assert dr.width(params[key]) == 1
        assert np.isfinite(picture(mi, scene)).all() and np.isfinite(before).all()


def test_images_of_other_sizes(mi, rng):
    """``mipmap`` takes data of any size, and is what a new texture of these texels is; others are refused."""
    scene, params, keys = load(mi, "mipmap")
    key = next(k for k in keys if k.endswith("data"))
    render, function = frozen(mi)
    render(scene)
    seen = []
    for size in ((64, 65), (5, 9), (1, 1), (2, 1), (64, 65), (65, 64)):
        params[key] = mi.TensorXf(rng.random((*size, 3), dtype=np.float32))
        params.update()
        np.testing.assert_array_equal(render(scene), picture(mi, scene), err_msg=str(size))
        seen.append(render(scene))
    assert function.n_recordings <= 7
    for shape in ((4, 4), (4, 4, 1), (4, 4, 4), (0, 4, 3)):
        params[key] = mi.TensorXf(np.ones(shape, np.float32))
        with pytest.raises(RuntimeError, match='parameter "data": has the shape'):
            params.update()
        np.testing.assert_array_equal(render(scene), seen[-1])
    assert all(np.abs(a - b).max() > 0.01 for a, b in pairwise(seen))


@pytest.mark.parametrize(("name", "storage"), [("neural_image", "float32"), ("mipmap", "")])
def test_light_of_textures(mi, name, storage):
    """An emitter's distribution of positions follows its texture; inside a frozen function, none can be computed."""
    texture = examples.example(name, storage)
    down = mi.ScalarTransform4f().translate([0, 0, 2]).rotate([1, 0, 0], 180)
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path"},
        "lamp": {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": texture}},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
        "sensor": {**examples.sensor(mi), "to_world": mi.ScalarTransform4f().look_at([0, -5, 3], [0, 0, 0], [0, 0, 1])},
    }, parallel=False)  # fmt: skip
    params = mi.traverse(scene)
    render, _ = frozen(mi)
    with pytest.raises(RuntimeError) as error:
        render(scene)
    assert "render the scene once before" in compat.one_sentence(error.value)
    first = picture(mi, scene)
    render, _ = frozen(mi)
    np.testing.assert_array_equal(render(scene), first)
    for key in [k for k in params.keys() if "radiance" in k]:
        for factor in (0.9, 0.2, 0.5):
            params[key] = from_numpy(params[key], factor)
            params.update()
            np.testing.assert_allclose(render(scene), picture(mi, scene), atol=1e-6, err_msg=f"{key} {factor}")
    assert np.abs(picture(mi, scene) - first).max() > 1e-3


@pytest.mark.parametrize(
    ("name", "storage", "parameter"),
    [("mipmap", "", "data"), ("neural_image", "float32", "tables.cascaded"), ("neural_bsdf", "", "first.f0")],
)
def test_frozen_training(mi, name, storage, parameter):
    """Render and backward frozen, ``params.update`` outside: the losses and the values are those without freezing."""
    runs = []

    def step(scene, params, seed):
        image = mi.render(scene, params, spp=2, seed=seed)
        loss = dr.sum(dr.square(image - 0.2), axis=None)
        dr.backward(loss)
        return loss

    for function in (step, dr.freeze(step)):
        scene, params, keys = load(mi, name, storage)
        key = next(k for k in keys if k.endswith(parameter))
        optimizer = mi.ad.Adam(lr=0.02)
        optimizer[key] = params[key]
        params.update(optimizer)
        losses = []
        for i in range(4):
            losses.append(float(function(scene, params, dr.opaque(mi.UInt32, i)).array[0]))
            optimizer.step()
            params.update(optimizer)
        runs.append([*losses, *np.ravel(params[key].numpy())[:64]])
    np.testing.assert_allclose(runs[1], runs[0], rtol=1e-5)
    assert function.n_recordings <= 2


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_compile_no_kernels(mi, name):
    """Numbers of Python assigned to all parameters that are numbers, colours or places: the first kernels serve."""
    scene, params, keys = load(mi, name)
    places = [key for key in keys if hasattr(params[key], "inverse_transpose")]
    numbers = [key for key in keys if key not in places and not dr.is_tensor_v(params[key])]
    start = {key: np.array(params[key].matrix, np.float64).reshape(params[key].matrix.shape[0], -1) for key in places}
    assert places or numbers

    def compiled(turn, keys) -> int:
        """The number of kernels compiled for a render after an assignment of new values."""
        for i, key in enumerate(keys):
            if key in places:
                start[key][:-1, -1] += 0.01
                params[key] = type(params[key])(start[key].tolist())
            else:
                params[key] = type(params[key])(0.2 + 0.05 * turn + 0.01 * i)
        params.update()
        dr.eval(mi.render(scene, spp=1, seed=dr.opaque(mi.UInt32, turn)))
        dr.sync_thread()
        kernels = dr.kernel_history()
        dr.kernel_history_clear()
        return sum(compat.was_compiled([kernel]) for kernel in kernels)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        # The first value may no longer be the one that was given
        counts = [compiled(turn, places + numbers) for turn in range(5)]
        if sum(counts[1:]):
            counts = {key: [compiled(turn, [key]) for turn in (5, 6, 7)] for key in places + numbers}
            raise AssertionError(f"kernels compiled for three values: {counts}")


def test_textures_attached_to_another_sensor(mi):
    """A sensor of another projection is read in another way, with as many arrays."""
    parts = examples.scene_parts(mi, "neural_texture")
    pose = mi.ScalarTransform4f().look_at([0, 1, 4], list(examples.CENTRE), [0, 1, 0])
    parallel = mi.ScalarTransform4f().look_at([0, 1, 40], list(examples.CENTRE), [0, 1, 0])
    kinds = {"first": ("perspective", pose), "second": ("orthographic", parallel)}
    film, sampler = examples.sensor(mi)["film"], {"type": "independent", "sample_count": 4}
    sensors = {n: {"type": t, "to_world": m, "film": film, "sampler": sampler} for n, (t, m) in kinds.items()}
    scene = mi.load_dict({**parts, "integrator": {"type": "path"}, **sensors}, parallel=False)
    render, _ = frozen(mi)
    seen = []
    for sensor in scene.sensors():
        mi_diffind.attach(scene, sensor)
        np.testing.assert_allclose(render(scene), picture(mi, scene), atol=1e-6)
        seen.append(render(scene))
    assert np.abs(seen[1] - seen[0]).max() > 1e-3
