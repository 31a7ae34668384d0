"""Content-addressed results on disk: a job that was done is not done again, and one that was killed goes on."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import re
import shutil
import stat
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import require
from ..io.files import atomically, remove_abandoned
from ..types import LOGGER
from . import container, leases

SUFFIX = ".entry"
LEASES = "runs"
"""Folder of the files that runs hold."""
CLOCKS = 60.0
"""Seconds by which the clocks of machines that share a workdir may differ."""
ABANDONED = 3600.0
"""Seconds after which what a killed process left half done is removed."""
LOOKS = 100
"""Times that an entry is looked for while `Store.clean` has it in hand, each after 10 ms."""


@dataclass(frozen=True)
class Entry:
    """Arrays by name, and plain values that JSON can hold."""

    arrays: dict[str, NDArray[Any]]
    meta: dict[str, Any]


def digest(*parts: Any) -> str:
    """40 hexadecimal digits that depend on the content of nested plain values, arrays, paths and dataclasses alone."""
    state = hashlib.blake2b(digest_size=20)
    _feed(state, parts)
    return state.hexdigest()


def _feed(state: Any, value: Any) -> None:
    # Each value goes in with its kind and length, so that different structures never read the same.
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        state.update(f"array {array.dtype.str} {array.shape}:".encode())
        state.update(array.reshape(-1).view(np.uint8) if array.size else b"")
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        state.update(f"dataclass {type(value).__name__}:".encode())
        _feed(state, {f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    elif isinstance(value, Mapping):
        state.update(f"mapping {len(value)}:".encode())
        for key in sorted(value, key=str):
            _feed(state, str(key))
            _feed(state, value[key])
    elif isinstance(value, bytes):
        state.update(f"bytes {len(value)}:".encode() + value)
    elif isinstance(value, str | Path):
        text = str(value).encode()
        state.update(f"text {len(text)}:".encode() + text)
    elif isinstance(value, Sequence):
        state.update(f"sequence {len(value)}:".encode())
        for part in value:
            _feed(state, part)
    elif value is None or isinstance(value, bool | int | float | np.generic):
        state.update(f"{type(value).__name__} {value!r};".encode())
    else:
        raise TypeError(f"digest: expected plain values, arrays or dataclasses, got {type(value).__name__}")


def file_digest(path: Path) -> str:
    """Of a file's bytes."""
    state = hashlib.blake2b(digest_size=20)
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            state.update(block)
    return state.hexdigest()


