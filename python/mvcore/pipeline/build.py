"""Which build of the package computes: results of another one are not taken for this one's."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from .. import _core
from .store import digest, file_digest

ABOVE = ("cli/", "evaluation/", "nurbs/", "viewer/", "network/training/", "network/procedural/")
"""Folders of the package on which no result of a stage depends."""
KINDS = (".py", ".csv", ".safetensors")
"""Suffixes of the files on which results depend: sources and weights."""


@lru_cache(maxsize=1)
def build() -> str:
    """Digest of the package's sources, weights and kernels, and of the versions of NumPy and OpenCV."""
    return digest(
        version("mvcore"), np.__version__, cv2.__version__, contents(Path(__file__).parents[1]), file_digest(Path(_core.__file__))
    )


def contents(package: Path) -> dict[str, str]:
    """Digests of the files of a package on which results depend, by their places in it."""
    found = {p.relative_to(package).as_posix(): p for p in package.rglob("*") if p.suffix in KINDS}
    return {name: file_digest(path) for name, path in sorted(found.items()) if not name.startswith(ABOVE)}
