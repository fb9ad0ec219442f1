"""Meshes in the unit frame and distances to them: against formulas, brute force, and meshes that are broken."""

import os
import signal
import sys

import numpy as np
import pytest
import solid_meshes as solids
import trimesh
from scipy.spatial import KDTree

from mi_diffind.core.errors import DiffindError
from mi_diffind.tasks.sdf.distances import (
    CORNERS,
    Distances,
    DistancesError,
    near_nodes,
    sample_box,
    sample_near,
    sample_surface,
    surface_cells,
)
from mi_diffind.tasks.sdf.mesh import Mesh, MeshError, load_mesh, make_mesh


def sentence(error):
    text = str(error.value)
    assert isinstance(error.value, DiffindError) and "\n" not in text and not text.endswith("."), text
    return text


def inside_share(mesh, distances, count=40000):
    """The share of the bounding box that is inside, by points."""
    points = sample_box(mesh.lower, mesh.upper, count, 5)
    return distances.inside(points).mean()


# -- meshes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.off", "a.obj", "a.ply", "a.stl", "a.glb"])
def test_formats(tmp_path, name):
    """Each format gives the same solid; STL and the like have each corner by itself, which are joined again."""
    vertices, faces = solids.box((2, 1, 0.5), (10, -3, 4))
    mesh = load_mesh(solids.write(tmp_path / name, (vertices, faces)))
    assert mesh.watertight and mesh.components == 1 and mesh.warnings == [] and mesh.path == str(tmp_path / name)
    assert mesh.vertices.shape == (8, 3) and mesh.faces.shape == (12, 3) and mesh.faces.dtype == np.int32
    assert mesh.scale == pytest.approx(2) and mesh.centre == pytest.approx((10, -3, 4))
    assert np.allclose(mesh.upper, [0.5, 0.25, 0.125]) and np.allclose(mesh.lower, -mesh.upper)
    assert mesh.volume == pytest.approx(1 / 8) and mesh.area == pytest.approx(7 / 4)
    assert np.allclose(np.sort(mesh.to_file_frame(mesh.vertices), axis=0), np.sort(vertices, axis=0))


def test_scene_is_placed(tmp_path):
    """A scene's meshes are taken together where transforms put them, mirrored ones are turned."""
    scene = trimesh.Scene()
    cube = trimesh.Trimesh(*solids.box(), process=False)
    scene.add_geometry(cube, transform=np.diag([1.0, 1, 2, 1]))
    mirror = np.diag([-1.0, 1, 1, 1])
    mirror[0, 3] = 3
    scene.add_geometry(cube, transform=mirror)
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")
    assert mesh.components == 2 and mesh.watertight and mesh.warnings == []
    assert mesh.volume * mesh.scale**3 == pytest.approx(3) and mesh.scale == pytest.approx(4)


def test_scale_and_place_do_not_matter():
    vertices, faces = solids.sphere(8)
    reference = make_mesh(vertices, faces)
    points = sample_near(reference, 500, 0.05, 1)
    with Distances(reference) as d:
        truth = d.signed(points)
    for scale, centre in ((1e-6, 1e-3), (1e6, -1e9)):
        mesh = make_mesh(vertices * scale + centre, faces)
        assert mesh.scale == pytest.approx(2 * scale) and mesh.centre == pytest.approx([centre] * 3)
        with Distances(mesh) as d:
            assert np.allclose(d.signed(points), truth, atol=1e-6)


POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\n" + b"".join(b"property float %c\n" % c for c in b"xyz")
GLB = trimesh.Trimesh(*solids.box()).export(file_type="glb")


