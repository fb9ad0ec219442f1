"""Radiance fields that are formulas, for tests, and how a scene gets them."""

import drjit as dr
import numpy as np

from mi_diffind import plugins
from mi_diffind.tasks.radiance.volume_field import VolumeField


class Fog(VolumeField):
    """A box from −1 to 1 that is the same everywhere: ``density``, and a radiance ``colour``, both of which may be
    optimised.
    """

    def __init__(self, types, density=1.0, colour=(0.2, 0.5, 0.8), voxel=0.1, half=(1.0, 1.0, 1.0)):
        arrays = {"density": np.array([density]), "colour": np.array(colour)}
        arrays = {name: types.TensorXf(values.astype(np.float32)) for name, values in arrays.items()}
        super().__init__(types, [-h for h in half], half, voxel, arrays)

    def density_at(self, p, active=True):
        density = dr.gather(self.types.Float, self.arrays["density"].array, self.types.UInt32(0), active)
        return density, []

    def radiance_at(self, point_data, p, d, active=True):
        array = self.arrays["colour"].array
        return [dr.gather(self.types.Float, array, self.types.UInt32(i), active) for i in range(3)]


class Bumps(VolumeField):
    """
    Smooth bumps in a box from −1 to 1: ``arrays`` hold the heights of the densities and, in four numbers, colours that
    depend on the direction. ``empty``: half of the box (x > 0) is empty, known to ``free_distance`` unless ``blind``.
    """

    CENTRES = np.array([[-0.5, -0.3, 0.1], [-0.2, 0.4, -0.3], [0.4, 0.1, 0.3]])

    def __init__(self, types, height=4.0, voxel=0.05, empty=False, blind=False):
        rng = np.random.default_rng(4)
        arrays = {"density": height * (0.5 + rng.random(3)), "colour": rng.random((3, 4)) + 0.2}
        arrays = {name: types.TensorXf(values.astype(np.float32)) for name, values in arrays.items()}
        super().__init__(types, (-1,) * 3, (1,) * 3, voxel, arrays)
        self.empty, self.blind = empty, blind

    def _shapes(self, p):
        for c in self.CENTRES.tolist():
            yield dr.exp(-8 * sum(dr.square(x - a) for x, a in zip(p, c, strict=True)))

    def _read(self, name, i, active):
        return dr.gather(self.types.Float, self.arrays[name].array, self.types.UInt32(i), active)

    def density_at(self, p, active=True):
        active = self.types.Bool(active)
        if self.empty:
            active &= p.x < 0
        shapes = list(self._shapes(p))
        density = sum(shape * self._read("density", i, active) for i, shape in enumerate(shapes))
        return dr.select(active, density, 0), shapes

    def radiance_at(self, point_data, p, d, active=True):
        numbers = [sum(s * self._read("colour", 4 * i + k, active) for i, s in enumerate(point_data)) for k in range(4)]
        return [numbers[c] * (1 + 0.5 * numbers[3] * d[c]) for c in range(3)]

    def free_distance(self, p, d, active=True):
        if not self.empty or self.blind:
            return self.types.Float(0)
        away = dr.select(d.x < 0, p.x / dr.maximum(-d.x, 1e-6), 10)
        return dr.select((p.x > 0) & active, away, 0)


def haze(types, rng, centre=(0.2, -0.1, 0.3), half=0.7, side=13):
    """A field of random numbers with surroundings, thin enough that rays see the horizon."""
    from mi_diffind.tasks.radiance.nodes import Nodes
    from mi_diffind.tasks.radiance.volume_field import NodeField

    place = np.subtract(centre, 2 * half), 4 * half / (side - 1), (side,) * 3, np.ones((side,) * 3, bool)
    nodes = Nodes(types, *place, inner=(*centre, half))
    density, colour = rng.normal(-4, 2, nodes.entries), rng.normal(0, 0.3, (nodes.entries, 12))
    return NodeField(nodes, *(types.TensorXf(np.float32(v)) for v in (density, colour)))


def ball_table(inner=None):
    """The table of a ball that is red to the left and blue to the right, in half precision.

    With ``inner`` (centre and half side of a cube), a thin haze fills all space in place of the ball.
    """
    import drjit.llvm as types

    from mi_diffind.tasks.radiance import files, nodes
    from mi_diffind.tasks.radiance.grid import NodeGrid

    side, spacing = 25, 0.1
    place = np.stack(np.meshgrid(*[spacing * np.arange(side) - 1.2] * 3, indexing="ij"), -1)
    radius = np.linalg.norm(place, axis=-1)
    grid = types, (-1.2,) * 3, spacing, (side,) * 3
    if inner is None:
        stored = nodes.Nodes(*grid, radius < 1)
        raw = np.clip(12 * (0.8 - radius), -6, 4)[stored.stored]
    else:
        stored = nodes.Nodes(*grid, np.ones((side,) * 3, bool), inner=inner)
        raw = np.full(side**3, -5.0)
    colour = np.zeros((stored.count, 12))
    colour[:, 0], colour[:, 4], colour[:, 8] = -place[stored.stored][:, 0], -1, place[stored.stored][:, 0]
    return files.grid_table(NodeGrid(stored, np.append(-9, raw), np.concatenate([np.zeros((1, 12)), colour])))


def register(mi, fields: dict, name: str = "test_field") -> None:
    """An integrator ``name``: ``neural_field``, of which ``field`` is the key of one in ``fields``."""
    # The module is another one in each variant
    integrator = plugins.declared()["neural_field"].factory.__globals__["integrator"]()
    mi.register_integrator(name, lambda props: integrator(props, fields[props["field"]]))
