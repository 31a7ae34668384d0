"""Nouns that the stages hand on."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

LOGGER = logging.getLogger("mvcore")
"""Warnings go here as soon as they are known; whoever uses the library decides where they show."""
LOGGER.addHandler(logging.NullHandler())

T = TypeVar("T")

Image = NDArray[np.uint8]
"""(h, w, 3) uint8 RGB."""
Frame = NDArray[np.uint8] | str | Path
"""An image, or the path of one."""
Bounds = NDArray[np.float64]
"""(2, 3) float64: least and greatest corner in the world."""


class Track(Protocol):
    """Wraps an iterable to show progress: ``track(items, "depth maps", total)``; the library itself never prints."""

    def __call__(self, items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
        """The items again, one by one."""


def no_track(items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
    """The silent default."""
    return items


@dataclass(frozen=True)
class SparsePoints:
    """Triangulated features.

    positions : (N, 3) float64, world. visible : (V, N) bool, which view the point was found in. errors : (N,) float32, mean
    reprojection error in pixels.
    """

    positions: NDArray[np.float64]
    visible: NDArray[np.bool_]
    errors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class DepthMap:
    """depth : (h, w) float32, z along the optical axis, 0 = none. confidence : (h, w) float32, 0 .. 1."""

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]


@dataclass
class Report:
    """Figures of a run: nested plain values that JSON can hold, and the warnings.

    quiet : warnings are kept and not logged, where whoever has the report does that.
    """

    values: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    quiet: bool = False

    def warn(self, message: str) -> None:
        """Keep a warning for the user, and log it at once."""
        self.warnings.append(message)
        if not self.quiet:
            LOGGER.warning(message)
