"""
``tradeoff sdf``: the distance field of a mesh in equal bytes, ours beside dense grids, bricks, sparse distances, the
supplement's arrays and a hash grid with a network: solids, normals, reads, rays and renders. :mod:`.candidates` says
more.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ...measure.study import Plan, Study
from ..equal_memory import add_without_option, check_without

#: Sizes unless asked otherwise, and the one at which everything is made and timed, if it is among them.
SIZES, FIRST = ("256k", "512k", "1M", "2M", "4M"), "1M"


class SdfStudy(Study):
    """A distance field in equal bytes: how near to the mesh, and the time of reads, rays and renders."""

    name = "sdf"
    title = "the distance field of a mesh, in equal bytes, reads, rays and renders"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/suzanne.ply", metavar="MESH",
            help="any that trimesh reads (default: scenes/assets/suzanne.ply)",
        )  # fmt: skip
        parser.add_argument(
            "--bytes", action="append", default=[], metavar="N",
            help=f"in memory; may be repeated (default: {', '.join(SIZES)}; --quick: 64k); of the first that is named "
            "(default: 1M) all kinds are made, and reads, rays and renders are timed",
        )  # fmt: skip
        add_without_option(parser)
        parser.add_argument(
            "--ablation", action="store_true",
            help=f"in place of other kinds, what the parts of ours are worth (default: of {FIRST} alone)",
        )  # fmt: skip
        parser.add_argument(
            "--errors-of", metavar="FILE",
            help="what --json wrote of an earlier run: its errors are taken over but for the size at which reads, rays "
            "and renders are timed, which are timed anew",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Also reads the mesh; raises :class:`~mi_diffind.tasks.sdf.mesh.MeshError`."""
        from ...tasks.sdf.mesh import load_mesh
        from ...units import parse_bytes
        from .plan import KINDS, PARTS

        every = (FIRST,) if arguments.ablation else (FIRST, *(s for s in SIZES if s != FIRST))
        default = ("64k",) if arguments.quick else every
        arguments.sizes = tuple(dict.fromkeys(map(parse_bytes, arguments.bytes or default)))
        check_without(arguments.without, PARTS if arguments.ablation else KINDS)
        arguments.loaded = load_mesh(arguments.source)
        arguments.before = earlier(arguments) if arguments.errors_of else {}

    def plan(self, arguments) -> Plan:
        from .plan import Request, plan

        quick = arguments.quick
        request = Request(
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
        return plan(arguments.loaded, arguments.source, request, arguments.before)


def earlier(arguments) -> dict[str, dict]:
    """The records of the earlier run, name → record. Raises ``ValueError`` with a sentence."""
    path, mesh = arguments.errors_of, arguments.loaded
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
        digest, quick, records = found["details"]["source_digest"], found["settings"]["quick"], dict(found["jobs"])
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise ValueError(f"--errors-of: {path} is not what --json wrote of this study: {e!r}") from None
    if digest != mesh.digest:
        raise ValueError(f"--errors-of: {path} is of another mesh than {mesh.path}")
    if quick != arguments.quick:
        raise ValueError(f"--errors-of: {path} is of a run {'with' if quick else 'without'} --quick, found the other")
    return records


STUDY = SdfStudy()
