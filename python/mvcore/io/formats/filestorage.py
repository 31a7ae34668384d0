"""Nested values from YAML and XML files, OpenCV's FileStorage among them (YAML, XML and JSON).

OpenCV's own reader trusts its input: short files make it write past its buffers or never return. Here the files are parsed by libyaml
and expat, event by event: depth and number of values are limited, aliases, document types and entities are refused.

OpenCV's dialect: the header ``%YAML:1.0``; matrices are mappings with the tag ``!!opencv-matrix`` (``rows``, ``cols``, ``dt``, ``data``)
or ``!!opencv-nd-matrix`` (``sizes``), in XML and JSON with ``type_id``; ``dt`` is a letter for the type behind the number of channels;
``.Nan`` and ``.Inf`` are numbers; a file may hold several documents. Whole numbers that start with a zero stay text: an unquoted ``01``
is a camera's name.
"""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import NDArray

from ...errors import FormatError
from ..limits import MOST_DEPTH, MOST_NODES, MOST_TEXT, read_bytes, read_text

INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]{0,17})")
REAL = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]{1,6})?")
LEADING_ZERO = re.compile(r"[-+]?0[0-9]+")
CONSTANTS = {"": None, "~": None, "null": None, ".nan": math.nan, ".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf}
MOST_DIGITS = 400
"""Characters of a number."""

TYPES = {"u": "u1", "c": "i1", "w": "u2", "s": "i2", "n": "u4", "i": "i4", "f": "f4", "d": "f8", "h": "f2"}
"""NumPy types of OpenCV's letters, as they are stored in base64."""
STORED = {"f": np.float32, "h": np.float16}
"""Types whose decimals are rounded when they are read, as OpenCV does."""
TYPE = re.compile(r"([0-9]{0,3})([a-zA-Z])")
MATRIX, ND_MATRIX = "opencv-matrix", "opencv-nd-matrix"
BASE64 = "$base64$"
BASE64_HEADER = 24
"""Bytes before the values: the type, padded."""


class _Refused(Exception):
    """What is wrong, and in which line (0: unknown)."""

    def __init__(self, message: str, line: int = 0) -> None:
        super().__init__(message)
        self.line = line


def read_filestorage(path: Path) -> dict[str, Any]:
    """The content of an OpenCV FileStorage by name.

    Parameters
    ----------
    path : a YAML, XML or JSON file; the kind is told from its first characters.

    Returns
    -------
    dict
        Matrices as float64 arrays (rows, cols), (rows, cols, channels) or of their ``sizes``; numbers as int or float; texts as
        str; sequences and maps as lists and dicts; None for an empty value. Of several documents the first that has a name counts.

    Raises
    ------
    FormatError
        Not such a file, or one beyond `mvcore.io.limits`; the message starts with path and line.

    Examples
    --------
    >>> Path("left.yml").write_text("%YAML:1.0\\nK: !!opencv-matrix\\n  rows: 1\\n  cols: 2\\n  dt: d\\n  data: [ 1., 2. ]\\n") and None
    >>> read_filestorage(Path("left.yml"))
    {'K': array([[1., 2.]])}
    """
    start = _first_characters(path)
    documents = [_xml(path)] if start.startswith(b"<") else read_yaml(path)
    out: dict[str, Any] = {}
    for document in documents:
        if document is None:
            continue
        if not isinstance(document, dict):
            raise FormatError(f"{path}:1: not an OpenCV FileStorage: expected names with values")
        out = {**document, **out}
    return out


def _first_characters(path: Path) -> bytes:
    """A file's first characters after a byte order mark and white space."""
    if path.exists() and not path.is_file():
        raise FormatError(f"{path}: expected a regular file")
    with path.open("rb") as file:
        return file.read(256).removeprefix(b"\xef\xbb\xbf").lstrip()


def read_yaml(path: Path) -> list[Any]:
    """The documents of a YAML (or JSON) file; mappings tagged as OpenCV matrices are float64 arrays.

    Scalars are numbers, None (``null``, ``~`` or nothing) or text; there are no dates and no booleans.

    Raises
    ------
    FormatError
        Malformed, with aliases or repeated keys, or beyond `mvcore.io.limits`; the message starts with path and line.
    """
    text = read_text(path)
    if text.startswith("%YAML:"):  # OpenCV's header, which is no YAML directive
        text = "#" + text
    text = text.replace("\\'", "'")  # OpenCV escapes an apostrophe, YAML does not
    if text.startswith("{"):  # JSON with OpenCV's comments
        text = "\n".join("" if line.lstrip().startswith("//") else line for line in text.split("\n"))
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return list(_documents(yaml.parse(text, Loader=loader)))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        message, line = getattr(error, "problem", None) or "not YAML", mark.line + 1 if mark else 1
    except _Refused as error:
        message, line = str(error), error.line or 1
    raise FormatError(f"{path}:{line}: {message}")


@dataclass
class _Open:
    """A sequence or mapping whose end has not come."""

    value: Any
    tag: str
    line: int
    key: str | None = None


def _documents(events: Iterator[Any]) -> Iterator[Any]:
    """Each document's value from a parser's events, without recursion."""
    stack: list[_Open] = []
    for count, event in enumerate(events):
        line = event.start_mark.line + 1
        if count > 2 * MOST_NODES or len(stack) > MOST_DEPTH:
            raise _Refused(f"expected at most {MOST_NODES} values, nested at most {MOST_DEPTH} deep", line)
        if isinstance(event, yaml.AliasEvent):
            raise _Refused("aliases (*name) are not read", line)
        if isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
            empty: Any = [] if isinstance(event, yaml.SequenceStartEvent) else {}
            stack.append(_Open(empty, (event.tag or "").rpartition(":")[2], line))
            continue
        if isinstance(event, yaml.ScalarEvent):
            plain = event.implicit[0] and not event.style
            naming = bool(stack) and isinstance(stack[-1].value, dict) and stack[-1].key is None
            value = _scalar(event.value) if plain and not naming else event.value
            if (event.tag or "").endswith(":binary") or event.value.startswith(BASE64):
                value = _decoded(event.value.removeprefix(BASE64), line)
        elif isinstance(event, yaml.SequenceEndEvent | yaml.MappingEndEvent):
            ended = stack.pop()
            value = _finished(ended.value, ended.tag, ended.line)
        else:
            continue
        if stack:
            _attach(stack[-1], value, line)
        else:
            yield value


def _attach(parent: _Open, value: Any, line: int) -> None:
    if isinstance(parent.value, list):
        parent.value.append(value)
    elif parent.key is None:
        if not isinstance(value, str):
            raise _Refused("expected a name before the colon", line)
        if value in parent.value:
            raise _Refused(f"{value:.80} stands there twice", line)
        parent.key = value
    else:
        parent.value[parent.key], parent.key = value, None


def _scalar(text: str) -> Any:
    """A plain scalar: a number, None or the text itself."""
    if text.lower() in CONSTANTS:
        return CONSTANTS[text.lower()]
    if len(text) > MOST_DIGITS or LEADING_ZERO.fullmatch(text):
        return text
    if INTEGER.fullmatch(text):
        return int(text)
    return float(text) if REAL.fullmatch(text) else text


def _finished(value: Any, tag: str, line: int) -> Any:
    kind = value.get("type_id", tag) if isinstance(value, dict) else tag
    return _matrix(value, kind, line) if isinstance(value, dict) and kind in (MATRIX, ND_MATRIX) else value


def _matrix(node: dict[str, Any], kind: str, line: int) -> NDArray[np.float64]:
    """A matrix from its size, type and values."""
    sizes = [node.get("rows"), node.get("cols")] if kind == MATRIX else node.get("sizes")
    sizes = sizes if isinstance(sizes, list) else [sizes]
    if not sizes or not all(type(n) is int and 0 <= n <= MOST_NODES for n in sizes):
        raise _Refused(f"matrix: expected whole numbers {'rows, cols' if kind == MATRIX else 'sizes'}, got {sizes!r:.80}", line)
    letters = TYPE.fullmatch(str(node.get("dt")))
    if letters is None or letters[2] not in TYPES:
        raise _Refused(f"matrix: expected a type dt such as d, f or 3f, got {node.get('dt')!r:.80}", line)
    channels = int(letters[1] or 1)
    shape = [*sizes, channels] if channels != 1 else sizes
    data = _values(node.get("data"), letters[2], line)
    if len(data) != math.prod(shape):
        raise _Refused(f"matrix: expected {' x '.join(map(str, shape))} values, got {len(data)}", line)
    return data.reshape(shape)


def _values(values: Any, letter: str, line: int) -> NDArray[np.float64]:
    values = values if isinstance(values, list) else [] if values is None else [values]
    try:
        with np.errstate(over="ignore"):
            array = np.array([float(v) for v in values]).astype(STORED.get(letter, np.float64))
        return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        wrong = next(v for v in values if type(v) not in (int, float))
        raise _Refused(f"matrix: expected numbers, got {wrong!r:.80}", line) from None


def _decoded(text: str, line: int) -> list[Any]:
    """The numbers of a sequence that was written in base64: a header with their type, then little-endian values."""
    try:
        raw = base64.b64decode("".join(text.split()), validate=True)
        kind = TYPE.fullmatch(raw[:BASE64_HEADER].decode("ascii").strip())
        return np.frombuffer(raw[BASE64_HEADER:], "<" + TYPES[kind[2] if kind else ""]).tolist()
    except (binascii.Error, ValueError, KeyError) as error:
        raise _Refused(f"expected numbers in base64 behind their type: {error}", line) from None


class _Tree(ElementTree.TreeBuilder):
    """Elements of limited number and depth; no document type, and so no entities."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.count = 0

    def start(self, tag: Any, attrs: Any) -> Any:
        """An element begins."""
        self.depth, self.count = self.depth + 1, self.count + 1
        if self.depth > MOST_DEPTH or self.count > MOST_NODES:
            raise _Refused(f"expected at most {MOST_NODES} elements, nested at most {MOST_DEPTH} deep")
        return super().start(tag, attrs)

    def end(self, tag: Any) -> Any:
        """An element ends."""
        self.depth -= 1
        return super().end(tag)

    def doctype(self, name: Any, pubid: Any, system: Any) -> None:
        """Refuse: a document type can define entities that grow without end."""
        raise _Refused("a document type (<!DOCTYPE>) is not read")


def read_xml(path: Path) -> ElementTree.Element:
    """The root element of an XML file; raises as `parse_xml`, or OSError."""
    return parse_xml(path, read_bytes(path, MOST_TEXT))


def parse_xml(path: Path, data: bytes) -> ElementTree.Element:
    """The root element of an XML file's content.

    Raises
    ------
    FormatError
        Malformed, of an unknown encoding, with a document type, or beyond `mvcore.io.limits`; the message starts with path and line.
    """
    try:
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_Tree()))
    except ElementTree.ParseError as error:
        line, message = error.position[0], error.msg.partition(":")[0]
    except _Refused as error:
        line, message = 1, str(error)
    except (LookupError, ValueError) as error:  # encodings that expat does not know
        line, message = 1, str(error)
    raise FormatError(f"{path}:{line}: not XML that can be read: {message}")


def _xml(path: Path) -> dict[str, Any]:
    # A quote from an entity does not end a text; expat does not tell the two apart.
    root = parse_xml(path, read_bytes(path, MOST_TEXT).replace(b"&quot;", b"&#xE022;"))
    if root.tag != "opencv_storage":
        raise FormatError(f"{path}:1: not an OpenCV FileStorage: expected <opencv_storage>, got <{root.tag:.80}>")
    try:
        value = _element(root)
    except _Refused as error:
        raise FormatError(f"{path}: {error}") from None
    return value if isinstance(value, dict) else {}


QUOTE = "\ue022"
"""A quote within a text, in Unicode's private area."""
XML_WORD = re.compile(r'"([^"]*)"|\S+')


def _words(text: str | None) -> list[Any]:
    words = XML_WORD.finditer(text or "")
    return [m[1].replace(QUOTE, '"') if m[1] is not None else _scalar(m[0]) for m in words]


def _element(element: ElementTree.Element) -> Any:
    """An element's value; its depth is limited by `read_xml`."""
    if element.get("type_id") == "binary":
        return _decoded(element.text or "", 0)
    items = _words(element.text)
    named: dict[str, Any] = {}
    for child in element:
        value = _element(child)
        if child.tag == "_":
            items.append(value)
        elif child.tag in named:
            raise _Refused(f"{child.tag:.80} stands there twice")
        else:
            named[child.tag] = value
        items += _words(child.tail)
    if named:
        try:
            return _finished(named, element.get("type_id", ""), 0)
        except _Refused as error:
            raise _Refused(f"{element.tag:.80}: {error}") from None
    if any(child.tag == "_" for child in element):
        return items
    return items if len(items) > 1 else items[0] if items else None
