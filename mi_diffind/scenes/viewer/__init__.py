"""Viewer of scenes with learned plugins: ``mi_diffind.view`` and ``mi-diffind view``.

:mod:`.session` renders and knows nothing of pages; :mod:`.page` is the page that viser shows in a browser.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping

from ...core.progress import interruptible
from .page import Page, server
from .session import WIDTH, Session

#: Host at which the page is served by default: only this machine can open it.
HOST = "127.0.0.1"

#: Port at which the page is served by default.
PORT = 8080


def view(
    source: str | os.PathLike | dict,
    *,
    host: str = HOST,
    port: int = PORT,
    width: int = WIDTH,
    spp: int | None = None,
    seed: int = 0,
    against: str = "exact",
    defines: Mapping[str, object] | None = None,
    seconds: float | None = None,
    announce=print,
) -> dict:
    """Show a scene in a browser, with learned plugins beside exact ones, until Ctrl-C or for some ``seconds``.

    - ``source``: a scene file, a table file (``.npz``) or a dictionary as of ``mi.load_dict``;
    - ``host``, ``port``: address of the page; by default only this machine can open it. Port 0 is any free one;
    - ``width``: of the picture, pixels; the height follows the scene's film;
    - ``spp``: samples per pixel of a finished picture (``None``: the scene's); ``seed``: seed of the random numbers;
    - ``against``: the counterpart that learned plugins are compared with, as of :func:`mi_diffind.compare`;
    - ``defines``: values of a scene file's ``<default>`` parameters;
    - ``announce``: called with a sentence that names the page.

    Returns the figures of the last picture (:attr:`.session.Session.figures`) with the ``url`` and ``seconds_shown``.
    Raises :class:`.UsageError`, also if viser is not installed, and as :class:`.session.Session` does.
    """
    start = time.perf_counter()
    session = Session(source, width, spp, seed, against=against, defines=defines)
    served = server(host, port)
    try:
        page = Page(session, served)
        name = f"[{host}]" if ":" in host else host
        url = f"http://{name}:{served.get_port()}"
        announce(f"{session.name}: {url} (Ctrl-C ends)")
        with interruptible() as stop:
            page.run(stop, seconds)
    finally:
        served.stop()
    return {**session.figures, "url": url, "seconds_shown": time.perf_counter() - start}
