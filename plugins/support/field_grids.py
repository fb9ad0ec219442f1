"""The grid that a compressed radiance field was made from, as its exact counterpart."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi

from mi_diffind.tables import TableError
from mi_diffind.tasks.radiance.files import load

from . import properties


def to_grid(props: mi.Properties) -> None:
    """
    Let ``filename`` name the grid that was compressed to the file that it names now. Raises ``RuntimeError`` if it is
    not there any more, or was not kept.
    """
    path = Path(properties.filename(props))
    try:
        table = load(path)
    except TableError as e:
        raise RuntimeError(str(e)) from None
    if table.settings["layout"] == "grid":
        return
    found = table.settings.get("grid_path")
    if not found:
        raise RuntimeError(
            f'parameter "filename": {path} was fitted without "--grid FILE": the grid to compare it with was not kept'
        )
    grid = path.resolve().parent / found
    if not grid.is_file():
        raise RuntimeError(
            f'parameter "filename": {path} was made from the grid {grid}, which is not there: "mi-diffind fit field '
            f'FOLDER --preset grid -o {grid.name}" makes it again'
        )
    props["filename"] = str(grid)
    if "storage" in props:
        del props["storage"]