@pytest.mark.parametrize(
    "name, content, result",
    [
        ("a.off", b"", "cannot be read as a mesh"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0", "cannot be read as a mesh"),
        ("a.off", b"\x00\xff\xfe nonsense", "cannot be read as a mesh"),
        ("a.off", b"OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", ""),
        ("a.glb", GLB[: len(GLB) // 2], "cannot be read as a mesh"),
        ("a.xyzzy", b"what", "cannot be read as a mesh"),
        ("a.ply", POINTS + b"end_header\n0 0 0\n", "has no triangles"),
        ("none.ply", None, "there is no such file"),
        ("", None, "is a folder"),
    ],
)
def test_unreadable_files(tmp_path, name, content, result):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MeshError) as error:
        load_mesh(path)
    assert result in sentence(error) and str(error.value).startswith(str(path))


NOTHING = np.zeros((0, 3), int)


@pytest.mark.parametrize(
    "vertices, faces, result",
    [
        (np.zeros((0, 3)), NOTHING, "has no triangles"),
        (np.eye(3), NOTHING, "has no triangles"),
        (np.eye(3), [[0, 1, 3]], "names vertex 3, there are vertices 0 to 2"),
        (np.eye(3), [[0, 1, -1]], "a triangle names vertex"),
        (np.eye(3), [[0, 1]], "expected (V, 3) and (F, 3)"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, np.nan]], [[0, 1, 2]], "NaN or infinite"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, np.inf]], [[0, 1, 2]], "NaN or infinite"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], "flat, its extent along z is 0"),
        ([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2]], "no triangle that has an area"),
        ([[0, 0, 0], [1, 1, 1], [2, 2, 3]], [[0, 1, 1], [2, 2, 0]], "no triangle that has an area"),
        ([[5, 5, 5]] * 3, [[0, 1, 2]], "has the extent 0"),
        ([[0, 0, 0], [1e200, 0, 0], [0, 1e200, -1e200]], [[0, 1, 2]], ""),
        ([[-1e308, 0, 0], [1e308, 0, 0], [0, 1e308, 1e308]], [[0, 1, 2]], "has the extent inf"),
    ],
)
def test_meshes_that_are_none(vertices, faces, result):
    """Refused when they are read, or at the latest when distances are asked for; always in one sentence."""
    with pytest.raises((MeshError, DistancesError)) as error, Distances(make_mesh(vertices, faces, "a.ply")) as d:
        d.signed(np.zeros((1, 3)))
    assert result in sentence(error) and str(error.value).startswith("a.ply: ")


def test_degenerate_triangles_are_left_out():
    vertices, faces = solids.box()
    vertices = np.concatenate([vertices, [[0, 0, 0], (vertices[0] + vertices[1]) / 2]])
    faces = np.concatenate([faces, [[0, 0, 1], [3, 3, 3], [0, 9, 1]]])
    mesh = make_mesh(vertices, faces, "a.ply")
    assert len(mesh.faces) == 12 and len(mesh.vertices) == 8
    assert "a.ply: 3 triangles without an area were left out" in mesh.warnings


