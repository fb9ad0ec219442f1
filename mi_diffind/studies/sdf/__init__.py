"""Study of signed distance fields (``tradeoff sdf``): errors and times of ours and of other methods in equal bytes.

The other methods are dense grids, bricks, sparse distances, the supplement's arrays and a hash grid with a network;
:mod:`.plan` describes the measurements.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ...measure.study import Plan, Study
from ..equal_memory import add_without_option, check_without

#: Default memory budgets, and the one at which all methods are trained and timed.
SIZES, FIRST = ("256k", "512k", "1M", "2M", "4M"), "1M"


class SdfStudy(Study):
    """Distance fields in equal bytes: errors against the mesh, and times of reads, rays and renders."""

    name = "sdf"
    title = "the distance field of a mesh, in equal bytes, reads, rays and renders"
    example = "mesh.ply"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/suzanne.ply", metavar="MESH",
            help="a mesh file that trimesh reads (default: scenes/assets/suzanne.ply)",
        )  # fmt: skip
        parser.add_argument(
            "--bytes", action="append", default=[], metavar="N",
            help=f"memory budget; may be repeated (default: {', '.join(SIZES)}; --quick: 64k); at the first one "
            "(default: 1M) all methods are trained, and reads, rays and renders are timed",
        )  # fmt: skip
        add_without_option(parser)
        parser.add_argument(
            "--ablation", action="store_true",
            help=f"compare ours with parts of it left out, in place of other methods (default: at {FIRST} alone)",
        )  # fmt: skip
        parser.add_argument(
            "--errors-of", metavar="FILE",
            help="JSON file (--json) of an earlier run; its errors are taken over, except at the budget that is timed",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Check the arguments and read the mesh; raises :class:`~mi_diffind.tasks.sdf.mesh.MeshError`."""
        from ...core.units import parse_bytes
        from ...tasks.sdf.mesh import load_mesh
        from .contenders import METHODS, PARTS

        every = (FIRST,) if arguments.ablation else (FIRST, *(s for s in SIZES if s != FIRST))
        default = ("64k",) if arguments.quick else every
        arguments.sizes = tuple(dict.fromkeys(map(parse_bytes, arguments.bytes or default)))
        check_without(arguments.without, PARTS if arguments.ablation else METHODS)
        arguments.loaded = load_mesh(arguments.source)
        arguments.before = earlier(arguments) if arguments.errors_of else {}

    def plan(self, arguments) -> Plan:
        from .contenders import DistanceStudySettings
        from .plan import plan

        quick = arguments.quick
        settings = DistanceStudySettings(
            sizes=arguments.sizes,
            without=tuple(arguments.without),
            ablation=arguments.ablation,
            points=2**14 if quick else 2**20,
            steps=20 if quick else 0,
            hash_steps=(40, 80) if quick else (500, 4000),
            film=(48, 32) if quick else (480, 320),
            grid=32 if quick else 256,
            decoded=96 if quick else 768,
            spp=1 if quick else 4,
        )
        return plan(arguments.loaded, arguments.source, settings, arguments.before)


def earlier(arguments) -> dict[str, dict]:
    """Return the records of the earlier run by name. Raises ``ValueError`` if its file does not fit the arguments."""
    path, mesh = arguments.errors_of, arguments.loaded
    try:
        result = json.loads(Path(path).read_text(encoding="utf-8"))
        digest, quick, records = result["details"]["source_digest"], result["settings"]["quick"], dict(result["jobs"])
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise ValueError(f"--errors-of: {path} is not a file that --json wrote of this study: {e!r}") from None
    if digest != mesh.digest:
        raise ValueError(f"--errors-of: {path} is of another mesh than {mesh.path}")
    if quick != arguments.quick:
        with_quick, expected = ("with", "without") if quick else ("without", "with")
        raise ValueError(f"--errors-of: {path} is of a run {with_quick} --quick, give one {expected} it")
    return records


STUDY = SdfStudy()
