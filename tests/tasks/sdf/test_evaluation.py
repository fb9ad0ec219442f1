"""Errors of distance fields and their decoding, against fields whose errors are known by formulas."""

import functools
import math

import drjit as dr
import drjit.llvm.ad as T
import numpy as np
import pytest
import sdf_fields
import solid_meshes as solids
from scipy.ndimage import map_coordinates
from sdf_fields import TrilinearField

from mi_diffind.core.errors import DiffindError
from mi_diffind.tasks.sdf import evaluation, grids
from mi_diffind.tasks.sdf.distances import Distances
from mi_diffind.tasks.sdf.evaluation import BAND, PADDING, SurfaceEvaluation
from mi_diffind.tasks.sdf.field import DistanceField
from mi_diffind.tasks.sdf.mesh import make_mesh


class Ball(sdf_fields.Ball):
    def __init__(self, radius, centre=(0, 0, 0), half=0.55, band=0.05, tilt=0.0):
        super().__init__(T, radius, centre, half, band, tilt)


class Shell(Ball):
    """A ball with a cavity of the radius ``inner`` in its middle."""

    def __init__(self, radius, inner):
        super().__init__(radius)
        self.inner = inner

    def value(self, p, active=True):
        return dr.maximum(super().value(p, active), self.inner - dr.norm(p))


class Union(DistanceField):
    """The smallest of several fields."""

    def __init__(self, *fields):
        super().__init__(T, fields[0].lower, fields[0].upper, fields[0].spacing, fields[0].band)
        self.fields = fields

    def value(self, p, active=True):
        return functools.reduce(dr.minimum, (f.value(p, active) for f in self.fields))

    def gradient(self, p, active=True):
        return self.value(p, active), T.Array3f(p)


@pytest.fixture(scope="module")
def ball():
    """A fine sphere of diameter 1 and distances to it."""
    mesh = make_mesh(*solids.sphere(96), "ball.ply")
    with Distances(mesh) as distances:
        yield mesh, distances


@pytest.fixture(scope="module")
def held_out(ball):
    return SurfaceEvaluation(*ball, count=2**16, seed=3)


# -- held-out points --------------------------------------------------------------------------------------------------


def test_points(held_out):
    e = held_out
    assert e.uniform.shape == e.near.shape == (2**16, 3) and e.surface.shape == e.normals.shape == (2**14, 3)
    assert e.band_volume == pytest.approx(4 / 3 * math.pi * (0.51**3 - 0.49**3), rel=0.01)
    assert np.abs(np.linalg.norm(e.uniform[e.uniform_near], axis=1) - 0.5).max() < BAND + 5e-4
    assert e.uniform.min() >= -0.5 - PADDING - 1e-6 and e.uniform.min() < -0.545
    radius = np.linalg.norm(e.near, axis=1)
    assert np.abs(np.abs(radius - 0.5) - np.abs(e.near_distance)).max() < 5e-4 and np.abs(e.near_distance).max() < BAND
    assert np.mean((e.near_distance < 0) != (radius < 0.5)) < 0.02  # facets lie inside of the sphere
    # Uniform in the band: its shells hold shares of their volumes, its octants an eighth each
    edges = np.linspace(-0.0095, 0.0095, 9)
    share = np.histogram(radius - 0.5, edges)[0] / len(radius)
    volume = np.diff((0.5 + edges) ** 3) / (0.51**3 - 0.49**3)
    assert np.allclose(share, volume, atol=4 * math.sqrt(0.12 / 2**16))
    octants = np.bincount((e.near > 0) @ [1, 2, 4], minlength=8) / len(e.near)
    assert np.allclose(octants, 1 / 8, atol=4 * math.sqrt(0.11 / 2**16))


# -- measures ---------------------------------------------------------------------------------------------------------


def test_a_perfect_field(held_out):
    measured = held_out.measure(Ball(0.5, band=0.05))
    normals = ["normal_deg", "normal_p95_deg", "normal_smooth_deg"]
    assert list(measured) == ["iou", "iou_near", "mae_near", "mae_surface", *normals]
    assert measured["iou"] > 0.998 and measured["iou_near"] > 0.98 and measured["mae_near"] < 2e-4
    assert measured["normal_deg"] < 1.5  # facets of 1.9 degrees
    assert all(isinstance(v, float) for v in measured.values())


