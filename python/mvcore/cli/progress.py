"""How far a command is: bars and an overall estimate on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

T = TypeVar("T")

EVERY = 5.0
"""Seconds between two lines where there is no terminal."""
SOON = 2.0
"""Seconds after which a stage is worth its first line."""
LEAST = 0.03
"""Share of the whole that must be done before it is extrapolated."""
SHARES = {
    "images": 1.0,
    "sparse points": 15.0,
    "target": 1.0,
    "depth, first pass": 14.0,
    "depth, second pass": 22.0,
    "geometric filter": 3.0,
    "intermediate surface": 8.0,
    "depth, third pass": 21.0,
    "fusion": 9.0,
    "surface": 3.0,
    "texture": 5.0,
}
"""Shares of a reconstruction's time, as the bundled sample takes it, for the overall estimate; other stages do not enter it."""


@lru_cache(maxsize=1)
def console() -> Console:
    """The one that bars and warnings share, on what stderr is at the time."""
    from rich.console import Console

    return Console(stderr=True)


@dataclass
class _Stage:
    """A stage that runs: how much of it is done, and since when."""

    name: str
    total: int | None
    started: float
    done: int = 0
    shown: float = field(default=-1e9)

    @property
    def share(self) -> float:
        """0 .. 1; 0 where it is not known how much there is to do."""
        return min(1.0, self.done / self.total) if self.total else 0.0


class Progress:
    """A `Track`; several may be open at once, in one thread or in several.

    A stage that encloses all others, such as the frames of a clip, is itself the measure of the whole. Without one, the whole is
    extrapolated from the stages that are done by their typical ``shares``.
    """

    def __init__(self, shares: Mapping[str, float] = SHARES, every: float = EVERY) -> None:
        self.shares = shares
        self.every = every
        self.begun: float | None = None
        self.stages: list[_Stage] = []
        self.past: list[str] = []
        self._lock = threading.RLock()
        self._screen = _Bars() if console().is_terminal else None

    def __call__(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        """The items again, one by one."""
        if total is None:
            total = len(items) if isinstance(items, Sized) else None
        with self._open(description, total) as stage:
            for item in items:
                yield item
                with self._lock:
                    stage.done += 1
                    self._show()

    @contextmanager
    def _open(self, name: str, total: int | None) -> Iterator[_Stage]:
        stage = _Stage(name, total, time.monotonic())
        with self._lock:
            self.begun = stage.started if self.begun is None else self.begun
            self.stages.append(stage)
            alone = len(self.stages) == 1
            self._show()
        # A long item of a stage must not keep it from being shown.
        clock = _Clock(self._tick, min(1.0, self.every)) if alone else None
        try:
            yield stage
        finally:
            if clock:
                clock.stop()
            with self._lock:
                self.stages.remove(stage)
                self.past.append(name)
                self._show()

    def overall(self) -> tuple[float, float] | None:
        """Share of the whole that is done, and seconds that are left; None while too little is known."""
        with self._lock:
            now, begun = time.monotonic(), self.begun
            if begun is None or not self.stages:
                return None
            first = self.stages[0]
            if first.name not in self.shares:
                done, elapsed = first.share, now - first.started
            else:
                done, elapsed = self._weighed(), now - begun
            return (done, elapsed / done - elapsed) if done >= LEAST else None

    def _weighed(self) -> float:
        running = {s.name: s.share for s in self.stages}
        reached = [*self.past, *running]
        order = list(self.shares)
        last = max((order.index(name) for name in reached if name in self.shares), default=-1)
        # Stages before the furthest one that never came were not needed: they are no part of the whole.
        whole = sum(share for n, (name, share) in enumerate(self.shares.items()) if name in reached or n > last)
        part = sum(share * running.get(name, 1.0) for name, share in self.shares.items() if name in reached)
        return part / whole if whole else 0.0

    def _tick(self) -> None:
        with self._lock:
            self._show()

    def _show(self) -> None:
        whole = self.overall()
        if self._screen:
            self._screen.show(self.stages, whole)
            return
        now = time.monotonic()
        for stage in self.stages:
            if now - stage.started >= min(SOON, self.every) and now - stage.shown >= self.every:
                stage.shown = now
                console().print(line(stage, now, whole), markup=False, highlight=False, soft_wrap=True)


def line(stage: _Stage, now: float, whole: tuple[float, float] | None) -> str:
    """What is said of a stage, e.g. ``depth, first pass: 12 of 49, 31 s; about 2 min left in all``."""
    of = f" of {stage.total}" if stage.total is not None else ""
    left = f"; about {duration(whole[1])} left in all" if whole else ""
    return f"{stage.name}: {stage.done}{of}, {duration(now - stage.started)}{left}"


def duration(seconds: float) -> str:
    """Of seconds, in the largest unit that leaves two digits."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


class _Clock:
    """Calls a function at intervals until it is stopped."""

    def __init__(self, call: Callable[[], None], interval: float) -> None:
        self._over = threading.Event()
        self._call, self._interval = call, interval
        threading.Thread(target=self._run, name="mvcore-progress", daemon=True).start()

    def _run(self) -> None:
        while not self._over.wait(self._interval):
            self._call()

    def stop(self) -> None:
        """No call begins afterwards but one that has begun."""
        self._over.set()


class _Bars:
    """rich's bars: one a stage and one for the whole; they are there while a stage is."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
        )
        self.bars = Progress(*columns, console=console())
        self.tasks: dict[int, tuple[_Stage, TaskID]] = {}

    def show(self, stages: list[_Stage], whole: tuple[float, float] | None) -> None:
        """Brings the bars up to date."""
        if stages and not self.bars.live.is_started:
            self.bars.start()
        running = {id(s) for s in stages}
        for key in [k for k in self.tasks if k not in running]:
            stage, task = self.tasks.pop(key)
            self.bars.update(task, completed=stage.done, total=stage.total or stage.done, left="")
            self.bars.stop_task(task)
        for stage in stages:
            if id(stage) not in self.tasks:
                self.tasks[id(stage)] = stage, self.bars.add_task(stage.name, total=stage.total, left="")
            left = f"about {duration(whole[1])} left in all" if whole and stage is stages[0] else ""
            self.bars.update(self.tasks[id(stage)][1], completed=stage.done, left=left)
        if not stages and self.bars.live.is_started:
            self.bars.stop()
            for task in list(self.bars.task_ids):
                self.bars.remove_task(task)
