"""Properties of plugins that have to be one of a few words, a number in a range, or a file."""

from __future__ import annotations

import mitsuba as mi


def one_of(props: mi.Properties, name: str, allowed: tuple[str, ...]) -> str:
    """A property that is one of some words, the first by default."""
    found = props.get(name, allowed[0])
    if found not in allowed:
        raise RuntimeError(f'parameter "{name}": found "{found}", allowed are {", ".join(allowed)}')
    return str(found)


def is_number(props: mi.Properties, name: str) -> bool:
    """Is the property ``name``, which is there, a number?"""
    return props.type(name) in (mi.Properties.Type.Float, mi.Properties.Type.Integer)


def check_range(props: mi.Properties, name: str, low: float, high: float) -> None:
    """
    Refuse a number outside of ``[low, high]``. Textures are not looked into: a constructor would have to wait for a
    kernel.
    """
    if name in props and is_number(props, name):
        value = float(props[name])
        if not low <= value <= high:  # NaN, too
            raise RuntimeError(f'parameter "{name}": found {value:g}, allowed is [{low}, {high}]')


def filename(props: mi.Properties) -> str:
    """The property ``filename`` as Mitsuba resolves it, or ""."""
    found = str(props.get("filename", ""))
    return str(mi.file_resolver().resolve(found)) if found else ""