def test_errors_are_told(held_out):
    """A ball too small by 0.003, whose gradient is turned by 10° about z, and whose values end at 0.005."""
    measured = held_out.measure(Ball(0.497, band=0.05, tilt=math.radians(10)))
    assert measured["iou"] == pytest.approx((0.497 / 0.5) ** 3, abs=1e-3)
    inside = (0.5**3 - 0.49**3) / (0.51**3 - 0.49**3)
    near = (0.497**3 - 0.49**3) / (0.51**3 - 0.49**3)
    assert measured["iou_near"] == pytest.approx(near / inside, abs=0.01)
    # Truncated to ± 0.01: the last 0.003 on the outer side cannot be told by as much
    r = np.linspace(0.49, 0.51, 2001)
    error = np.abs(np.clip(r - 0.497, -0.01, 0.01) - (r - 0.5))
    assert measured["mae_near"] == pytest.approx(np.average(error, weights=r**2), rel=0.05)
    assert measured["mae_surface"] == pytest.approx(0.003, rel=0.1)
    z = np.linspace(-1, 1, 2001)
    turned = np.degrees(2 * np.arcsin(np.sqrt(1 - z**2) * math.sin(math.radians(5))))
    assert measured["normal_deg"] == pytest.approx(turned.mean(), rel=0.05)
    assert measured["normal_p95_deg"] == pytest.approx(10, rel=0.1)
    assert measured["normal_smooth_deg"] < 1.5
    # A band that ends before the one that is measured counts as an error
    short = held_out.measure(Ball(0.5, band=0.005))["mae_near"]
    assert short == pytest.approx(np.average(np.maximum(np.abs(r - 0.5) - 0.005, 0), weights=r**2), rel=0.05)


def test_distances_beyond_the_band_are_truncated(held_out):
    """A field a hundred times too steep is truncated on both sides of the surface."""

    class Steep(Ball):
        def value(self, p, active=True):
            return 100 * super().value(p, active)

    distance = np.linalg.norm(held_out.near.astype(np.float64), axis=1) - 0.5
    expected = np.abs(np.clip(100 * distance, -BAND, BAND) - distance).mean()
    assert held_out.measure(Steep(0.5))["mae_near"] == pytest.approx(expected, rel=0.02)


def test_iou_knows_what_is_far(held_out):
    """A cavity deep inside and a ball apart count by their volumes."""
    field = Union(Shell(0.5, 0.2), Ball(0.04, (0.45, 0.45, 0.45)))
    assert held_out.measure(field)["iou"] == pytest.approx((0.5**3 - 0.2**3) / (0.5**3 + 0.04**3), abs=2e-3)


def test_iou_of_thin_solids():
    """A rod of a thousandth of the box: its volume is found as exactly as that of a ball."""
    mesh = make_mesh(*solids.box((0.012, 0.012, 1), (0, 0, 0)))

    class Rod(Ball):
        def value(self, p, active=True):
            d = dr.maximum(dr.abs(p.x), dr.abs(p.y)) - 0.0055
            return dr.clip(dr.maximum(d, dr.abs(p.z) - 0.5), -self.band, self.band)

        def gradient(self, p, active=True):
            return self.value(p), T.Array3f(p.x, p.y, 0 * p.z)

    with Distances(mesh) as d:
        measured = SurfaceEvaluation(mesh, d, count=2**14).measure(Rod(0.1))
    assert measured["iou"] == pytest.approx((0.011 / 0.012) ** 2, abs=0.03)
    assert measured["iou_near"] == pytest.approx(measured["iou"])


def test_fields_that_say_nothing(held_out):
    class Nothing(Ball):
        def value(self, p, active=True):
            return T.Float(self.band) + 0 * p.x

        def gradient(self, p, active=True):
            return self.value(p), T.Array3f(0) * p.x

        def normal(self, p, active=True):
            return T.Array3f(math.nan) * p.x

    measured = held_out.measure(Nothing(0.5))
    assert measured["iou"] == measured["iou_near"] == 0
    assert measured["normal_deg"] == measured["normal_smooth_deg"] == 90
    assert math.isfinite(measured["mae_near"])


