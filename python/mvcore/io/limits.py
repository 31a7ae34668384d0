"""How much a file may declare before mvcore takes it: sizes are checked before memory is.

A few kilobytes can declare gigabytes (images, archives) or nest without end (YAML, JSON, XML). The limits are far above what
calibrations and images hold, and far below what a machine of 16 GB has.
"""

from __future__ import annotations

from pathlib import Path

from ..errors import FormatError

MOST_TEXT = 64 << 20
"""Bytes of a calibration file that is read as text."""
MOST_NODES = 1_000_000
"""Values of a YAML, XML or JSON file."""
MOST_DEPTH = 64
"""Levels of nesting of a YAML, XML or JSON file; calibrations have four."""

MOST_SIDE = 1 << 17
"""Pixels along a side of an image."""


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """A UTF-8 text file (a byte order mark is passed over) of at most ``most`` bytes.

    Raises
    ------
    OSError
        The file cannot be read.
    FormatError
        Another kind of file than a regular one, a larger file, or one that is no UTF-8 text.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise FormatError(f"{path}:{line}: not a UTF-8 text file") from None


def read_bytes(path: Path, most: int) -> bytes:
    """A regular file's bytes, at most ``most`` of them; raises as `read_text`."""
    if path.exists() and not path.is_file():
        raise FormatError(f"{path}: expected a regular file")
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise FormatError(f"{path}: expected a file of at most {most >> 20} MiB")
    return data
