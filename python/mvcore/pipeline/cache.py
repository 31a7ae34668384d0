"""Results by key, as values in memory up to a number of bytes, the others in a `Store`."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

from .store import Store
from .values import Arrays, pack, unpack


class Missing(LookupError):
    """A result that was there is gone or damaged; whoever knows how it was made makes it again.

    damage : what was logged of it. process : the number of the process that logged it.
    """

    def __init__(self, key: str, damage: str = "", process: int | None = None) -> None:
        process = os.getpid() if process is None else process
        super().__init__(key, damage, process)
        self.key, self.damage, self.process = key, damage, process


class Cache:
    """Values by key. Thread-safe.

    Parameters
    ----------
    folder : of the store.
    budget : bytes of values kept in memory; the least recently used ones leave first.
    through : every value is written at once; else only those that leave memory (one process, a temporary folder).
    """

    def __init__(self, folder: Path, budget: int, through: bool) -> None:
        self.store, self.budget, self.through = Store(folder), budget, through
        self._values: OrderedDict[str, tuple[Any, int]] = OrderedDict()
        self._held = 0
        self._lock = threading.RLock()

    def __contains__(self, key: str) -> bool:
        """Whether it is there for all who use the folder.

        Where values are written at once, one that has vanished from the folder is not, though it be in memory.
        """
        with self._lock:
            return (key in self._values and not self.through) or key in self.store

    def intact(self, key: str) -> bool:
        """The same, and all of it can be read."""
        with self._lock:
            held = key in self._values and not self.through
        return held or self.store.intact(key)

    def warnings(self, key: str) -> list[str] | None:
        """Of a value, without its arrays; None where it is not there."""
        with self._lock:
            if key in self._values:
                return warnings_of(self._values[key][0])
        entry = self.store.load(key, ())
        return None if entry is None else [str(w) for w in entry.meta.get("warnings", [])]

    def get(self, key: str) -> Any:
        """A value.

        Raises
        ------
        Missing
            It is not there, or what is there is damaged.
        """
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key][0]
        entry = self.store.load(key)
        if entry is None:
            raise Missing(key, self.store.damages.pop(key, ""))
        try:
            value = unpack(entry.arrays, entry.meta["value"])
        except (ValueError, KeyError) as error:
            self.store.discard(key, str(error))
            raise Missing(key, self.store.damages.pop(key, "")) from None
        self._keep(key, value, sum(a.nbytes for a in entry.arrays.values()))
        return value

    def put(self, key: str, value: Any) -> None:
        """Keep a value."""
        packed = pack(value)
        if self.through:
            self._save(key, value, packed)
        self._keep(key, value, sum(a.nbytes for a in packed[0].values()))

    def drop(self, key: str) -> None:
        """Forget a value, on disk as well unless other runs are there."""
        with self._lock:
            self._held -= self._values.pop(key, (None, 0))[1]
        self.store.drop(key)

    def _keep(self, key: str, value: Any, size: int) -> None:
        with self._lock:
            self._held += size - self._values.pop(key, (None, 0))[1]
            self._values[key] = (value, size)
            while self._held > self.budget and self._values:
                old, (left, bytes_) = self._values.popitem(last=False)
                if old not in self.store:
                    self._save(old, left, pack(left))
                self._held -= bytes_

    def _save(self, key: str, value: Any, packed: tuple[Arrays, Any]) -> None:
        arrays, tree = packed
        self.store.save(key, arrays, {"value": tree, "warnings": warnings_of(value)})


def warnings_of(value: Any) -> list[str]:
    """What a result warns of: itself, or in its findings."""
    return list(getattr(getattr(value, "findings", value), "warnings", ()))


_CACHES: dict[Path, Cache] = {}
_LOCK = threading.Lock()


def cache_of(folder: Path, budget: int, through: bool) -> Cache:
    """The process's cache of a folder: tasks of one process share it."""
    with _LOCK:
        if folder not in _CACHES:
            _CACHES[folder] = Cache(folder, budget, through)
        return _CACHES[folder]


def forget(folder: Path) -> None:
    """Drop the process's cache of a folder; what lies there stays."""
    with _LOCK:
        _CACHES.pop(folder, None)
