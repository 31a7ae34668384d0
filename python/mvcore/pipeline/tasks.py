"""Tasks: pure functions of other tasks' results, named by the content of all that they depend on, run once, anywhere."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..errors import ReconstructionError
from ..types import LOGGER, Track
from .build import build
from .cache import Cache, Missing, cache_of, forget, warnings_of
from .executors import Interruption, Pool
from .store import digest

T = TypeVar("T")

ATTEMPTS = 8
"""Times that inputs of a task that vanish are made again before it is an error."""


@dataclass(frozen=True, eq=False)
class Task(Generic[T]):
    """A call of a stage: ``function(*arguments)``, where arguments may be tasks, alone or in lists.

    An argument that is a task arrives as its result; a list with tasks as a sequence that loads an element when it is indexed.
    """

    function: Callable[..., T]
    arguments: tuple[Any, ...]
    key: str

    @property
    def stage(self) -> str:
        """The name of the stage."""
        return self.function.__name__

    def inputs(self) -> Iterator[Task[Any]]:
        """The tasks that this one needs."""
        for argument in self.arguments:
            for part in argument if isinstance(argument, list) else [argument]:
                if isinstance(part, Task):
                    yield part


def task(function: Callable[..., T], *arguments: Any) -> Task[T]:
    """A task, named by its function, the content of its arguments and the build of the package."""
    named = [_content(a) for a in arguments]
    return Task(function, arguments, digest("mvcore", build(), function.__module__, function.__qualname__, named))


def _content(argument: Any) -> Any:
    if isinstance(argument, Task):
        return {"task": argument.key}
    if isinstance(argument, list):
        return [_content(a) for a in argument]
    content = getattr(argument, "content", None)
    return argument if content is None else content()


@dataclass(frozen=True)
class _Key:
    """Stands for a task's result where the task runs."""

    key: str


class Loaded(Sequence[Any]):
    """Results of tasks (and plain values between them); each is loaded when it is indexed and not held."""

    def __init__(self, cache: Cache, parts: Sequence[Any]) -> None:
        self._cache, self._parts = cache, parts

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, n: Any) -> Any:
        if isinstance(n, slice):
            return Loaded(self._cache, self._parts[n])
        part = self._parts[n]
        return self._cache.get(part.key) if isinstance(part, _Key) else part


def _frozen(argument: Any) -> Any:
    if isinstance(argument, Task):
        return _Key(argument.key)
    if isinstance(argument, list):
        return [_frozen(a) for a in argument]
    return argument


def _thawed(cache: Cache, argument: Any) -> Any:
    if isinstance(argument, _Key):
        return cache.get(argument.key)
    if isinstance(argument, list) and any(isinstance(a, _Key) for a in argument):
        return Loaded(cache, argument)
    return argument


class _Meter:
    """CPU seconds of tasks that run side by side in one process: what is spent between two events is shared among those running."""

    def __init__(self) -> None:
        self._lock, self._running, self._at = threading.Lock(), {}, 0.0  # type: ignore[var-annotated]

    def _event(self) -> None:
        now = time.process_time()
        for key in self._running:
            self._running[key] += (now - self._at) / len(self._running)
        self._at = now

    def start(self, key: object) -> None:
        with self._lock:
            self._event()
            self._running[key] = 0.0

    def stop(self, key: object) -> float:
        with self._lock:
            self._event()
            return float(self._running.pop(key))


_METER = _Meter()


@dataclass(frozen=True)
class Place:
    """Where results lie, as every worker sees it, and the build of the package that they are of."""

    folder: Path
    budget: int
    through: bool
    build: str = field(default_factory=build)

    def cache(self) -> Cache:
        """This process's cache there."""
        return cache_of(self.folder, self.budget, self.through)