# -- decoding ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [33, 100])
def test_a_decoded_ball(ball, held_out, resolution):
    """Closed over all blocks, wound outwards, in the frame of the file, and where the ball's surface is."""
    mesh = grids.extract(Ball(0.4, (0.05, -0.02, 0.01)), resolution, 4.0, (1, 2, 3))
    assert mesh.is_watertight and mesh.is_winding_consistent
    radius = np.linalg.norm((mesh.vertices - np.array((1, 2, 3))) / 4 - np.array((0.05, -0.02, 0.01)), axis=1)
    assert np.abs(radius - 0.4).max() < 0.3 * (1.1 / resolution) ** 2 / 0.4 + 2e-5
    volumes = grids.components(mesh)
    assert volumes == pytest.approx([4**3 * 4 / 3 * math.pi * 0.4**3], rel=10 / resolution**2 + 1e-3)


def test_what_the_box_cuts_is_closed():
    mesh = grids.extract(Ball(0.5, band=1, half=0.4), 40)
    assert mesh.is_watertight and len(grids.components(mesh)) == 1
    assert np.abs(mesh.vertices).max() < 0.4 + 0.8 / 40 and mesh.volume > 0.8 * 0.5
    full = grids.extract(Ball(9, band=1, half=0.4), 16)
    assert full.is_watertight and full.volume == pytest.approx(0.8**3, rel=0.15)


def test_pieces_and_cavities():
    field = Union(Shell(0.3, 0.1), Ball(0.03, (0.45, 0.45, 0.45)), Ball(0.02, (-0.45, 0.4, 0)))
    volumes = grids.components(grids.extract(field, 120)) / (4 / 3 * math.pi)
    assert volumes == pytest.approx([0.3**3, -(0.1**3), 0.03**3, 0.02**3], rel=0.15)
    empty = grids.extract(Ball(-1.0), 64)
    assert len(empty.faces) == 0 and len(grids.components(empty)) == 0


def test_values_on_nodes_make_no_cracks():
    """Planes of zeros, and a checkerboard of signs: whatever the values, the surface is closed."""
    rng = np.random.default_rng(0)
    zeros, checked = rng.integers(-1, 2, (37, 35, 33)), rng.choice([-1, 1], (40, 40, 40)) * 1e-7
    for values in (zeros, checked, rng.normal(size=(36, 36, 36))):
        n = np.array(values.shape)
        field = TrilinearField(T.TensorXf(values.astype(np.float32)), [0, 0, 0], (n - 1) / 8, 1.0)
        mesh = grids.extract(field, int(n.max()) - 1)
        count = np.unique(np.sort(mesh.edges, axis=1) @ [len(mesh.vertices), 1], return_counts=True)[1]
        assert np.all(count % 2 == 0) and mesh.is_winding_consistent and mesh.volume > 0


def test_nan_is_outside():
    values = np.full((9, 9, 9), 1, np.float32)
    values[3:6, 3:6, 3:6] = -1
    values[0, 0, 0] = math.nan
    values[5, 5, 5] = math.nan
    mesh = grids.extract(TrilinearField(T.TensorXf(values), [-1] * 3, [1] * 3, 1.0), 8)
    assert np.isfinite(mesh.vertices).all() and mesh.is_watertight and len(grids.components(mesh)) == 1


@pytest.mark.parametrize("resolution", [3, 1025, 12.5, True, "64", None])
def test_resolutions_that_are_none(resolution):
    for function in (grids.extract, grids.grid):
        with pytest.raises(DiffindError, match=r"resolution: found .*, allowed are whole numbers from 4 to 1024"):
            function(Ball(0.5), resolution)


