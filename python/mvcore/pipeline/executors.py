"""Where work runs: a local pool, any `concurrent.futures` executor, or a dask.distributed cluster; lost work is done again."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from ..errors import InvalidInputError, MvcoreError

ATTEMPTS = 4
"""Times that a piece of work is sent out before its loss is an error."""


def local_workers() -> int:
    """Threads of the local pool: kernels use all cores themselves, a second thread fills the gaps between them."""
    return max(2, min(4, (os.cpu_count() or 1) // 4))


class Pool:
    """Sends pure functions to an executor, and again where a worker was lost."""

    def __init__(self, executor: Executor) -> None:
        self.executor = executor

    def start(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """Sends out ``function(*arguments)``; calling what comes back waits for the result."""
        future = self.executor.submit(function, *arguments)

        def result() -> Any:
            pending: Future[Any] = future
            for attempt in range(ATTEMPTS):
                try:
                    return pending.result()
                except MvcoreError:
                    raise
                except Exception as error:
                    if attempt + 1 == ATTEMPTS or not _lost(error):
                        raise
                    pending = self.executor.submit(function, *arguments)
            raise AssertionError("unreachable")

        return result


def _lost(error: Exception) -> bool:
    """Whether an error says that the worker is gone, not that the work is wrong."""
    return isinstance(error, CancelledError | ConnectionError | BrokenExecutor) or type(error).__name__ in (
        "KilledWorker",
        "CommClosedError",
    )


@contextmanager
def open_pool(executor: Executor | None = None, scheduler: str | None = None) -> Iterator[Pool]:
    """A pool on the caller's executor, on the cluster at ``scheduler`` (``tcp://host:port``), or of local threads.

    Raises
    ------
    InvalidInputError
        Both are given, or dask.distributed is not installed.
    """
    if executor is not None and scheduler is not None:
        raise InvalidInputError("executor, scheduler: expected one of them, got both")
    if executor is not None:
        yield Pool(executor)
    elif scheduler is not None:
        with _cluster(scheduler) as pool:
            yield pool
    else:
        own = ThreadPoolExecutor(local_workers(), thread_name_prefix="mvcore")
        try:
            yield Pool(own)
        finally:
            own.shutdown(cancel_futures=True)


@contextmanager
def _cluster(address: str) -> Iterator[Pool]:
    try:
        from distributed import Client
    except ImportError:
        raise InvalidInputError(
            "scheduler: expected dask.distributed to be installed (pip install 'mvcore[cluster]'), got no such package"
        ) from None
    with Client(address, timeout="30s") as client:
        # The scheduler sends work of a lost worker to another by itself.
        yield Pool(client.get_executor(retries=ATTEMPTS, pure=False))
