"""Base class of all errors that a user can cause."""

from __future__ import annotations


class DiffindError(Exception):
    """Bad input, or a place that cannot be written.

    The message is one sentence: the file or the parameter, what was found, what is allowed. The command line prints it
    and ends with exit code 2.
    """


class UsageError(DiffindError):
    """Bad input that the argument parser cannot detect."""


#: Longest message of an error on the command line, in characters.
LONGEST = 260


def shortened(text: str, most: int = LONGEST) -> str:
    """Return a text of at most ``most`` characters: of a longer one, the beginning and the end."""
    return text if len(text) <= most else f"{text[: most // 2]}…{text[1 - (most - most // 2) :]}"


def reason(error: BaseException, **names: str) -> str:
    """Return the message of ``error`` on one line of at most 100 characters, to be quoted in a sentence.

    ``names`` (shown → in the error) are shown in place of longer ones.
    """
    import textwrap

    text = str(error)
    for shown, name in names.items():
        text = text.replace(name, shown)
    return textwrap.shorten(text, 100, placeholder="…") or type(error).__name__
