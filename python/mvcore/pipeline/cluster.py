"""A dask.distributed cluster as a pool: lost workers' work is done again, a lost scheduler is an error and no endless wait."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import Interrupted, InvalidInputError, ReconstructionError, require

CONNECT = 20.0
"""Seconds within which a scheduler must be reached."""
PING = 3.0
"""Seconds between two questions to the scheduler."""
SILENCE = 20.0
"""Seconds without an answer after which it counts as lost."""
LOOK = 0.5
"""Seconds between two looks whether it is lost while a result is waited for."""


def name_of(function: Callable[..., Any], arguments: tuple[Any, ...]) -> str:
    """What a piece of work is called in messages: the function that it hands on to, where it does."""
    handed = [a.__name__ for a in arguments if callable(a) and hasattr(a, "__name__")]
    return handed[0] if handed else function.__name__


@dataclass(frozen=True)
class Cluster:
    """A scheduler and, for TLS, the files of its certificate authority and of this client's certificate and key (PEM).

    Without files, ``tls://`` takes dask's own configuration (``distributed.comm.tls`` in its YAML files or in the environment).

    Examples
    --------
    >>> Cluster("tls://10.0.0.5:8786", tls_ca="ca.pem", tls_cert="client.pem", tls_key="client.key").address
    'tls://10.0.0.5:8786'
    """

    address: str
    tls_ca: str | Path | None = None
    tls_cert: str | Path | None = None
    tls_key: str | Path | None = None

    def __post_init__(self) -> None:
        require(
            re.fullmatch(r"(tcp|tls|ucx|inproc)://\S+", self.address),
            "scheduler",
            "an address such as tcp://host:8786 or tls://host:8786",
            repr(self.address),
        )
        files = {"tls_ca": self.tls_ca, "tls_cert": self.tls_cert, "tls_key": self.tls_key}
        missing = [name for name, path in files.items() if path is None]
        require(len(missing) in (0, 3), "tls_ca, tls_cert, tls_key", "all three or none", f"none for {', '.join(missing)}")
        require(missing or self.address.startswith("tls://"), "scheduler", "tls://host:port, as there are files for TLS", self.address)

    def check_files(self) -> None:
        """Raises FileNotFoundError where one of the files is missing."""
        for path in (self.tls_ca, self.tls_cert, self.tls_key):
            if path is not None and not Path(path).is_file():
                raise FileNotFoundError(f"{path}: this file for TLS does not exist")

    def security(self) -> Any:
        """For distributed.Client; None without TLS."""
        from distributed.security import Security

        if not self.address.startswith("tls://"):
            return None
        if self.tls_ca is None:
            return Security(require_encryption=True)
        files = {"tls_ca_file": self.tls_ca, "tls_client_cert": self.tls_cert, "tls_client_key": self.tls_key}
        return Security(require_encryption=True, **{name: str(path) for name, path in files.items()})


@contextmanager
def open_cluster(scheduler: str | Cluster, attempts: int) -> Iterator[ClusterPool]:
    """A pool on a cluster; the connection is closed with the block, and what still waits there is cancelled.

    Raises
    ------
    InvalidInputError
        The address is none, or dask.distributed is not installed.
    ReconstructionError
        The scheduler cannot be reached.
    """
    cluster = Cluster(scheduler) if isinstance(scheduler, str) else scheduler
    cluster.check_files()
    try:
        from distributed import Client
    except ImportError:
        raise InvalidInputError(
            "scheduler: expected dask.distributed to be installed (pip install 'mvcore[cluster]'), got no such package"
        ) from None
    try:
        client = Client(cluster.address, timeout=CONNECT, security=cluster.security(), set_as_default=False)
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ReconstructionError(f"scheduler: {cluster.address} cannot be reached: {reason}") from error
    pool = ClusterPool(client, cluster.address, attempts)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.close()


class ClusterPool:
    """Sends pure functions to the workers of a cluster."""

    def __init__(self, client: Any, address: str, attempts: int) -> None:
        self.client = client
        self.address = address
        self.attempts = attempts
        self._answered = time.monotonic()
        self._closed = threading.Event()
        self._stopped = threading.Event()
        threading.Thread(target=self._ping, name="mvcore-ping", daemon=True).start()

    def start(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """Sends out ``function(*arguments)``; calling what comes back waits for the result.

        Raises
        ------
        ReconstructionError
            From what comes back: the scheduler is lost, or the workers that did it were lost again and again.
        Interrupted
            From what comes back: the work was given up.
        """
        first = self._send(function, arguments)

        def result() -> Any:
            future = first
            for _ in range(self.attempts):
                self._wait(future)
                if future.status == "finished":
                    done, value = self._fetch(future)
                    if done:
                        return value
                elif future.status == "error":
                    raise self._error(name_of(function, arguments), future.exception(timeout=SILENCE))
                # Cancelled or lost: the scheduler was started anew, or forgot it.
                future = self._send(function, arguments)
            raise ReconstructionError(f"scheduler: {self.address} lost {name_of(function, arguments)} {self.attempts} times")

        return result

    def stop(self) -> None:
        """Gives the work up: waits end, and what has not begun is cancelled when the connection closes."""
        self._stopped.set()

    def close(self) -> None:
        """Ends the connection; a scheduler that is gone does not hold it up."""
        self._closed.set()
        with suppress(Exception):  # whatever hinders the farewell, the work is done or has failed
            self.client.close(timeout=1.0 if self._lost() else 10.0)

    def _send(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        self._check()
        return self.client.submit(function, *arguments, pure=False)

    def _wait(self, future: Any) -> None:
        """Until it is done. dask itself sends the work of a lost worker to another."""
        settled = threading.Event()
        future.add_done_callback(lambda _: settled.set())
        while not settled.wait(LOOK) and not future.done():
            self._check()

    def _fetch(self, future: Any) -> tuple[bool, Any]:
        """The result from the worker that holds it; not done where that worker is lost just then."""
        until = time.monotonic() + SILENCE
        while time.monotonic() < until:
            try:
                return True, future.result(timeout=LOOK)
            except Exception as error:
                if future.status != "finished" or type(error).__name__ not in ("TimeoutError", "CommClosedError"):
                    break
            self._check()
        return False, None

    @staticmethod
    def _error(name: str, error: BaseException) -> BaseException:
        if type(error).__name__ == "KilledWorker":
            return ReconstructionError(f"scheduler: workers were lost again and again while they did {name} (out of memory?)")
        return error

    def _ping(self) -> None:
        while not self._closed.wait(PING):
            asked = time.monotonic()
            try:
                self.client.sync(self.client.scheduler.identity, callback_timeout=SILENCE)
            except Exception:  # whatever it is, it is no answer
                continue
            self._answered = asked

    def _lost(self) -> bool:
        return self.client.status == "closed" or time.monotonic() - self._answered > SILENCE + PING

    def _check(self) -> None:
        if self._stopped.is_set():
            raise Interrupted("the work was given up")
        if not self._closed.is_set() and self._lost():
            raise ReconstructionError(f"scheduler: {self.address} is lost: no answer for {SILENCE:.0f} s")
