"""Which runs use a workdir now: each holds a locked file there, and a lock ends with its process, however that ends."""

from __future__ import annotations

import os
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..io.files import try_lock

SUFFIX = ".run"
UNKNOWN = 24 * 3600.0
"""Seconds for which a run counts as alive where files cannot be locked."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Says that a run uses the workdir whose leases lie in ``folder``, from now to the end of the block."""
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    hidden, path = folder / f".{name}", folder / f"{name}{SUFFIX}"
    handle = os.open(hidden, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
    try:
        try_lock(handle)
        os.rename(hidden, path)  # it is locked when others first see it
        yield
    finally:
        os.close(handle)
        for left in (hidden, path):
            left.unlink(missing_ok=True)


def live(folder: Path) -> list[float]:
    """When the runs that still go on began (seconds since the epoch); the leases of ended ones are removed."""
    starts = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        with suppress(OSError):  # it has just ended
            handle = os.open(path, os.O_RDWR)
            try:
                start, locked = os.fstat(handle).st_mtime, try_lock(handle)
            finally:
                os.close(handle)
            if locked is False or (locked is None and time.time() - start < UNKNOWN):
                starts.append(start)
            else:
                path.unlink()
    return starts
