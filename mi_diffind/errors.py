"""What can be wrong with what a user gave: one base class, whose message is one sentence for that user."""

from __future__ import annotations


class DiffindError(Exception):
    """
    Bad input, or a place that cannot be written; the message is one sentence that names the file or the parameter, what
    was found and what is allowed. The command line prints it and ends with exit code 2.
    """


class UsageError(DiffindError):
    """Bad input that the argument parser cannot see."""


def reason(error: BaseException, **names: str) -> str:
    """
    What ``error`` says, on one line and no longer than one: for a sentence that quotes it. ``names`` (shown → in the
    error) are shown in place of longer ones.
    """
    import textwrap

    text = str(error)
    for shown, name in names.items():
        text = text.replace(name, shown)
    return textwrap.shorten(text, 100, placeholder="…") or type(error).__name__
