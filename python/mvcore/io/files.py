"""Files that appear whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
try:
    import msvcrt
except ImportError:  # POSIX
    msvcrt = None  # type: ignore[assignment]

PART = ".mvcore-part"
"""In the names of folders of files that are being written."""


def try_lock(handle: int) -> bool | None:
    """Lock an open file for as long as it stays open: False where somebody else has it locked, None where files cannot be locked."""
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif msvcrt is not None:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            return None
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None  # the file system has no locks
    return True


@contextmanager
def staged(path: Path) -> Iterator[Path]:
    """An empty folder beside ``path`` for what is to be moved there; it is gone afterwards.

    A process that is killed leaves its folder behind: the next one that writes the same path takes it over. A lock tells a killed
    writer from a busy one; beside a busy one, and where folders cannot be locked, the folder has a name of its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = path.parent / f".{path.name}{PART}"
    lock = _lock(folder)
    if lock is None:
        folder = Path(tempfile.mkdtemp(prefix=f"{folder.name}-", dir=path.parent))
        lock = _lock(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _lock(folder: Path) -> int | None:
    """Make a folder, or take over and empty one that nobody holds: its locked descriptor; None where that cannot be."""
    if fcntl is None:
        return None
    handle = None
    try:
        folder.mkdir(exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not os.path.samestat(os.fstat(handle), os.stat(folder)):
            raise FileNotFoundError  # its last writer removed it between the two
        if not os.access(folder, os.W_OK):
            raise PermissionError  # somebody else's
        for left in folder.iterdir():
            shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()
    except OSError:
        if handle is not None:
            os.close(handle)
        return None
    return handle


def remove_abandoned(parent: Path, age: float) -> int:
    """Remove what killed writers left in a folder, of more than ``age`` seconds ago; how many there were."""
    count = 0
    for folder in parent.glob(f".*{PART}*"):
        with suppress(OSError):  # its writer has just removed it
            if not folder.is_dir() or time.time() - folder.stat().st_mtime < age:
                continue
            lock = _lock(folder)
            if lock is not None or fcntl is None:
                shutil.rmtree(folder)
                count += 1
            if lock is not None:
                os.close(lock)
    return count


def atomically(path: Path, write: Callable[[Path], None], durable: bool = True) -> None:
    """Have ``write`` make a file of the same name in a temporary folder, then move it into place.

    ``durable`` waits until the disk has the file before it takes the old one's place, so that a power failure leaves one or the other;
    results that are checked when they are read do without.
    """
    with staged(path) as folder:
        write(folder / path.name)
        if durable:
            _flush(folder / path.name)
        os.replace(folder / path.name, path)
        if durable and fcntl is not None:
            _flush(path.parent)


def _flush(path: Path) -> None:
    with suppress(PermissionError):  # of a folder that may be searched but not read
        handle = os.open(path, os.O_RDONLY if fcntl is not None else os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
