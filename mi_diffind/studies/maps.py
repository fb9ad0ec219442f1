"""Shared parts of the studies of images and of filtered textures: options, descriptions of the source, PSNR."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..maps.source import Source

ASTC_PRESETS = ("fastest", "fast", "medium", "thorough", "verythorough", "exhaustive")


def add_astc_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--astc``, the preset of the encoder."""
    parser.add_argument(
        "--astc", choices=ASTC_PRESETS, default="exhaustive",
        help="preset of the ASTC encoder (default: exhaustive; faster ones are up to several dB worse)",
    )  # fmt: skip


def source_details(source: Source, name: str) -> dict:
    """Return what a result's ``details`` record about a source, read from the file ``name``."""
    return {
        "source": name, "source_digest": source.digest, "source_bytes": source.nbytes, "width": source.width,
        "height": source.height, "maps": {m.name: m.channels for m in source.maps},
    }  # fmt: skip


def source_line(details: dict) -> str:
    """Return the line about the source that begins a table."""
    maps = ", ".join(f"{name} ({channels})" for name, channels in details["maps"].items())
    size = f"{details['width']} x {details['height']}"
    return f"{details['source']}: {size}, {maps}, {details['source_bytes']:,} bytes"