def test_a_sliver_may_hold_a_mesh_together():
    """A T-junction closed by a triangle without an area: left out, and the mesh is watertight all the same."""
    vertices, faces = solids.box()
    a, b, c = faces[0]
    middle = len(vertices)
    vertices = np.concatenate([vertices, [(vertices[a] + vertices[b]) / 2]])
    faces = np.concatenate([faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    mesh = make_mesh(vertices, faces)
    assert mesh.watertight and len(mesh.faces) == 13 and mesh.volume == pytest.approx(1)
    assert mesh.warnings == ["mesh: 1 triangles without an area were left out"]


def test_orientation_is_repaired():
    ball = solids.sphere(8)
    volume = make_mesh(*ball).volume
    mesh = make_mesh(*solids.turned(ball))
    assert mesh.volume == pytest.approx(volume) and "all triangles were wound inside out" in mesh.warnings[0]
    some = (ball[0], np.where(np.arange(len(ball[1]))[:, None] % 5 == 0, ball[1][:, ::-1], ball[1]))
    mesh = make_mesh(*some)
    assert mesh.volume == pytest.approx(volume) and mesh.watertight
    assert "wound against their neighbours were turned" in mesh.warnings[0]
    # One of two pieces; but a cavity is meant to be the wrong way round, and so is a ball in it the right one
    beside = solids.sphere(8, 0.5, (3, 0, 0))
    mesh = make_mesh(*solids.together(ball, solids.turned(beside)))
    assert mesh.volume * mesh.scale**3 == pytest.approx(volume * 8 * 9 / 8, rel=1e-3)
    shell = solids.together(ball, solids.turned(solids.sphere(8, 0.5)), solids.sphere(8, 0.25))
    mesh = make_mesh(*shell)
    assert mesh.volume == pytest.approx(volume * (1 - 1 / 8 + 1 / 64)) and mesh.warnings == []


# -- distances --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 0.6, 0.3), (0.05, 0.05, 1), (1, 1, 0.001)])
def test_distances_of_a_box(size):
    """Boxes, a rod and a plate, against the formula, in a frame where the longest side is 1."""
    size = np.array(size)
    mesh = make_mesh(*solids.box(7 * size, (3, 2, 1)))
    near = sample_near(mesh, 3000, min(0.01, 0.3 * size.min()), 1)
    points = np.concatenate([sample_box([-0.7] * 3, [0.7] * 3, 3000, 0), near])
    with Distances(mesh) as d:
        truth = solids.box_distance(points, size)
        result = d.signed(points)
        assert result.dtype == np.float32 and np.abs(result - truth).max() < 1e-6
        assert np.array_equal(d.inside(points), truth < 0)
        assert np.abs(d.signed(points, 0.05) - truth.clip(-0.05, 0.05)).max() < 1e-6
        value, gradient = d.signed_normals(points)
        step = 1e-5
        ahead = solids.box_distance(points + step * gradient, size)
    assert np.array_equal(value, result) and np.allclose(np.linalg.norm(gradient, axis=1), 1, atol=1e-5)
    several = np.abs(truth) < 2 * step  # a step may go through the box
    assert np.quantile(np.abs((ahead - truth) / step - 1)[~several], 0.99) < 1e-3  # but for several nearest points


def test_distances_and_windings_of_a_bad_mesh():
    """A random soup of triangles, against brute force: |d|, winding numbers and which triangle is nearest."""
    rng = np.random.default_rng(3)
    mesh = make_mesh(rng.random((40, 3)), rng.permuted(np.tile(np.arange(40), (60, 1)), axis=1)[:, :3])
    points = rng.uniform(-0.6, 0.6, (500, 3))
    with Distances(mesh) as d:
        (distance,) = d._ask("distance", points, "mesh", mesh)
        assert np.abs(distance - solids.brute_distance(points, mesh.corners)).max() < 1e-9
        winding, truth = d.winding(points), solids.brute_winding(points, mesh.corners)
    assert np.abs(winding - truth).max() < 0.05
    near = np.abs(truth - 0.5) < 0.02
    assert near.any() and np.abs(winding - truth)[near].max() < 1e-5


def test_on_the_surface():
    """Points of the surface have a distance of 0 and the triangle's normal, whatever their rounding."""
    mesh = make_mesh(*solids.sphere(16))
    points, normals = sample_surface(mesh, 4000, 2)
    with Distances(mesh) as d:
        value, gradient = d.signed_normals(points)
        _, face, closest = d.nearest(points)
    assert np.abs(value).max() < 1e-12 and np.abs(gradient - normals).max() < 1e-6
    assert np.abs(closest - points).max() < 1e-12 and np.all(
        np.linalg.norm(mesh.normals[face] - normals, axis=1) < 1e-9
    )


def test_questions_of_any_length():
    mesh = make_mesh(*solids.box())
    with Distances(mesh) as d:
        assert d.signed(np.zeros((0, 3))).shape == (0,) and d.signed(np.zeros((1, 3))) == pytest.approx(-0.5)
        assert d.nearest(np.zeros((0, 3)))[2].shape == (0, 3)
        many = np.zeros((300_001, 3))
        many[:, 0] = np.linspace(0, 0.6, len(many))
        assert np.allclose(d.signed(many), many[:, 0] - 0.5, atol=1e-6)
        for bad in (np.zeros(3), np.zeros((2, 2)), np.full((1, 3), np.nan)):
            with pytest.raises(ValueError, match="points: "):
                d.signed(bad)


# -- what open, overlapping and thin meshes enclose -------------------------------------------------------------------


def test_an_open_mesh_is_closed():
    """A bowl: its opening is closed flat, and the doubt about it is told."""
    vertices, faces = solids.sphere(24)
    open_mesh = solids.without((vertices, faces), vertices[faces][:, :, 2].max(axis=1) > 0.2)
    mesh = make_mesh(*open_mesh, "bowl.ply")
    assert not mesh.watertight and "bowl.ply: is not closed" in mesh.warnings[0]
    with Distances(mesh) as d:
        assert d.solid.watertight and 0.3 < d._doubt[0] < 0.9
        doubt = [w for w in d.warnings if "ambiguous" in w]
        assert len(doubt) == 1 and doubt[0].startswith("bowl.ply: ") and "%" in doubt[0]
        assert f"{100 * d._doubt[0]:.2g}%" in doubt[0]
        # On the axis, from the bottom to beyond the opening: the distance to the lid's plane
        lid = mesh.upper[2]
        points = np.array([[0, 0, lid - 0.05], [0, 0, lid + 0.05]])
        assert np.allclose(d.signed(points), [-0.05, 0.05], atol=0.01)
        cells = surface_cells(d, mesh.lower - 1 / 32, 1 / 32, (36, 36, 36))
        middle = np.floor((np.array([0, 0, lid]) - mesh.lower + 1 / 32) * 32).astype(int)
        assert np.any(np.all(np.abs(cells - middle) <= 1, axis=1)), "the lid is part of the surface"


def test_a_small_hole_is_a_small_doubt():
    mesh = make_mesh(*solids.without(solids.sphere(16), [100]))
    with Distances(mesh) as d:
        assert d.solid.watertight and 0 < d._doubt[0] < 0.02
        assert inside_share(mesh, d) == pytest.approx(np.pi / 6, abs=0.02)


def test_cracks_everywhere():
    """Triangles that do not meet: closing each would enclose nothing, winding numbers tell."""
    vertices, faces = solids.sphere(16)
    corners = vertices[faces] + np.random.default_rng(0).normal(scale=1e-4, size=(len(faces), 3, 3))
    mesh = make_mesh(corners.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))
    with Distances(mesh) as d:
        assert d.solid is mesh and inside_share(mesh, d) == pytest.approx(np.pi / 6, abs=0.02)


@pytest.mark.parametrize("shift", [(0.5, 0.3, 0.2), (0.5, 0, 0), (1, 0, 0)])
def test_overlapping_boxes_are_their_union(shift):
    """Distances inside are those to the union's surface, not to buried sides, also where sides coincide."""
    mesh = make_mesh(*solids.together(solids.box(), solids.box(centre=shift)))
    points = sample_box([-0.6] * 3, [0.6] * 3, 4000, 1)
    with Distances(mesh) as d:
        result, surface = d.signed(points), d.surface
        warnings = [w for w in d.warnings if "pieces overlap" in w]
    file = mesh.to_file_frame(points)
    a, b = solids.box_distance(file, (1, 1, 1)), solids.box_distance(file, (1, 1, 1), shift)
    assert np.array_equal(result < 0, np.minimum(a, b) < 0) and warnings
    outside = result > 0
    assert np.abs(result - np.minimum(a, b) / mesh.scale)[outside].max() < 0.01
    # The exact distance to the union's surface: to all points of either box in front of which neither is
    cloud, normals = sample_surface(make_mesh(*solids.box()), 40000, 2)
    cloud, ahead = (np.concatenate([c, c + np.array(shift)]) for c in (cloud, cloud + 1e-6 * normals))
    seen = np.minimum(solids.box_distance(ahead, (1, 1, 1)), solids.box_distance(ahead, (1, 1, 1), shift)) > 0
    truth, _ = KDTree(cloud[seen]).query(file)
    error = np.abs(np.abs(result) - truth / mesh.scale)
    assert np.quantile(error, 0.99) < 0.01 and error.max() < 0.02
    assert surface.area < mesh.area


def test_a_sheet_has_no_part():
    """A sheet without a thickness beside a ball: nothing is inside of it, and no distance leads to it."""
    sheet = np.array([[2, -1, -1], [2, 1, -1], [2, 1, 1], [2, -1, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    both = solids.together(solids.sphere(12), sheet, solids.turned(sheet))
    mesh = make_mesh(*both)
    with Distances(mesh) as d:
        at = (np.array([[1.9, 0.2, 0.1]]) - mesh.centre) / mesh.scale
        assert d.signed(at) == pytest.approx((np.linalg.norm([1.9, 0.2, 0.1]) - 1) / mesh.scale, rel=0.02)


# -- cells and grids --------------------------------------------------------------------------------------------------


def test_surface_cells_miss_nothing():
    """All cells with a point of the surface in them are named, once, and none further than its half diagonal."""
    mesh = make_mesh(*solids.together(solids.sphere(16), solids.box((0.02, 0.02, 1.5), (1.2, 0, 0))))
    spacing, lower = 1 / 50, mesh.lower - 0.03
    shape = np.ceil((mesh.upper + 0.03 - lower) / spacing).astype(int)
    with Distances(mesh) as d:
        cells = surface_cells(d, lower, spacing, shape)
        wide = surface_cells(d, lower, spacing, shape, reach=0.05)
        everywhere = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
        distance = d.unsigned(lower + (everywhere + 0.5) * spacing)
    points, _ = sample_surface(mesh, 200_000, 0)
    hit = np.unique(np.floor((points - lower) / spacing).astype(int), axis=0)
    named = set(map(tuple, cells.tolist()))
    assert len(named) == len(cells) and cells.dtype == np.int32 and set(map(tuple, hit.tolist())) <= named
    half = np.sqrt(3) / 2 * spacing
    assert np.array_equal(cells, everywhere[distance <= half * (1 + 1e-6)])
    assert np.array_equal(wide, everywhere[distance <= (half + 0.05) * (1 + 1e-6)])
    nodes, corners = near_nodes(cells)
    assert np.array_equal(nodes[corners], cells[:, None] + CORNERS) and len(np.unique(nodes, axis=0)) == len(nodes)
    assert np.array_equal(nodes, nodes[np.lexsort(nodes.T[::-1])])
    assert near_nodes(cells[:0])[0].shape == (0, 3) and near_nodes(cells[:0])[1].shape == (0, 8)


def test_samples():
    mesh = make_mesh(*solids.together(solids.box(), solids.box((0.1, 0.1, 0.1), (2, 0, 0))))
    points, normals = sample_surface(mesh, 10_000, 7)
    assert np.array_equal(points, sample_surface(mesh, 10_000, 7)[0])
    assert not np.array_equal(points, sample_surface(mesh, 10_000, 8)[0])
    small = mesh.to_file_frame(points)[:, 0] > 1
    assert abs(small.sum() - 10_000 * 0.06 / 6.06) <= 1, "each part of the surface gets its share"
    with Distances(mesh) as d:
        assert d.unsigned(points).max() < 1e-12
    sides = points[~small & (normals[:, 2] > 0.9)]
    assert np.allclose(np.histogram2d(sides[:, 0], sides[:, 1], bins=4)[0], len(sides) / 16, rtol=0.4)


# -- the process ------------------------------------------------------------------------------------------------------


def test_a_child_that_dies_is_one_sentence():
    """Killed in the middle, as by an abort of libigl: the parent lives, and the next question starts it anew."""
    mesh = make_mesh(*solids.box(), "box.ply")
    with Distances(mesh) as d:
        assert d.signed(np.zeros((1, 3))) == pytest.approx(-0.5)
        os.kill(d._child.process.pid, signal.SIGABRT)
        d._child.process.wait()
        with pytest.raises(DistancesError) as error:
            d.signed(np.zeros((1, 3)))
        assert "box.ply: libigl ended" in sentence(error) and "SIGABRT" in str(error.value)
        assert d.signed(np.zeros((1, 3))) == pytest.approx(-0.5)
        child = d._child
    assert child.process.poll() is not None, "it ends with the block"


def test_a_mesh_on_which_libigl_crashes():
    """A vertex that is not there, past the checks of files; and vertices that libigl refuses by an exception."""
    for vertices, vertex, says in ((np.eye(3), 2_000_000_000, "ended while"), (np.zeros(3), 2, "finds no distances")):
        mesh = Mesh(vertices, np.array([[0, 1, vertex]]), True, path="bad.ply")
        with Distances(mesh) as d, pytest.raises(DistancesError, match=f"bad.ply: libigl {says}") as error:
            d.winding(np.zeros((10, 3)))
        assert ("SIG" in sentence(error)) == (says == "ended while")


def test_without_libigl(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with Distances(make_mesh(*solids.box(), "box.ply")) as d, pytest.raises(DistancesError) as error:
        d.signed(np.zeros((1, 3)))
    assert "box.ply: distances need the package libigl" in sentence(error) and "pip install libigl" in str(error.value)


@pytest.mark.skipif(sys.platform != "linux", reason="signals")
def test_ctrl_c_ends_a_question():
    """A Ctrl-C in the middle of a question goes through, and the next one is answered rightly."""
    mesh = make_mesh(*solids.sphere(16))
    points = sample_box([-0.6] * 3, [0.6] * 3, 2**19, 0)
    with Distances(mesh) as d:
        few = d.signed(points[:100])
        handler = signal.getsignal(signal.SIGINT)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.1)
            with pytest.raises(KeyboardInterrupt):
                while True:
                    d.unsigned(points)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGINT, handler)
        assert np.array_equal(d.signed(points[:100]), few)
