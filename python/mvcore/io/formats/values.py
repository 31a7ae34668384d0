"""Values of parsed files together with their place, so that every refusal names file and key."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from .. import limits
from ..limits import MOST_SIDE, read_text
from ..pairing import natural_order
from .places import IMAGE_SUFFIXES, named

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

Float = NDArray[np.float64]

MOST_VALUES = 8_000_000
"""Values of a JSON file; each takes up to about 100 bytes once parsed."""
HEAD = 4096
"""Bytes of a file that are looked at to tell its format."""


class Entry:
    """A value of a parsed file, and the keys that lead to it (``frames[3].fx``)."""

    def __init__(self, value: Any, source: Path | str, key: str = "") -> None:
        self.value, self.source, self.key = value, source, key

    def fail(self, message: str) -> FormatError:
        """An error at this value."""
        return FormatError(f"{self.source}: {self.key}: {message}" if self.key else f"{self.source}: {message}")

    def _expected(self, what: str) -> FormatError:
        return self.fail(f"expected {what}, got {self.value!r:.60}")

    def _child(self, name: Any) -> Entry:
        key = f"{self.key}[{name}]" if isinstance(name, int) else f"{self.key}.{name}" if self.key else str(name)
        return Entry(self.value[name], self.source, key)

    def get(self, *names: str) -> Entry | None:
        """The first of the names that the mapping holds with a value; None where it holds none."""
        if not isinstance(self.value, dict):
            raise self._expected("names with values")
        return next((self._child(n) for n in names if self.value.get(n) is not None), None)

    def need(self, *names: str) -> Entry:
        """As `get`, with an error where there is none."""
        found = self.get(*names)
        if found is None:
            raise self.fail(f"{' or '.join(names)} missing")
        return found

    def __iter__(self) -> Iterator[Entry]:
        if not isinstance(self.value, list):
            raise self._expected("a list")
        return (self._child(n) for n in range(len(self.value)))

    def items(self) -> Iterator[tuple[str, Entry]]:
        """Names and values of a mapping."""
        if not isinstance(self.value, dict):
            raise self._expected("names with values")
        return ((str(n), self._child(n)) for n in self.value)

    def number(self) -> float:
        """A finite number, or the text of one."""
        try:
            value = float(self.value)
        except (TypeError, ValueError, OverflowError):
            value = math.nan
        if not math.isfinite(value) or isinstance(self.value, bool):
            raise self._expected("a finite number")
        return value

    def integer(self) -> int:
        """A whole number; 320.0 and "320" are ones."""
        value = self.number()
        if value != int(value) or abs(value) > 2**53:
            raise self._expected("a whole number")
        return int(value)

    def pixels(self) -> int:
        """A width or height."""
        value = self.integer()
        if not 0 < value <= MOST_SIDE:
            raise self._expected(f"a size of 1 .. {MOST_SIDE} pixels")
        return value

    def text(self) -> str:
        """A text; numbers count as their digits."""
        if isinstance(self.value, bool) or not isinstance(self.value, str | int | float):
            raise self._expected("a text")
        return str(self.value)

    def flag(self) -> bool:
        """Yes or no, as a boolean, a number or a word."""
        if isinstance(self.value, str):
            return self.value.strip().lower() in ("true", "1", "yes")
        return bool(self.number()) if not isinstance(self.value, bool) else self.value

    def numbers(self) -> list[float]:
        """All numbers of a (nested) list or matrix in their order; a single number counts as one."""
        try:
            values = np.asarray(self.value, np.float64).reshape(-1)
        except (TypeError, ValueError, OverflowError, RecursionError):
            raise self._expected("numbers") from None
        if not np.isfinite(values).all():
            raise self.fail("NaN, infinity or nothing among the numbers")
        return values.tolist()

    def array(self, *shape: int) -> Float:
        """A matrix of as many numbers as the shape has, however they are nested."""
        values = self.numbers()
        if len(values) != math.prod(shape):
            raise self.fail(f"expected {' x '.join(map(str, shape))} numbers, got {len(values)}")
        return np.array(values).reshape(shape)


def read_json(path: Path) -> Entry:
    """A JSON file.

    Raises
    ------
    FormatError
        No JSON, too large, or nested too deep; with path and line.
    """
    text = read_text(path)
    if text.count(",") + text.count("[") + text.count("{") > MOST_VALUES:
        raise FormatError(f"{path}: expected at most {MOST_VALUES} values")
    return Entry(limits.read_json(path), path)


def read_toml(path: Path) -> Entry:
    """A TOML file; raises as `read_json`."""
    text = read_text(path)
    try:
        return Entry(tomllib.loads(text), path)
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"at line (\d+)", str(error))
        raise FormatError(f"{path}:{line[1] if line else 1}: not TOML: {error}") from None
    except (RecursionError, ValueError) as error:
        raise FormatError(f"{path}: not TOML: {type(error).__name__}: {error!s:.80}") from None


class Rows:
    """A text file's lines, split into words; errors name path and line (counted from 1)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = read_text(path).splitlines()

    def fail(self, line: int, message: str) -> FormatError:
        """An error at a line."""
        return FormatError(f"{self.path}:{line}: {message}")

    def content(self, comment: str = "#") -> Iterator[tuple[int, str]]:
        """Number and text of each line that is neither empty nor a comment."""
        for n, line in enumerate(self.lines, 1):
            if line.strip() and not line.lstrip().startswith(comment):
                yield n, line.strip()

    def numbers(self, line: int, words: list[str], count: int | None = None) -> list[float]:
        """Words as finite numbers, ``count`` of them."""
        try:
            values = [float(w) for w in words]
        except ValueError:
            wrong = next(w for w in words if not _is_number(w))
            raise self.fail(line, f"expected numbers, got {wrong!r:.40}") from None
        if count is not None and len(values) != count:
            raise self.fail(line, f"expected {count} numbers, got {len(values)}")
        if not all(map(math.isfinite, values)):
            raise self.fail(line, "NaN or infinity")
        return values


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def known_file(folder: Path, names: Sequence[str], knows: Callable[[Path], Path | None]) -> Path | None:
    """The first file of one of the names in a folder whose content a format knows."""
    return next((f for n in names if (f := named(folder, n)) is not None and knows(f)), None)


def head(path: Path, size: int = HEAD) -> str:
    """The first characters of a regular file, without a byte order mark; empty where there is none to read."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return file.read(size).decode("utf-8", "replace").lstrip("\ufeff")
    except OSError:
        return ""


def images_in(folder: Path) -> list[Path]:
    """A folder's images in natural order."""
    return sorted(files_in(folder, *IMAGE_SUFFIXES), key=natural_order)


def files_in(folder: Path, *suffixes: str) -> list[Path]:
    """A folder's files with one of the suffixes (lower case), by name, hidden ones apart; none where it is no folder."""
    if not folder.is_dir():
        return []
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".") and f.is_file())
