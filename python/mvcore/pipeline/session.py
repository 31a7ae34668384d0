"""Where a run's results lie and what runs its tasks."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..config import Config
from ..errors import require
from ..geometry.cameras import Camera
from ..types import DepthMap
from .cache import Cache
from .cluster import Cluster
from .executors import local_workers, open_pool
from .store import Store
from .tasks import Place, Runner, Task

CACHE = 256 << 20
"""Bytes of results kept in memory where ``max_memory`` is not given."""
REMOTE_THREADS = 64
"""Tasks that are sent out at a time to an executor or a cluster."""


TEMPORARY: set[Path] = set()
"""Folders that are removed at the latest when the process ends."""


class Workdir:
    """A folder of results; a temporary one is removed with its last user."""

    def __init__(self, folder: str | Path | None) -> None:
        self.temporary, self.kept = folder is None, set[str]()
        self.folder = Path(folder if folder is not None else tempfile.mkdtemp(prefix="mvcore-")).absolute()
        if self.temporary:
            TEMPORARY.add(self.folder)
            weakref.finalize(self, remove_temporary, self.folder)


def remove_temporary(folder: Path) -> None:
    """Removes a temporary folder with all that is in it."""
    shutil.rmtree(folder, ignore_errors=True)
    TEMPORARY.discard(folder)


class StoredDepths(Sequence[DepthMap | None]):
    """Depth maps of a run, (h, w) each; None where a view has none. Each is read when it is indexed."""

    def __init__(self, workdir: Workdir, cache: Cache, keys: Sequence[str | None]) -> None:
        self._workdir, self._cache, self._keys = workdir, cache, list(keys)

    def __len__(self) -> int:
        return len(self._keys)

    def __getitem__(self, n: Any) -> Any:
        if isinstance(n, slice):
            return StoredDepths(self._workdir, self._cache, self._keys[n])
        key = self._keys[n]
        return None if key is None else self._cache.get(key)


def stored_depths(workdir: Workdir, runner: Runner, tasks: Sequence[Task[DepthMap] | None]) -> StoredDepths:
    """The depth maps of tasks that are done."""
    keys = [None if t is None else t.key for t in tasks]
    workdir.kept.update(k for k in keys if k is not None)
    return StoredDepths(workdir, runner.cache, keys)


def memory_settings(config: Config, max_memory: int | None, cameras: Sequence[Camera]) -> tuple[Config, int, int]:
    """How ``max_memory`` is divided: the settings, bytes of results kept in memory, and local tasks at a time.

    Parameters
    ----------
    max_memory : bytes that the process may take beyond what it takes idle; None for no bound.
    cameras : as calibrated; the largest view counts, reduced as it is matched.

    Raises
    ------
    InvalidInputError
        The bound is too small for one view.
    """
    if max_memory is None:
        return config, CACHE, local_workers()
    limit = config.depth.max_image_size
    sides = [(c.width, c.height, min(1.0, limit / max(c.width, c.height))) for c in cameras]
    pixels = max(int(width * height * scale**2) for width, height, scale in sides)
    task = TASK_BYTES * pixels + TASK_LEAST
    least = 2 * task
    require(
        max_memory >= least,
        "max_memory",
        f"at least {least / 2**20:.0f} MiB for views of {pixels / 1e6:.1f} MP",
        f"{max_memory / 2**20:.0f} MiB",
    )
    threads = max(1, min(local_workers(), int(0.5 * max_memory // task)))
    volume = replace(config.volume, max_memory=min(config.volume.max_memory, int(0.25 * max_memory)))
    return replace(config, volume=volume), int(0.25 * max_memory), threads


TASK_BYTES = 160
"""Bytes a pixel of a depth task: the pyramids of seven views and the refinement's planes."""
TASK_LEAST = 64 << 20
"""Bytes of a depth task beside these: the sweep's costs."""


@contextmanager
def open_session(
    workdir: str | Path | None,
    executor: Executor | None,
    scheduler: str | Cluster | None,
    budget: int,
    threads: int,
) -> Iterator[tuple[Workdir, Runner]]:
    """A runner on a workdir (a temporary one by default) and on local threads, an executor or a cluster."""
    require(executor is None or scheduler is None, "executor, scheduler", "one of them", "both")
    place, remote = Workdir(workdir), executor is not None or scheduler is not None
    if workdir is not None:
        place.folder.mkdir(parents=True, exist_ok=True)
        require(os.access(place.folder, os.W_OK), "workdir", "a folder that can be written", str(place.folder))
    through = remote or not place.temporary
    with (
        Store(place.folder).lease(),
        open_pool(executor, scheduler) if remote else nullcontext() as pool,
        Runner(Place(place.folder, budget, through), pool, REMOTE_THREADS if remote else threads) as runner,
    ):
        yield place, runner
        if place.temporary:
            runner.forget_all_but(place.kept)
