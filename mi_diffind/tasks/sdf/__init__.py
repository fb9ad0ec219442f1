"""Task 6: signed distance fields of meshes.

- :mod:`.mesh`, :mod:`.distances`: ground truth;
- :mod:`.field`: interface of all fields; :mod:`.nodes`: our sparse layout; :mod:`.paper`: the supplement's arrays;
- :mod:`.encoding`, :mod:`.fit`: training; :mod:`.evaluation`: errors;
- :mod:`.marching`: rays; :mod:`.grids`: decoding to grids and triangles;
- :mod:`.model`: table files.
"""

from ...core import units
from ...core.arguments import Argument, between, checked, positive
from ...fitting.task import FitSettings, Task

#: Bits of a pointer that divide words evenly (:data:`.nodes.POINTERS`, without importing Dr.Jit).
BITS = (4, 5, 6, 8, 10, 16)

#: Settings of both presets with dense arrays.
PAIR_SETTINGS = FitSettings(steps=300, batch=2**17, lr=1e-2, schedule="cosine", loss="mae")


class Sdf(Task):
    """Task 6, signed distance fields; files are always stored as bytes.

    Presets: ``sparse`` (default), nodes near the surface whose pointers are indices; ``paper``, the supplement's two
    dense arrays; ``dense``, the same started from the distance.
    """

    name = "sdf"
    title = "the signed distance field of a mesh"
    section = "supplemental 1.6"
    example = "mesh.ply --bytes 200k"
    plugin = ("shape", "neural_sdf")
    presets = {  # noqa: RUF012
        "sparse": FitSettings(
            steps=250, batch=2**18, lr=2e-2, schedule="cosine", loss="mae", measure_every=50, deterministic=True
        ),
        "dense": PAIR_SETTINGS,
        "paper": PAIR_SETTINGS,
    }
    storages = ()
    measurements = 4
    files = "model"
    arguments = (
        Argument(
            "source", file="read", metavar="MESH",
            help="a mesh: ply, obj, stl, off, glb, serialized, …; SCENE.xml, or one shape of it: SCENE.xml#ID",
        ),
        Argument(
            "--bytes", type=checked(units.parse_bytes), metavar="N",
            help="size in memory, as in 256k or 1.5M (default: 1M)",
        ),
        Argument(
            "--bits", type=int, choices=BITS, default=10,
            help="bits of a pointer of the sparse layout (default: 10)",
        ),
        Argument(
            "--ratio", type=between(1, 16),
            help="for dense and paper: side of the primary over side of the cascaded array",
        ),
        Argument(
            "--constant", action="store_true",
            help="for paper: start with a constant cascaded array, not with the nearest samples",
        ),
    )  # fmt: skip
    decode_arguments = (
        Argument(
            "--resolution", type=positive, metavar="N",
            help="cells along the longest side (default: finer than the field's)",
        ),
    )  # fmt: skip

    def allocate(self, table, dtype, storage=""):
        return super().allocate(table, dtype, storage) if table.settings["layout"] == "pair" else {}


TASK = Sdf()
