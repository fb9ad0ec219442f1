"""Text of scene files: a change of a parsed scene is carried over into the text that it was parsed from.

All else stays as its author wrote it: ids, aliases, comments, transforms, numbers, ``<default>`` and ``$name``.
Mitsuba's own writer of parsed scenes loses some of these, and materials and large scales with them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr, unescape

import mitsuba as mi

from ..core import compat
from ..core.files import relative_path, same_file

#: Comments and declarations, which are passed over; the end of an element; its start, with attributes.
_TAGS = re.compile(
    r"""<!--.*?--> | <!\[CDATA\[.*?\]\]> | <\?.*?\?> | <![^>]*> | </(?P<end>[^\s>]+)\s*>
    | <(?P<start>[^\s<>/!?]+)(?P<attributes>(?:\s+[^\s=<>/]+\s*=\s*(?:"[^"]*"|'[^']*'))*)\s*(?P<empty>/?)>""",
    re.DOTALL | re.VERBOSE,
)

_ATTRIBUTE = re.compile(r"""([^\s=]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")

_ENTITIES = {"&quot;": '"', "&apos;": "'"}

#: Character by its number, decimal or hexadecimal.
_NUMBERED = re.compile(r"&#(?:x([0-9a-fA-F]+)|([0-9]+));")

#: Element for a parameter by the type of its value.
_PARAMETERS = {bool: "boolean", int: "integer", float: "float", str: "string"}


#: Begin of the names of parameters that are objects without a name.
UNNAMED = "_arg_"

#: First and last place, and the text that takes the place of what is between them.
_Edit = tuple[int, int, str]


@dataclass
class _Element:
    """Element of a file: its attributes, each with its place, its children, and its place and that of its content."""

    tag: str
    start: int
    inner: int
    attributes: dict[str, tuple[str, int, int]]
    empty: bool
    inner_end: int = 0
    end: int = 0
    children: list[_Element] = field(default_factory=list)

    def edit(self, attribute: str, value: str | None = None) -> _Edit:
        """Return the edit that gives an attribute another value, or removes it."""
        _, start, end = self.attributes[attribute]
        return (start, end, f"{attribute}={_quote(value)}") if value is not None else (start, end, "")

    def walk(self) -> Iterator[_Element]:
        """Yield this element and all below, in the order of the text."""
        yield self
        for child in self.children:
            yield from child.walk()


def _read(path: Path) -> tuple[str, _Element]:
    """Return a file's text, one character a byte of UTF-8 as Mitsuba counts them, and its root."""
    content = path.read_bytes()
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = ("\ufeff" + content.decode("utf-16")).encode()
    text = content.decode("latin-1")
    top = _Element("", 0, 0, {}, False)
    stack = [top]
    for match in _TAGS.finditer(text):
        if match["start"]:
            spans = _ATTRIBUTE.finditer(text, match.start("attributes"), match.end("attributes"))
            attributes = {m[1]: (m[m.lastindex], *m.span()) for m in spans}
            element = _Element(match["start"], match.start(), match.end(), attributes, bool(match["empty"]))
            stack[-1].children.append(element)
            if match["empty"]:
                element.inner_end = element.end = match.end()
            else:
                stack.append(element)
        elif match["end"] and len(stack) > 1:
            stack[-1].inner_end, stack[-1].end = match.span()
            stack.pop()
    return text, top.children[0]


def _character(match: re.Match) -> str:
    """Return the character of a :data:`_NUMBERED`, escaped if it begins another entity."""
    character = chr(int(match[1], 16) if match[1] else int(match[2]))
    return "&amp;" if character == "&" else character


def _quote(text: str) -> str:
    """Return text as the value of an attribute, quoted, one character a byte of UTF-8."""
    return quoteattr(text.replace("$", r"\$")).encode().decode("latin-1")


class _Editor:
    """Edits that carry a change of a parsed scene over into its files, for a new file in the folder ``target``."""

    def __init__(self, before, after, defines: dict[str, str], target: Path):
        self.files = [Path(file).resolve() for file in compat.parsed_files(before)]
        self.target, self.origin = target, self.files[0].parent
        self.parameters, self.defines, self.undefined = dict(defines), defines, set(defines)
        self.next_file = 0
        properties = zip(compat.parsed_properties(before), compat.parsed_properties(after), strict=True)
        self.changes = {
            place: (a, b) for place, (a, b) in zip(compat.parsed_offsets(before), properties, strict=True) if a != b
        }
        kept, places = compat.parsed_walk(after), compat.parsed_offsets(before)
        self.dropped = {places[index] for index in compat.parsed_walk(before)} - {places[index] for index in kept}

    def text(self) -> str:
        """Return the scene's text, one character a byte."""
        text, root = _read(self.files[0])
        self.modern = _is_modern(root)
        edits, _ = self.edits(root, self.origin)
        if self.changes:
            number = next(iter(self.changes))[0]
            raise RuntimeError(f"{self.files[number]}: found text in another encoding, needed is UTF-8")
        for name in sorted(self.undefined):
            default = f"\n    <default name={_quote(name)} value={_quote(self.defines[name])}/>"
            edits.append((root.inner, root.inner, default))
        return _apply(text, edits, 0, len(text))

    def value(self, element: _Element, name: str) -> str:
        """Return an attribute as Mitsuba takes it: with the values of parameters in the place of ``$name``."""
        raw = element.attributes.get(name, ("", 0, 0))[0]
        text = _NUMBERED.sub(_character, raw.encode("latin-1").decode("utf-8", "replace"))
        value = unescape(text, _ENTITIES)
        for key in sorted(self.parameters, key=len, reverse=True) if "$" in value else ():
            value = re.sub(rf"(?<!\\)\${re.escape(key)}", lambda _, key=key: self.parameters[key], value)
        return value.replace(r"\$", "$")

    def edits(self, root: _Element, folder: Path) -> tuple[list[_Edit], bool]:
        """Return the edits of the next file, which lies in ``folder``, and whether it cannot stay as and where it is.

        Edits that count only where the file moves are among them.
        """
        number, edits, needed, replaced = self.next_file, [], False, set()
        self.next_file += 1
        for element in root.walk():
            if element.start in replaced:
                continue
            if (number, element.start + 1) in self.dropped:
                edits.append((element.start, element.end, ""))
                self.changes.pop((number, element.start + 1), None)
                needed = True
                continue
            if (change := self.changes.pop((number, element.start + 1), None)) is not None:
                edits += self.change(element, *change, replaced)
                needed = True
            name, attribute = self.value(element, "name"), "value"
            if element.tag == "default":
                if name in self.defines:
                    edits.append(element.edit("value", self.defines[name]))
                    self.undefined.discard(name)
                    needed = True
                self.parameters.setdefault(name, self.value(element, "value"))
                continue
            if element.tag == "include":
                included = self.included(element, folder)
                if included is not None:
                    edits.append((element.start, element.end, included))
                    needed = True
                    continue
            if element.tag in ("include", "spectrum"):
                attribute = "filename"
            elif element.tag not in ("path", "string"):
                continue
            value = self.value(element, attribute)
            if element.tag == "string" and not _may_be_file(name, value):
                continue
            beside = element.tag in ("include", "path") and (folder / value).exists()
            if moved := self.moved(value, folder if beside else self.origin):
                edits.append(element.edit(attribute, moved))
                needed = needed or not beside
        return edits, needed

    def included(self, element: _Element, folder: Path) -> str | None:
        """Return the text to be written in the place of an ``<include>``, or ``None`` if that can stay."""
        name, number = self.value(element, "filename"), self.next_file
        places = (folder / name, self.origin / name, Path(str(mi.file_resolver().resolve(name))))
        file = next((place for place in places if place.is_file()), places[0]).resolve()
        text, root = _read(file)
        if number == len(self.files) or self.files[number] != file:  # without objects, and Mitsuba does not count it
            for default in (one for one in root.walk() if one.tag == "default"):
                self.parameters.setdefault(self.value(default, "name"), self.value(default, "value"))
            return None
        edits, needed = self.edits(root, file.parent)
        if not needed:
            return None
        if _is_modern(root) != self.modern:
            raise RuntimeError(f"{file}: has to change, and is of another version than the scene that includes it")
        if root.tag == "scene":
            return _apply(text, edits, root.inner, root.inner_end)
        edits += [root.edit(attribute) for attribute in ("version", "name") if attribute in root.attributes]
        if "name" in element.attributes:
            place = root.start + 1 + len(root.tag)
            edits.append((place, place, f" name={_quote(self.value(element, 'name'))}"))
        return _apply(text, edits, root.start, root.end)

    def moved(self, name: str, folder: Path) -> str:
        """Return another name of the file ``name`` in a folder if it is needed in the target, else ""."""
        file, beside = folder / name, self.target / name
        if not name or Path(name).is_absolute() or not file.exists():  # found by a <path>, or Mitsuba's
            return ""
        return "" if beside.exists() and same_file(beside, file) else relative_path(file, self.target)

    def change(self, element: _Element, before, after, replaced: set[int]) -> list[_Edit]:
        """Return the edits that change an object; the places of its elements are added to ``replaced``."""
        edits, added = [], ""
        if before.plugin_name() != after.plugin_name():
            edits.append(element.edit("type", after.plugin_name()))
        children = {self.value(child, "name"): child for child in element.children}
        for key in dict.fromkeys([*before, *after]):
            if key in before and key in after and _is_equal(key, before, after):
                continue
            if key in before and key not in after and compat.property_kind(before, key) == "object":
                references = [child for child in element.children if child.tag == "ref"]  # the others are dropped
                for child in references:
                    if self.value(child, "name") == ("" if key.startswith(UNNAMED) else key):
                        edits.append((child.start, child.end, ""))
                        replaced.add(child.start)
                continue
            written = self.parameter(key, after[key]) if key in after else ""
            if key in before:
                edits.append((children[key].start, children[key].end, written))
                replaced.add(children[key].start)
            else:
                added += written
        if added:
            opened = (element.inner - 2, element.inner, f">{added}</{element.tag}>")
            edits.append(opened if element.empty else (element.inner, element.inner, added))
        return edits

    def parameter(self, name: str, value) -> str:
        """Return the element of a parameter, with the path from the target of a file that has an absolute one."""
        if hasattr(value, "matrix"):
            numbers = " ".join(repr(float(number)) for row in value.matrix for number in row)
            return f'<transform name={_quote(name)}><matrix value="{numbers}"/></transform>'
        if type(value) not in _PARAMETERS:
            return f'<rgb name={_quote(name)} value="{", ".join(repr(float(number)) for number in value)}"/>'
        shown = str(value).lower() if isinstance(value, bool) else str(value)  # of a float, its shortest text
        if isinstance(value, str) and Path(value).is_absolute():
            shown = relative_path(value, self.target)
        return f"<{_PARAMETERS[type(value)]} name={_quote(name)} value={_quote(shown)}/>"


def _is_modern(root: _Element) -> bool:
    """Return whether Mitsuba takes the names of parameters of a file as they are; it changes those before version 2."""
    return not root.attributes["version"][0].strip().startswith(("0", "1"))


def _may_be_file(name: str, value: str) -> bool:
    """Return whether a parameter may be the name of a file, by its own name or by its value's extension."""
    return "file" in name or bool(Path(value).suffix)


def _apply(text: str, edits: list[_Edit], start: int, end: int) -> str:
    """Return a part of a text with the edits in it. A line that they leave empty is dropped."""
    parts, place = [], start
    for first, last, new in sorted(edits, key=lambda edit: edit[:2]):
        if not max(start, place) <= first <= last <= end:  # elsewhere, or in what was dropped
            continue
        before, after = text.rfind("\n", start, first), text.find("\n", last, end)
        if not new and before >= place and after >= 0 and not (text[before:first] + text[last:after]).strip():
            first, last = before, after
        parts += [text[place:first], new]
        place = last
    return "".join([*parts, text[place:end]])


def edit_text(before, after, defines: dict[str, str], target: Path) -> bytes:
    """Return the content of a scene file to which a change of its parsed form is carried over.

    - ``before``: the form as the file is parsed with ``defines``; ``after``: the same objects with other plugins, or
      other parameters that are numbers, text, colours or transforms, or without some that they nest or refer to.
    - ``target``: the folder of the new file; names of files are changed to those that it needs.

    An included file that has to change takes the place of its ``<include>``, and values of ``defines`` that of their
    ``<default>``. Raises ``RuntimeError`` in one sentence.
    """
    return _Editor(before, after, defines, target).text().encode("latin-1")


def _is_equal(key: str, a, b) -> bool:
    """Return whether two properties are equal. Colours compare by component, and no two transforms as unequal."""
    pair = mi.Properties(), mi.Properties()
    for one, props in zip(pair, (a, b), strict=True):
        one[key] = props[key]
    return pair[0] == pair[1]


def _shown(value) -> str:
    return " ".join(str(value).split())


def absolute_paths(state):
    """Return a copy of a parsed scene in which the paths of files that exist are absolute."""
    state = compat.copy_state(state)[1]
    for props in compat.parsed_properties(state):
        for key in props:
            if compat.property_kind(props, key) == "text" and props[key] and _may_be_file(key, props[key]):
                file = Path(str(mi.file_resolver().resolve(props[key])))
                if file.is_file():
                    props[key] = str(file.resolve())
    return state


def _objects(state) -> list[tuple]:
    """Return the objects of a parsed scene in the order of the file: index, properties, and those it refers to.

    The latter are places in this list, by the parameter; those without a name are numbered without a gap.
    """
    order, nodes = sorted(compat.parsed_walk(state)), compat.parsed_properties(state)
    references = compat.parsed_references(state)
    places, objects = {index: place for place, index in enumerate(order)}, []
    for index in order:
        nested, unnamed = {}, 0
        for key, other in references[index].items():
            nested[f"{UNNAMED}{unnamed}" if key.startswith(UNNAMED) else key] = places[other]
            unnamed += key.startswith(UNNAMED)
        objects.append((index, nodes[index], nested))
    return objects


def _values(props) -> list[str]:
    """Return the names of the parameters that are no objects."""
    return [key for key in props if compat.property_kind(props, key) != "object"]


def difference(before, after) -> str:
    """Return the first difference of two parsed scenes in words, "" if there is none.

    Compared are the objects, their order, ids, plugins and parameters, with transforms and colours to the last bit, and
    to which other objects they refer, by any alias.
    """
    sides = _objects(before), _objects(after)
    for (_, a, nested), (index, b, others) in zip(*sides, strict=False):
        name = f'{b.plugin_name()} "{b.id() or Path(compat.parsed_place(after, index)).name}"'
        if (a.plugin_name(), a.id()) != (b.plugin_name(), b.id()):
            return f'{name} in place of {a.plugin_name()} "{a.id()}"'
        for key in dict.fromkeys([*_values(a), *nested, *_values(b), *others]):
            both = [key in objects or key in _values(props) for props, objects in ((a, nested), (b, others))]
            if not all(both):
                return f'{name} {"lacks" if both[0] else "has"} "{key}"'
            if key not in nested and not _is_equal(key, a, b):
                return f"{name} has {key} {_shown(b[key])} in place of {_shown(a[key])}"
    counts = [len(side) for side in sides]
    if counts[0] != counts[1]:
        return f"{counts[1]} objects in place of {counts[0]}"
    types = [
        [compat.parsed_types(state)[i] for i, *_ in side] for state, side in zip((before, after), sides, strict=True)
    ]
    if types[0] != types[1]:
        return "objects of other types"
    if [nested for *_, nested in sides[0]] != [nested for *_, nested in sides[1]]:
        return "objects that refer to others than before"
    return ""
