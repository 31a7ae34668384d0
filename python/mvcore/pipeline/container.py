"""The file of a stored result: JSON and raw arrays, each with a digest of its bytes.

    magic | bytes of the header | digest of these and the header | header: JSON | padding | array | padding | array ...

The header names each array's type, shape, place and digest. Nothing is unpickled, and every size is checked against the file's before
memory is asked for, so that a reader takes no harm from whatever the file holds. Arrays start on 64 bytes and can be mapped.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import stat
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import require

MAGIC = b"mvcore\x00\x01"
DIGEST = 32
"""Bytes of a digest."""
PREFIX = struct.Struct(f"<8sQ{DIGEST}s")
ALIGNMENT = 64
KINDS = "biufcSU"
"""NumPy's letters of the types that are kept: raw bytes say all of them."""
MAPPED = 1 << 20
"""Bytes from which mapping an array pays."""


class Damaged(Exception):
    """A file is not what `write` made of the same key; the message says in what."""


def _digest(*parts: Any) -> bytes:
    state = hashlib.blake2b(digest_size=DIGEST)
    for part in parts:
        state.update(part)
    return state.digest()


def _bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """An array's memory, byte by byte."""
    return array.reshape(-1).view(np.uint8) if array.size else np.empty(0, np.uint8)


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


def write(file: BinaryIO, key: str, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> None:
    """Write an entry.

    Raises
    ------
    InvalidInputError
        An array holds objects or records.
    """
    kept = {name: np.asarray(a, order="C") for name, a in arrays.items()}
    table = []
    for name, a in kept.items():
        require(a.dtype.kind in KINDS and not a.dtype.hasobject, f"arrays[{name!r}]", "numbers, booleans or text", a.dtype)
        table.append({"name": name, "type": a.dtype.str, "shape": a.shape, "digest": _digest(_bytes(a)).hex()})
    header = json.dumps({"key": key, "meta": meta, "arrays": table}, sort_keys=True).encode()
    start = MAGIC + struct.pack("<Q", len(header))
    file.write(start + _digest(start, header) + header)
    for a in kept.values():
        file.write(bytes(_aligned(file.tell()) - file.tell()))
        file.write(_bytes(a))


@dataclass(frozen=True)
class _Place:
    """An array within a file."""

    type: np.dtype[Any]
    shape: tuple[int, ...]
    start: int
    digest: str

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.type.itemsize


def read(
    path: Path, key: str, names: Collection[str] | None = None, mapped: bool = False
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """An entry's arrays, all or those named, and its plain values; what is read is compared with its digest.

    ``mapped`` arrays of a MiB or more stay in the file, read-only, and take memory that the system can have back.

    Raises
    ------
    Damaged
        The file is not the entry of this key.
    FileNotFoundError
        There is no file.
    InvalidInputError
        The entry has no array of a name.
    """
    if not stat.S_ISREG(path.lstat().st_mode):
        raise Damaged("it is not a file")
    try:
        with path.open("rb", buffering=0) as file:
            header, end = _header(file)
            if header["key"] != key:
                raise Damaged("it is the result of other work")
            places = _places(header["arrays"], end, os.fstat(file.fileno()).st_size)
            missing = [n for n in names or () if n not in places]
            require(not missing, "names", f"arrays of {path}: {', '.join(places)}", ", ".join(missing))
            wanted = {n: p for n, p in places.items() if names is None or n in names}
            return {n: _array(file, p, mapped) for n, p in wanted.items()}, header["meta"]
    except OSError as error:
        if error.errno == errno.EIO:
            raise Damaged("the disk cannot read it") from None
        raise


def _header(file: Any) -> tuple[dict[str, Any], int]:
    """The parsed header and the byte after it."""
    prefix, size = _exactly(file, PREFIX.size), os.fstat(file.fileno()).st_size
    magic, length, expected = PREFIX.unpack(prefix)
    if magic != MAGIC:
        raise Damaged("it starts otherwise than a stored result")
    if length > size - PREFIX.size:
        raise Damaged("it is cut off")
    text = _exactly(file, length)
    if _digest(prefix[:-DIGEST], text) != expected:
        raise Damaged("its header does not have its digest")
    try:
        header = json.loads(text)
    except (ValueError, RecursionError):
        raise Damaged("its header cannot be read") from None
    if not isinstance(header, dict) or not {"key", "arrays", "meta"} <= header.keys() or not isinstance(header["meta"], dict):
        raise Damaged("its header cannot be read")
    return header, PREFIX.size + length


def _places(table: Any, end: int, size: int) -> dict[str, _Place]:
    """Where arrays lie, each after the one before, and the last one up to the end of the file."""
    places: dict[str, _Place] = {}
    try:
        for row in table:
            kind, shape = np.dtype(str(row["type"])), tuple(int(n) for n in row["shape"])
            place = _Place(kind, shape, _aligned(end), str(row["digest"]))
            if kind.kind not in KINDS or min(shape, default=0) < 0 or place.start + place.size > size:
                raise Damaged("its header speaks of more than it holds")
            places[str(row["name"])] = place
            end = place.start + place.size
    except (KeyError, TypeError, ValueError, OverflowError):
        raise Damaged("its header cannot be read") from None
    if end != size:
        raise Damaged("it is longer than its header says")
    return places


def _exactly(file: Any, count: int) -> bytes:
    parts = bytearray()
    while len(parts) < count:
        part = file.read(count - len(parts))
        if not part:
            raise Damaged("it is cut off")
        parts += part
    return bytes(parts)


def _array(file: Any, place: _Place, mapped: bool) -> NDArray[Any]:
    if mapped and place.size >= MAPPED:
        array = np.asarray(np.memmap(file, place.type, "r", place.start, place.shape))
    else:
        array = np.empty(place.shape, place.type)
        view = memoryview(_bytes(array)) if array.size else memoryview(b"")
        file.seek(place.start)
        while view:
            count = file.readinto(view)
            if not count:
                raise Damaged("it is cut off")
            view = view[count:]
    if _digest(_bytes(array)).hex() != place.digest:
        raise Damaged("an array does not have its digest")
    return array
