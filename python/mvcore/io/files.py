"""Files that appear whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextmanager
def staged(path: Path) -> Iterator[Path]:
    """An empty folder beside ``path`` for what is to be moved there; it is gone afterwards.

    A process that is killed leaves its folder behind: the next one that writes the same path takes it over. A lock tells a killed
    writer from a busy one; beside a busy one, and where folders cannot be locked, the folder has a name of its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = path.parent / f".{path.name}.mvcore-part"
    lock = _lock(folder)
    if lock is None:
        folder = Path(tempfile.mkdtemp(prefix=f"{folder.name}-", dir=path.parent))
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


def atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Have ``write`` make a file of the same name in a temporary folder, then move it into place."""
    with staged(path) as folder:
        write(folder / path.name)
        os.replace(folder / path.name, path)