def _work(place: Place, key: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[float, float, Missing | None]:
    """Runs a task where its worker is; wall and CPU seconds, and an input that has vanished."""
    if place.build != build():
        raise ReconstructionError(f"worker {socket.gethostname()}: expected the same mvcore, NumPy and OpenCV as the caller's, got others")
    cache, wall, me = place.cache(), time.perf_counter(), object()
    _METER.start(me)
    missing = None
    try:
        if key not in cache:
            cache.put(key, function(*(_thawed(cache, a) for a in arguments)))
    except Missing as error:
        missing = error.with_traceback(None)  # which would keep the inputs
    finally:
        cpu = _METER.stop(me)
    return time.perf_counter() - wall, cpu, missing


@dataclass
class Ledger:
    """What a run did: tasks run and results reused, wall and CPU seconds a stage."""

    run: int = 0
    reused: int = 0
    seconds: dict[str, dict[str, float]] = field(default_factory=dict)

    def add(self, stage: str, wall: float, cpu: float) -> None:
        """Count a task that ran."""
        self.run += 1
        spent = self.seconds.setdefault(stage, {"wall": 0.0, "cpu": 0.0})
        spent["wall"] += wall
        spent["cpu"] += cpu


class Runner:
    """Runs tasks and what they need, each once, as soon as its inputs are there.

    A result that vanishes or is damaged is made again from what it was made of. What results warn of is
    logged when they are there, each warning once a run. Use as a context manager.

    Parameters
    ----------
    place : where results lie.
    pool : runs the work; with None threads of this process do.
    threads : tasks at a time.
    """

    def __init__(self, place: Place, pool: Pool | None, threads: int) -> None:
        self.place, self.cache, self.pool = place, place.cache(), pool
        self._interruption = Interruption()
        self._dispatch = ThreadPoolExecutor(threads, thread_name_prefix="mvcore-task")
        self._futures: dict[str, Future[None]] = {}
        self._known: dict[str, tuple[Task[Any], Ledger]] = {}
        self._lock = threading.RLock()
        self._again_locks: dict[str, threading.Lock] = {}
        self._said: set[str] = set()
        self._stopped = False

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None:
            self.stop()
        self._stopped = True
        self._dispatch.shutdown(cancel_futures=True)
        forget(self.place.folder)

    def stop(self) -> None:
        """Give the run up: tasks of this process end within a fraction of a second, and nothing else begins."""
        self._stopped = True
        self._interruption.set()
        if self.pool is not None:
            self.pool.stop()

    def start(self, wanted: Task[Any], ledger: Ledger) -> Future[None]:
        """See to it that a task's result is there; the future is done once it is. The ledger counts what it takes."""
        with self._lock:
            if wanted.key in self._futures:
                return self._futures[wanted.key]
            future: Future[None] = Future()
            self._futures[wanted.key] = future
            self._known[wanted.key] = wanted, ledger
            if wanted.key in self.cache and (warnings := self.cache.warnings(wanted.key)) is not None:
                self._say(warnings)
                ledger.reused += 1
                future.set_result(None)
                return future
        inputs = list({t.key: t for t in wanted.inputs()}.values())
        self._after([self.start(t, ledger) for t in inputs], future, lambda: self._submit(wanted, future))
        return future

    def _after(self, waiting: list[Future[None]], future: Future[None], then: Callable[[], None]) -> None:
        left, lock = len(waiting) + 1, threading.Lock()

        def one(finished: Future[None] | None) -> None:
            nonlocal left
            with lock:
                left -= 1
                last = left == 0
            if finished is not None and finished.exception() is not None and not future.done():
                future.set_exception(finished.exception())
            elif last and not future.done():
                then()

        for w in waiting:
            w.add_done_callback(one)
        one(None)

    def _submit(self, wanted: Task[Any], future: Future[None]) -> None:
        try:
            self._dispatch.submit(self._attempt, wanted, future)
        except RuntimeError as error:  # the run was stopped
            future.set_exception(error)

    def _attempt(self, wanted: Task[Any], future: Future[None]) -> None:
        try:
            if self._stopped:
                raise ReconstructionError("the run was stopped")
            arguments = tuple(_frozen(a) for a in wanted.arguments)
            call = (self.place, wanted.key, wanted.function, arguments)
            for _ in range(ATTEMPTS):
                wall, cpu, missing = self._interruption.run(_work, *call) if self.pool is None else self.pool.start(_work, *call)()
                with self._lock:
                    self._known[wanted.key][1].add(wanted.stage, wall, cpu)
                if missing is None:
                    self._say(self.cache.warnings(wanted.key) or ())
                    future.set_result(None)
                    return
                if missing.damage and missing.process != os.getpid():
                    self._say([missing.damage])
                self._complete(wanted)
            raise ReconstructionError(f"{self.place.folder}: results vanish while they are needed")
        except BaseException as error:
            future.set_exception(error)

    def _complete(self, wanted: Task[Any]) -> None:
        """Makes those inputs of a task once more, in this thread, that have vanished or are damaged."""
        for one in {t.key: t for t in wanted.inputs()}.values():
            if not self.cache.intact(one.key):
                self._again(one, self._known[wanted.key][1])

    def _again(self, wanted: Task[Any], ledger: Ledger) -> None:
        """Makes a vanished result once more, in this thread; other threads that need it wait."""
        with self._lock:
            self._known.setdefault(wanted.key, (wanted, ledger))
            lock = self._again_locks.setdefault(wanted.key, threading.Lock())
        with lock:
            if wanted.key in self.cache:
                return
            self._complete(wanted)
            again: Future[None] = Future()
            self._attempt(wanted, again)
            again.result()

    def _say(self, warnings: Iterable[str]) -> None:
        """Logs what no task of this run has said before."""
        with self._lock:
            new = [w for w in dict.fromkeys(warnings) if w not in self._said]
            self._said.update(new)
        for message in new:
            LOGGER.warning("%s", message)

    def value(self, wanted: Task[T], ledger: Ledger) -> T:
        """A task's result."""
        self.start(wanted, ledger).result()
        return self.get(wanted)

    def get(self, wanted: Task[T]) -> T:
        """The result of a task that is done; made again where it has vanished since."""
        for _ in range(ATTEMPTS):
            try:
                value = self.cache.get(wanted.key)
            except Missing:
                self._again(wanted, Ledger())
            else:
                self._say(warnings_of(value))
                return value  # type: ignore[no-any-return]
        raise ReconstructionError(f"{self.place.folder}: results vanish while they are needed")

    def needed(self, wanted: Iterable[Task[Any]]) -> set[str]:
        """Keys of the tasks that must run for these results."""
        keys: set[str] = set()
        waiting = list(wanted)
        while waiting:
            one = waiting.pop()
            if one.key not in keys and one.key not in self.cache:
                keys.add(one.key)
                waiting += one.inputs()
        return keys

    def all(self, wanted: Iterable[Task[Any]], description: str, track: Track, ledger: Ledger) -> None:
        """Run tasks, shown as one line of progress."""
        futures = [self.start(t, ledger) for t in wanted]
        for done in track(as_completed(futures), description, len(futures)):
            done.result()

    def drop(self, tasks: Iterable[Task[Any]]) -> None:
        """Forget results that nobody needs any more; where somebody does they are made again."""
        for t in tasks:
            with self._lock:
                self._futures.pop(t.key, None)
            self.cache.drop(t.key)

    def forget_all_but(self, kept: set[str]) -> None:
        """Forget all results but these, at the end of a run in a temporary folder."""
        for key in self._known:
            if key not in kept:
                self.cache.drop(key)
