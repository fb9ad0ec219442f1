"""
``tradeoff sdf``: the distance field of a mesh in equal bytes, ours beside dense grids, bricks, sparse distances, the
supplement's arrays and a hash grid with a network: solids, normals, reads, rays and renders. :mod:`.candidates` says
more.
"""

from __future__ import annotations

import argparse

from ...measure.study import Plan, Study

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
        parser.add_argument(
            "--without", action="append", default=[], metavar="KIND",
            help="leave out a kind, as it is named in the table without its size; may be repeated",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Also reads the mesh; raises :class:`~mi_diffind.tasks.sdf.mesh.MeshError`."""
        from ...sizes import parse_bytes
        from ...tasks.sdf.mesh import load_mesh
        from .candidates import KINDS

        default = ("64k",) if arguments.quick else (FIRST, *(s for s in SIZES if s != FIRST))
        arguments.sizes = tuple(dict.fromkeys(map(parse_bytes, arguments.bytes or default)))
        unknown = [name for name in arguments.without if name not in KINDS]
        if unknown:
            raise ValueError(f'--without: found "{unknown[0]}", allowed are {", ".join(KINDS)}')
        arguments.loaded = load_mesh(arguments.source)

    def plan(self, arguments) -> Plan:
        from .candidates import Request, plan

        quick = arguments.quick
        request = Request(
            sizes=arguments.sizes,
            without=tuple(arguments.without),
            points=2**14 if quick else 2**20,
            steps=20 if quick else 0,
            hash_steps=(40, 80) if quick else (500, 4000),
            film=(48, 32) if quick else (480, 320),
            grid=32 if quick else 256,
            decoded=96 if quick else 768,
            spp=1 if quick else 4,
        )
        return plan(arguments.loaded, arguments.source, request)


STUDY = SdfStudy()
