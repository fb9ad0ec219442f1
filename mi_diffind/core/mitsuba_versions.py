"""What Mitsuba 3.9 and 3.10 do in different ways, a function a thing: today's way, or the newer one where it exists.

Each asks Mitsuba what it has, never for its version, so that a development build works, too. What a function takes from
3.10 was read in its sources and has not run (``docs/next_mitsuba.md``; ``tests/test_mitsuba_versions.py`` simulates
what can be simulated). Other hooks into Mitsuba are in :mod:`.compat`.
"""

from __future__ import annotations


def has_footprints() -> bool:
    """Return whether hits carry the footprint of a pixel, from ray cones: ``si.footprint`` (Mitsuba 3.10, #1964)."""
    import mitsuba as mi

    return hasattr(mi.SurfaceInteraction3f, "footprint")


def footprint_of(si) -> tuple | None:
    """Return ``si.footprint`` as two diameters in uv, ``mi.Vector2f`` each; ``None`` in Mitsuba 3.9, which has none.

    It is a matrix of which the columns are conjugate diameters of an ellipse. It is zero where no ray cone arrived:
    after the first bounce, and in scenes of which no texture returns true from ``filtered()``.
    """
    import mitsuba as mi

    matrix = getattr(si, "footprint", None)
    if matrix is None:
        return None
    return mi.Vector2f(matrix[0, 0], matrix[1, 0]), mi.Vector2f(matrix[0, 1], matrix[1, 1])


def ray_flags(curvature: bool = False) -> int:
    """Return the ``mi.RayFlags`` for all of an interaction, the footprint included, and with ``curvature`` ``dn_du``.

    In Mitsuba 3.10, ``Default`` is all but the derivatives of normals, ``NormalPartials``; ``All`` is the shading frame
    alone. There ``dNSdUV`` is gone.
    """
    import mitsuba as mi

    flags = mi.RayFlags
    if hasattr(flags, "NormalPartials"):
        return flags.Default | flags.NormalPartials if curvature else flags.Default
    return flags.All | flags.dNSdUV if curvature else flags.All


def normal_mapped() -> int:
    """Return the ``mi.BSDFFlags`` of a BSDF whose normals are those of a map, 0 in Mitsuba 3.9, which has none.

    In Mitsuba 3.10, meshes align the shading frame with uv for such BSDFs; where uv are mirrored, the frame is
    left-handed (``si.frame_flipped``), so that directions and normals in it need no change.
    """
    import mitsuba as mi

    return getattr(mi.BSDFFlags, "NormalMapped", 0)


def shapes_in_python() -> bool:
    """Return whether ``mi.Shape`` can be derived from in Python (Mitsuba 3.10, #1967), not only ``mi.Mesh``.

    ``mi.Shape`` has a constructor of its own then, as ``mi.Mesh`` has.
    """
    import mitsuba as mi

    return type(mi.Shape.__init__) is type(mi.Mesh.__init__)


def lobe_rates() -> tuple[str, ...]:
    """Return the parameters of ``principled`` that say how often its lobes are sampled; none in Mitsuba 3.10 (#1951).

    There it chooses lobes by their energy, accepts the parameters and ignores them.
    """
    import mitsuba as mi

    names = mi.traverse(mi.load_dict({"type": "principled"})).keys()
    return tuple(sorted(name for name in names if name.endswith("_sampling_rate")))


#: Mitsuba's classes of which ``Field`` shall take the place (#1885, open).
FIELDS = ("Texture", "Volume")


def base_class(name: str) -> type:
    """Return the class of this name that plugins derive from; ``mi.Field`` where it has taken its place."""
    import mitsuba as mi

    return getattr(mi, "Field" if name in FIELDS and not hasattr(mi, name) else name)


def object_type(name: str):
    """Return the ``mi.ObjectType`` of a class's name; that of fields where they have taken its place."""
    import mitsuba as mi

    return getattr(mi.ObjectType, "Field" if name in FIELDS and not hasattr(mi.ObjectType, name) else name)


def register(object_type: str, name: str, factory) -> None:
    """Register a plugin with the variant that is set.

    Mitsuba has no ``register_volume``; in a scene, volumes are looked up among textures, or among fields (#1885).
    """
    import mitsuba as mi

    if object_type in ("texture", "volume"):
        function = getattr(mi, "register_texture", None) or mi.register_field
    else:
        function = getattr(mi, f"register_{object_type}")
    function(name, factory)


def mesh_arguments(props, vertices: int, faces: int) -> tuple:
    """Return the arguments of ``mi.Mesh`` for a mesh of so many vertices and triangles, to be set afterwards.

    The mesh of Mitsuba 3.10 takes its size from the arrays.
    """
    import mitsuba as mi

    return (props,) if hasattr(mi.Mesh, "from_fields") else (props.plugin_name(), vertices, faces, props)


def set_triangles(params, positions, faces) -> None:
    """Set the places ``(n, 3)`` and the triangles ``(m, 3)`` of a traversed mesh, NumPy arrays, without an update.

    Mitsuba 3.10 has tensors under other names (its new mesh class, of August 2026).
    """
    import mitsuba as mi
    import numpy as np

    positions, faces = np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces, np.uint32)
    if "vertex_positions" in params:
        params["vertex_positions"], params["faces"] = positions.ravel(), faces.ravel()
    else:
        params["positions"], params["faces"] = mi.TensorXf(positions), mi.TensorXu(faces)


def triangles(mesh) -> tuple:
    """Return the places ``(n, 3)`` and the triangles ``(m, 3)`` of a ``mi.Mesh`` as NumPy arrays."""
    before = ("vertex_positions_buffer", "faces_buffer")
    names = before if hasattr(mesh, before[0]) else ("positions", "faces")
    positions, faces = (getattr(mesh, name)().numpy().reshape(-1, 3) for name in names)
    return positions, faces