def test_grid():
    """The field at its nodes, z first, on cubic cells that begin at the box's lower corner."""
    field = Ball(0.3, (0.1, 0, 0), band=0.2)
    DistanceField.__init__(field, T, (-0.5, -0.4, -0.33), (0.5, 0.4, 0.3), 0.01, 0.2)
    values, lower, upper = grids.grid(field, 50)
    assert values.shape == (32 + 1, 40 + 1, 50 + 1) and values.dtype == np.float32
    assert np.allclose(lower, field.lower) and np.allclose(upper, (0.5, 0.4, 0.31))
    sides = zip(lower[::-1], upper[::-1], values.shape, strict=True)
    z, y, x = np.meshgrid(*[np.linspace(a, b, n) for a, b, n in sides], indexing="ij")
    truth = np.clip(np.sqrt((x - 0.1) ** 2 + y**2 + z**2) - 0.3, -0.2, 0.2)
    assert np.abs(values - truth)[:-1, 1:-1, 1:-1].max() < 1e-5 and np.all(values[-1] == np.float32(0.2))


def test_how_fine_a_grid_has_to_be():
    """A ball's trilinear error goes with the square of the cells; a coarse grid is found for a large error."""
    field = Ball(0.3, band=0.2)
    points = grids.surface_points(field, 20000)
    length = np.linalg.norm(points, axis=1)
    assert len(points) == 20000 and np.abs(length - 0.3).max() < 1e-4 and np.abs(points.mean(axis=0)).max() < 0.005
    errors = [grids.trilinear_error(field, points, n) for n in (50, 100, 200)]
    # ½ Σ w(1 − w) h² f″ with curvatures 1/r in two directions, whose average is taken off: E |Σ nᵢ (1/6 − w(1 − w))|
    rng = np.random.default_rng(1)
    w = rng.random((10**6, 3))
    n = rng.normal(size=w.shape)
    share = 1 - n**2 / (n**2).sum(axis=1, keepdims=True)
    expected = np.abs(0.5 * ((w * (1 - w) - 1 / 6) * share).sum(axis=1)).mean()
    for n, error, rel in zip((50, 100, 200), errors, (0.15, 0.05, 0.03), strict=True):
        assert error == pytest.approx(expected * (1.1 / n) ** 2 / 0.3, rel=rel)
    for error in (1e-3, 1e-4, 2e-5):
        chosen, measured = grids.resolution_for(field, error)
        assert measured <= error and grids.trilinear_error(field, points, chosen) == pytest.approx(measured, rel=0.05)
        assert grids.trilinear_error(field, points, int(chosen / 1.04)) > 0.98 * error
    chosen, measured = grids.resolution_for(field, 2e-5, finest=60)
    assert chosen == 60 and measured > 2e-5
    assert measured == pytest.approx(grids.trilinear_error(field, points, 60), rel=0.05)
    assert grids.resolution_for(field, 0, finest=60)[0] == 60
    assert grids.resolution_for(Ball(-0.1), 1e-3) == (8, 0)  # no surface


def test_interpolable_grids():
    """Nodes beside the surface move and no others, none to the other side, and interpolation errs less."""
    field = Ball(0.3, (0.1, 0, 0), band=0.1)
    values, lower, _ = grids.grid(field, 24)
    moved = values.copy()
    moved[1:-1, 1:-1, 1:-1] = grids.sharpen(values, field.band)
    assert ((moved < 0) == (values < 0)).all()
    changed = np.abs(moved - values) > 1e-7
    assert changed.mean() > 0.05 and np.abs(values[changed]).max() < field.band
    points = grids.surface_points(field, 10000)
    place = ((points - lower) / (1.1 / 24)).T[::-1]
    errors = [np.abs(map_coordinates(v.astype(np.float64), place, order=1)).mean() for v in (values, moved)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[1] == pytest.approx(grids.trilinear_error(field, points, 24), rel=1e-3)


def test_lost_pieces():
    """A piece that is smaller than the cells is missing in the field, and is counted."""
    balls = (1, (0, 0, 0)), (0.02, (1.5, 0, 0)), (0.02, (0, 1.4, 0))
    mesh = make_mesh(*solids.together(*(solids.sphere(12, *ball) for ball in balls)))
    parts = [Ball(r / mesh.scale, ((np.array(c) - mesh.centre) / mesh.scale).tolist(), half=0.6) for r, c in balls]
    with Distances(mesh) as d:
        for missing in (0, 1, 2, 3):
            field = Union(*parts[missing:]) if missing < 3 else Ball(-1.0)
            assert evaluation.lost_pieces(field, d) == missing
