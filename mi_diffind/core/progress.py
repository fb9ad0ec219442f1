"""Progress on stderr: a bar in a terminal, a line every few seconds elsewhere, as in a log file."""

from __future__ import annotations

import sys

from tqdm import tqdm

#: Seconds between two lines where stderr is no terminal; shorter jobs say nothing.
EVERY = 10.0


class _Lines:
    """Text file for a progress bar that writes each state as a line of text."""

    def __init__(self, stream):
        self.stream = stream

    def write(self, text: str) -> None:
        if text := text.strip():
            self.stream.write(f"{text}\n")

    def flush(self) -> None:
        self.stream.flush()


def in_terminal() -> bool:
    """Return whether stderr is a terminal, where a bar can be redrawn."""
    return hasattr(sys.stderr, "isatty") and sys.stderr.isatty()


def progress_bar(
    title: str | None,
    total: float,
    unit: str = "pass",
    progress: bool = True,
    initial: int = 0,
    line: str = "",
    **options,
) -> tqdm:
    """Return a progress bar on stderr; without ``progress`` it stays hidden.

    Where stderr is no terminal, each state is a line of text, written every :data:`EVERY` seconds. ``line`` is its
    format (``bar_format`` of ``tqdm``); ``options`` are those of ``tqdm`` in a terminal.
    """
    if progress and not in_terminal():
        line = line or "{n_fmt} of {total_fmt} {unit}, {elapsed} so far, {remaining} left{postfix}"
        line = f"{title}: {line}" if title else line
        options = {"mininterval": EVERY, "delay": EVERY, "bar_format": line, "file": _Lines(sys.stderr)}
    return tqdm(total=total, initial=initial, desc=title, unit=unit, disable=not progress, **options)