class Store:
    """A folder of entries by key. Entries appear whole or not at all, and each is checked against its digests when it is read.

    Several runs may use a folder at once and write the same entries. Nothing is deleted but what is damaged and what `clean` is asked to
    delete; a run that holds a `lease` keeps all that it has used.

    Examples
    --------
    >>> import tempfile
    >>> store = Store(tempfile.mkdtemp())
    >>> key = digest("squares", 3)
    >>> store.save(key, {"squares": np.arange(3) ** 2}, {"unit": "m"})
    >>> store.load(key).arrays["squares"].tolist()
    [0, 1, 4]
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder, self.damages = Path(folder).absolute(), dict[str, str]()
        self.folder.mkdir(parents=True, exist_ok=True)

    def path(self, key: str) -> Path:
        """The file of an entry."""
        require(re.fullmatch(r"\w[\w-]+", key), "key", "letters, digits, _ and -, two or more", repr(key))
        return self.folder / key[:2] / f"{key}{SUFFIX}"

    def __contains__(self, key: str) -> bool:
        """Whether there is a file for the key: quickly, by its size alone; `load` says whether it is whole."""
        path = self.path(key)
        try:
            status = path.lstat()
        except OSError:
            return False
        if not stat.S_ISREG(status.st_mode) or status.st_size < container.PREFIX.size:
            return False
        _touch(path, status)
        return True

    def load(self, key: str, names: Collection[str] | None = None, *, mapped: bool = False) -> Entry | None:
        """An entry, None where there is none; a damaged one is removed with a warning, and there is none.

        Parameters
        ----------
        key : as of `digest`
        names : the arrays to read and check; by default all, () for the plain values alone.
        mapped : large arrays stay in the file, read-only.

        Raises
        ------
        InvalidInputError
            The entry lacks an array of ``names``.
        """
        path, moved = self.path(key), None
        for _ in range(LOOKS):
            try:
                status = path.lstat()
                arrays, meta = container.read(path, key, names, mapped)
            except FileNotFoundError:
                moved = _aside(path)
                if not moved.exists():
                    return None
                time.sleep(0.01)  # `clean` looks at it, and puts it back if it is used
            except container.Damaged as damage:
                self.discard(key, str(damage), status)
                return None
            else:
                _touch(path, status)
                return Entry(arrays, meta)
        return None

    def intact(self, key: str) -> bool:
        """Whether there is an entry and all its digests are right; a damaged one is removed. Arrays are not kept in memory."""
        return self.load(key, mapped=True) is not None

    def save(self, key: str, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> None:
        """Write an entry beside its place, then rename it.

        Raises
        ------
        InvalidInputError
            An array holds objects or records.
        """

        def write(path: Path) -> None:
            with path.open("wb") as file:
                container.write(file, key, arrays, meta)

        path = self.path(key)
        if path.is_dir():
            _discard(path, path.lstat())
        atomically(path, write, durable=False)  # a file that a power failure cut off does not have its digests

    def discard(self, key: str, why: str, status: os.stat_result | None = None) -> None:
        """Remove a damaged entry with a warning.

        ``status`` is that of its file, where another one may have taken its place since.
        """
        path = self.path(key)
        self.damages[key] = f"{path}: this stored result is damaged, {why}; it is removed and computed again"
        LOGGER.warning("%s", self.damages[key])
        with suppress(FileNotFoundError):
            _discard(path, status or path.lstat())

    def drop(self, key: str) -> None:
        """Remove an entry, unless other runs use the folder: they may need it, and `clean` can have it later."""
        if len(leases.live(self.folder / LEASES)) <= 1:
            path = self.path(key)
            with suppress(FileNotFoundError):
                _discard(path, path.lstat())

    def lease(self) -> AbstractContextManager[None]:
        """For the length of a run: what it uses is not removed by `clean`, in whatever process that runs."""
        return leases.hold(self.folder / LEASES)

    def clean(self, max_age: float | None = None, max_bytes: int | None = None) -> Cleaned:
        """Remove entries, those first that were not used for longest, but none that a run with a lease has used.

        Parameters
        ----------
        max_age : seconds since the last use beyond which an entry goes.
        max_bytes : what is left may take at most so many. Without either limit, all entries go that no run has used.
        """
        starts = leases.live(self.folder / LEASES)
        used_since = min(starts, default=math.inf) - CLOCKS
        entries = sorted(self._entries(), key=lambda e: (e.used, e.path))
        total, now, everything = sum(e.size for e in entries), time.time(), max_age is None and max_bytes is None
        removed: list[_File] = []
        for entry in entries:
            old = max_age is not None and now - entry.used > max_age
            large = max_bytes is not None and total > max_bytes
            if (everything or old or large) and entry.used < used_since and entry.remove():
                removed.append(entry)
                total -= entry.size
        for folder in self.folder.glob("??"):
            remove_abandoned(folder, ABANDONED)
            with suppress(OSError):
                folder.rmdir()  # if it is empty
        return Cleaned(len(removed), sum(e.size for e in removed), len(entries) - len(removed), total, len(starts))

    def _entries(self) -> Iterator[_File]:
        for path in self.folder.glob(f"??/*{SUFFIX}"):
            if path.name.startswith("."):
                # A killed `clean` left it.
                if time.time() - path.stat().st_ctime > ABANDONED:
                    path.unlink(missing_ok=True)
                continue
            with suppress(OSError):
                status = path.lstat()
                if stat.S_ISREG(status.st_mode):
                    yield _File(path, status.st_size, status.st_atime)


@dataclass(frozen=True)
class Cleaned:
    """What `Store.clean` did: entries and bytes removed and left, and the runs that use the folder."""

    removed: int
    removed_bytes: int
    left: int
    left_bytes: int
    runs: int


@dataclass(frozen=True)
class _File:
    """An entry's file, its size and when it was last used."""

    path: Path
    size: int
    used: float

    def remove(self) -> bool:
        """Moved aside first: if it was used since it was looked at, it goes back."""
        aside = _aside(self.path)
        try:
            os.rename(self.path, aside)
            if aside.lstat().st_atime != self.used:
                os.rename(aside, self.path)
                return False
            aside.unlink()
        except OSError:  # somebody else removed it, or has it open where that matters
            return False
        return True


def _aside(path: Path) -> Path:
    return path.with_name(f".{path.name}")


def _touch(path: Path, status: os.stat_result) -> None:
    """Notes the use in the access time: the other one says when an entry was written."""
    with suppress(OSError):  # somebody else's
        os.utime(path, ns=(time.time_ns(), status.st_mtime_ns))


def _discard(path: Path, status: os.stat_result) -> None:
    """Removes what was seen at a path, not what another process has put there since."""
    with suppress(FileNotFoundError):
        if not os.path.samestat(path.lstat(), status):
            return
        if stat.S_ISDIR(status.st_mode):
            shutil.rmtree(path)
        else:
            path.unlink()
