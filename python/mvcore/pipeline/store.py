"""Content-addressed results on disk: a job that was done is not done again, and one that was killed goes on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..io.files import atomically

META = "meta"
"""Name of the array that holds an entry's JSON."""


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
        state.update(memoryview(array).cast("B") if array.size else b"")
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
    """A folder of entries by key. Entries appear whole or not at all; several processes may write the same one."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).absolute()
        self.folder.mkdir(parents=True, exist_ok=True)

    def path(self, key: str) -> Path:
        """The file of an entry."""
        return self.folder / key[:2] / f"{key}.npz"

    def __contains__(self, key: str) -> bool:
        return self.path(key).is_file()

    def load(self, key: str) -> Entry | None:
        """An entry, None where there is none; a damaged one is removed."""
        path = self.path(key)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            meta = json.loads(arrays.pop(META).tobytes())
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError):
            path.unlink(missing_ok=True)
            return None
        return Entry(arrays, meta)

    def save(self, key: str, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> None:
        """Write an entry beside its place, then rename it."""
        text = np.frombuffer(json.dumps(meta, sort_keys=True).encode(), np.uint8)
        atomically(self.path(key), lambda p: np.savez(p, **{**arrays, META: text}))
