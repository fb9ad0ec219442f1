"""Base class of all errors that a user can cause, and text from files in a form that a terminal may show."""

import contextlib
import unicodedata

#: Most characters of a message.
LONGEST_MESSAGE = 300

#: Most characters of a path in a message that would be too long.
LONGEST_PATH = 40

#: Unicode categories of characters that a terminal obeys or hides: controls, formats (such as changes of the writing
#: direction), halves of surrogate pairs, and separators of lines and paragraphs.
_HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def printable(text: str) -> str:
    r"""Return a text on one line without control characters: escape sequences such as ``\x1b`` replace them."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character.encode("unicode_escape").decode() if unicodedata.category(character) in _HIDDEN else character
        for character in text
    )


def shortened(text: str, most: int = LONGEST_MESSAGE) -> str:
    """Return a text of at most ``most`` characters.

    A longer one has only the ends of its long paths, then, if that is not enough, no middle.
    """
    if len(text) <= most:
        return text
    text = " ".join(
        f"…{word[-LONGEST_PATH:]}" if "/" in word and len(word) > LONGEST_PATH else word for word in text.split(" ")
    )
    if len(text) <= most:
        return text
    end = (most - 3) // 2
    return f"{text[: most - 3 - end]} … {text[-end:]}"


def missing_package(*names: str) -> str:
    """Return ``names`` of packages on PyPI as the object of a sentence, with the command that installs them."""
    plural = len(names) > 1
    listed = f"package{'s' * plural} {', '.join(names)}, which {'are' if plural else 'is'} not installed"
    return f"the {listed}: pip install {' '.join(names)}"


class DiffindError(Exception):
    """Bad input, or a place that cannot be written.

    The message is one sentence: the file or the parameter, what was found, what is allowed. It has no control
    characters and at most :data:`LONGEST_MESSAGE` characters. The command line prints it and ends with exit code 2.
    """

    def __init__(self, *arguments):
        super().__init__(*(shortened(printable(a)) if isinstance(a, str) else a for a in arguments))


class UsageError(DiffindError):
    """Bad input that the argument parser cannot detect."""


@contextlib.contextmanager
def raised_as(error_type: type[Exception], *caught: type[Exception], at: object = ""):
    """Raise the ``caught`` errors as one of another ``error_type``, in the same words, after the place ``at``."""
    try:
        yield
    except caught as e:
        raise error_type(f"{at}: {e}" if at else str(e)) from None


def reason(error: BaseException, **names: str) -> str:
    """Return the message of ``error`` on one line of at most 100 characters, to be quoted in a sentence.

    ``names`` (shown → in the error) are shown in place of longer ones.
    """
    import textwrap

    text = str(error)
    for shown, name in names.items():
        text = text.replace(name, shown)
    return printable(textwrap.shorten(text, 100, placeholder="…")) or type(error).__name__
