"""The XML of an E57 file: its elements and where in the text they stand, so that edits leave all else as it is.

Not here: what elements mean (e57.py).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from html import escape
from xml.parsers import expat

from pcdenoise.errors import ScanError

_LONGEST, _MOST_ELEMENTS, _DEEPEST = 1 << 26, 1 << 20, 64
_START_TAG = re.compile(rb"<[^\s/>]+(?:\s+[^\s=/>]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*\s*")


@dataclass(eq=False)
class Element:
    """An element, and the bytes from its first to behind its last; text: all that stands in it outside other elements."""

    name: str
    attributes: Mapping[str, str]
    start: int
    stop: int = 0
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def find(self, *path: str) -> Element | None:
        """The first descendant by the names on the way to it."""
        found: Element | None = self
        for name in path:
            found = next((child for child in found.children if child.name == name), None) if found is not None else None
        return found

    def all(self) -> Iterator[Element]:
        """This element and all in it, in order."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting += reversed(element.children)

    def number(self, *path: str, default: float = 0.0) -> float:
        """The number that a descendant holds: 0 where it is empty, the default where there is none. Raises ValueError."""
        found = self.find(*path)
        return default if found is None else float(found.text.strip() or 0)


def parsed(xml: bytes, origin: str) -> Element:
    """The root of the XML. Raises ScanError where it is none, or larger than that of any real file."""
    if len(xml) > _LONGEST:
        raise ScanError(f"{origin}: its XML has {len(xml)} bytes, more than any scan's; it is damaged, fetch it again")
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    outermost = Element("", {}, 0)
    inside, texts = [outermost], [list[str]()]
    n_elements = 0

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal n_elements
        n_elements += 1
        if n_elements > _MOST_ELEMENTS or len(inside) > _DEEPEST:
            raise ScanError(f"{origin}: its XML has more or deeper elements than any scan's; it is damaged, fetch it again")
        element = Element(name, attributes, parser.CurrentByteIndex)
        inside[-1].children.append(element)
        inside.append(element)
        texts.append([])

    def end(_name: str) -> None:
        element, at = inside.pop(), parser.CurrentByteIndex  # where </name> starts, or what is behind <name/>
        element.text = "".join(texts.pop())
        is_one_tag = not element.children and not element.text and xml[at - 2 : at] == b"/>"
        element.stop = at if is_one_tag else xml.index(b">", at) + 1

    def say(text: str) -> None:
        texts[-1].append(text)

    def refuse(*_declaration: object) -> None:
        raise ScanError(f"{origin}: its XML declares a document type, which E57 has not; it is not to be trusted")

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = say, refuse
    try:
        parser.Parse(xml, True)
    except expat.ExpatError as fault:
        raise ScanError(f"{origin}: its XML is damaged ({fault}); fetch it again") from None
    return outermost.children[0]


class Edits:
    """Changes to elements of one XML text, which do not overlap."""

    def __init__(self, xml: bytes) -> None:
        self._xml, self._changes = xml, dict[tuple[int, int], bytes]()

    def set(self, element: Element, **attributes: str) -> None:
        """Gives attributes, there already or not, other values."""
        tag = self._tag(element)
        for name, value in attributes.items():
            said = f'{name}="{escape(value)}"'.encode()
            tag, n = re.subn(rb"(?<=\s)" + name.encode() + rb"\s*=\s*(?:\"[^\"]*\"|'[^']*')", lambda _: said, tag, count=1)  # noqa: B023
            tag = tag if n else tag.rstrip() + b" " + said
        self._changes[element.start, element.start + len(self._tag(element))] = tag

    def put(self, element: Element, value: float) -> None:
        """Gives an element that is a number another value."""
        kind = element.attributes.get("type", "Float")
        self._changes[element.start, element.stop] = f'<{element.name} type="{kind}">{value!r}</{element.name}>'.encode()

    def append(self, element: Element, xml: str) -> None:
        """Puts XML behind all that an element holds."""
        if self._xml[: element.stop].endswith(b"/>"):
            tag = self._tag(element)
            self._changes[element.start, element.stop] = tag.rstrip() + f">{xml}</{element.name}>".encode()
            return
        end = self._xml.rindex(b"<", element.start, element.stop)
        self._changes[end, end] = self._changes.get((end, end), b"") + xml.encode()

    def remove(self, element: Element) -> None:
        """Takes an element out, with the blanks before it."""
        start = len(self._xml[: element.start].rstrip())
        self._changes[start, element.stop] = b""

    def made(self) -> bytes:
        """The text with all changes."""
        parts, at = [], 0
        for (start, stop), text in sorted(self._changes.items()):
            if start >= at:  # not in what was taken out
                parts += [self._xml[at:start], text]
                at = stop
        return b"".join([*parts, self._xml[at:]])

    def _tag(self, element: Element) -> bytes:
        """The start tag without its end."""
        found = _START_TAG.match(self._xml, element.start)
        assert found is not None, "expat has parsed it"
        return found.group()


def a_number(name: str, value: float, kind: str = "Float") -> str:
    """An element that holds a number."""
    return f'<{name} type="{kind}">{value!r}</{name}>'


def a_text(name: str, text: str) -> str:
    """An element that holds text."""
    return f'<{name} type="String">{escape(text, quote=False)}</{name}>'
