"""Checks of a plugin's properties: one of a few words, a number in a range, a file."""

from __future__ import annotations

import mitsuba as mi


def one_of(props: mi.Properties, name: str, allowed: tuple[str, ...]) -> str:
    """Return a property that is one of some words, the first by default."""
    value = props.get(name, allowed[0])
    if value not in allowed:
        raise RuntimeError(f'parameter "{name}": found "{value}", allowed are {", ".join(allowed)}')
    return str(value)


def is_number(props: mi.Properties, name: str) -> bool:
    """Return whether the property ``name``, which must exist, is a number."""
    return props.type(name) in (mi.Properties.Type.Float, mi.Properties.Type.Integer)


def check_range(props: mi.Properties, name: str, low: float, high: float) -> None:
    """Refuse a number outside of ``[low, high]``.

    Textures are not checked, since a constructor would have to wait for a kernel.
    """
    if name in props and is_number(props, name):
        value = float(props[name])
        if not low <= value <= high:  # NaN, too
            raise RuntimeError(f'parameter "{name}": found {value:g}, allowed is [{low}, {high}]')


def filename(props: mi.Properties) -> str:
    """Return the property ``filename`` as Mitsuba resolves it, or ""."""
    name = str(props.get("filename", ""))
    return str(mi.file_resolver().resolve(name)) if name else ""
