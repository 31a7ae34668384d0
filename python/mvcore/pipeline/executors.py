"""Where work runs: a local pool, any `concurrent.futures` executor, or a dask.distributed cluster; lost work is done again."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import contextmanager
from threading import Event, Lock, get_ident
from typing import Any, Protocol

from .. import _core
from ..errors import Interrupted, InvalidInputError, ReconstructionError
from ..types import LOGGER
from .cluster import LOOK, Cluster, name_of, open_cluster

ATTEMPTS = 4
"""Times that a piece of work is sent out before its loss is an error."""


class Pool(Protocol):
    """Sends out pure functions, and again where a worker was lost."""

    def start(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """Sends out ``function(*arguments)``; calling what comes back waits for the result."""

    def stop(self) -> None:
        """Gives the work up: what has not begun is cancelled, and all that waits for results ends with `Interrupted`."""


def local_workers() -> int:
    """Threads of the local pool: kernels use all cores themselves, a second thread fills the gaps between them."""
    return max(2, min(4, (os.cpu_count() or 1) // 4))


class Interruption:
    """Ends what threads of this process do: kernels by their flag, the Python code between them by an exception."""

    def __init__(self) -> None:
        self._flag, self._set = _core.Interrupt(), False
        self._inside: set[int] = set()
        self._lock = Lock()

    def run(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Does work in the calling thread.

        Raises
        ------
        Interrupted
            `set` was called before or meanwhile.
        """
        me = get_ident()
        try:
            with self._lock:
                if self._set:
                    raise Interrupted("the work was given up")
                self._inside.add(me)
            self._flag.enter()
            return function(*arguments)
        finally:
            with self._lock:
                self._inside.discard(me)
                _raise_in(me, None)  # what has not arrived yet must not do so elsewhere
            _core.Interrupt().enter()  # other users' work in this thread does not end

    def set(self) -> None:
        """Ends the work, now and later."""
        with self._lock:
            threads = [] if self._set else list(self._inside)
            self._set = True
            self._flag.set()
            for thread in threads:
                _raise_in(thread, Interrupted)


def _raise_in(thread: int, error: type[Exception] | None) -> None:
    """Has a thread raise an error as soon as it is in Python code; None takes it back."""
    argument = None if error is None else ctypes.py_object(error)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), argument)


class ExecutorPool:
    """On an executor. One of processes that breaks, as a worker died, is replaced by another like it."""

    def __init__(self, executor: Executor) -> None:
        self.executor = executor
        self._interruption = Interruption() if isinstance(executor, ThreadPoolExecutor) else None
        self._lock = Lock()
        self._stopped = Event()
        self._replaced = False

    def start(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """Sends out ``function(*arguments)``; calling what comes back waits for the result.

        Raises
        ------
        ReconstructionError
            From what comes back: the workers that did it were lost again and again, or the executor is of no more use.
        Interrupted
            From what comes back: the work was given up.
        """
        first = self._send(function, arguments)

        def result() -> Any:
            future, executor = first
            for _ in range(ATTEMPTS):
                try:
                    return self._result(future)
                except Exception as error:
                    if not _lost(error):
                        raise
                    future, executor = self._send_again(function, arguments, executor, error)
            name = name_of(function, arguments)
            raise ReconstructionError(f"executor: workers were lost {ATTEMPTS} times while they did {name} (out of memory?)")

        return result

    def stop(self) -> None:
        """Gives the work up: waits end, and what runs in threads of this pool does."""
        self._stopped.set()
        if self._interruption is not None:
            self._interruption.set()

    def close(self) -> None:
        """Shuts down what took the place of a broken executor."""
        if self._replaced:
            self.executor.shutdown(cancel_futures=True)

    def _result(self, future: Future[Any]) -> Any:
        while not wait([future], timeout=LOOK).done:
            if self._stopped.is_set():
                future.cancel()
                raise Interrupted("the work was given up")
        return future.result()

    def _send(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Future[Any], Executor]:
        executor = self.executor
        try:
            return executor.submit(*self._call(function, arguments)), executor
        except BrokenExecutor as error:
            return self._send_again(function, arguments, executor, error)

    def _send_again(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], broken: Executor, error: Exception
    ) -> tuple[Future[Any], Executor]:
        with self._lock:
            if isinstance(error, BrokenExecutor) and self.executor is broken:
                self.executor = _like(broken, error)
                LOGGER.warning("a worker process died; what it did is done again")
                if self._replaced:
                    broken.shutdown(wait=False)
                self._replaced = True
            return self.executor.submit(*self._call(function, arguments)), self.executor

    def _call(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, ...]:
        return (function, *arguments) if self._interruption is None else (self._interruption.run, function, *arguments)


def _lost(error: Exception) -> bool:
    """Whether an error says that the worker is gone, not that the work is wrong."""
    return isinstance(error, BrokenExecutor | CancelledError | ConnectionError) or type(error).__name__ == "CommClosedError"


def _like(broken: Executor, error: Exception) -> Executor:
    """A new pool of processes with the settings of a broken one."""
    if type(broken) is not ProcessPoolExecutor:
        raise ReconstructionError(f"executor: its workers are gone ({error})") from error
    names = ("max_workers", "mp_context", "initializer", "initargs", "max_tasks_per_child")
    settings = {name: getattr(broken, f"_{name}", None) for name in names}
    return ProcessPoolExecutor(**{name: value for name, value in settings.items() if value is not None})


@contextmanager
def open_pool(executor: Executor | None = None, scheduler: str | Cluster | None = None) -> Iterator[Pool]:
    """A pool on the caller's executor, on the cluster of a scheduler, or of local threads.

    When the block ends by an exception, local kernels that still run end within a fraction of a second.

    Parameters
    ----------
    executor : any `concurrent.futures.Executor`; it is left open.
    scheduler : address of a dask.distributed scheduler (``tcp://host:port`` or ``tls://host:port``), or a `Cluster` with the files for TLS.

    Raises
    ------
    InvalidInputError
        Both are given, the address is none, or dask.distributed is not installed.
    ReconstructionError
        The scheduler does not answer.
    """
    if executor is not None and scheduler is not None:
        raise InvalidInputError("executor, scheduler: expected one of them, got both")
    if executor is not None:
        pool = ExecutorPool(executor)
        try:
            yield pool
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.close()
    elif scheduler is not None:
        with open_cluster(scheduler, ATTEMPTS) as cluster:
            yield cluster
    else:
        with _threads() as pool:
            yield pool


@contextmanager
def _threads() -> Iterator[ExecutorPool]:
    threads = ThreadPoolExecutor(local_workers(), thread_name_prefix="mvcore")
    pool = ExecutorPool(threads)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    finally:
        threads.shutdown(cancel_futures=True)
