"""What one image of a rectified pair shows alone lies behind: the surface beside it goes on there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from .views import Map

REACH = 10
"""Pixels to either side between which a slope is taken."""
BEND = 0.5
"""Disparity by which the middle may lie off the line through both sides."""
BLOCK = 4
"""Slopes are smoothed at a fourth of the size: they change slowly."""
RADIUS, COLOUR = 12, 20.0
"""Of the weighted median that smooths them: blocks, grey levels."""


def continued(d: Map, seen: NDArray[np.bool_], guide: NDArray[np.uint8], low: float, high: float) -> Map:
    """Disparities with those that are not seen replaced: of the nearest seen surfaces left and right the one behind goes on.

    d : (h, w) float32; seen : (h, w), what both images show; guide : (h, w, 3) uint8, the left image; low, high : the range searched.
    Returns (h, w) float32, pixels. A whole row that is not seen keeps what it has.

    Beyond the right image's border one side alone is seen: a slanted surface that stayed at its last disparity would be off by more the
    farther it goes.
    """
    h, w = d.shape
    columns = np.broadcast_to(np.arange(w), (h, w))
    left = np.maximum.accumulate(np.where(seen, columns, -1), 1)
    right = np.minimum.accumulate(np.where(seen, columns, w)[:, ::-1], 1)[:, ::-1]
    at_left = np.where(left >= 0, np.take_along_axis(d, left.clip(0), 1), np.inf)
    at_right = np.where(right < w, np.take_along_axis(d, right.clip(None, w - 1), 1), np.inf)
    behind = np.where(at_left <= at_right, left, right).clip(0, w - 1)
    slope = np.take_along_axis(_slopes_across(d, seen, guide), behind, 1)
    there = np.minimum(at_left, at_right) + slope * (columns - behind)
    values = np.where(seen | ~np.isfinite(there), d, np.clip(there, low, high)).astype(np.float32)
    return np.where(seen, values, cv2.medianBlur(values, 5)).astype(np.float32)


def _slopes_across(d: Map, seen: NDArray[np.bool_], guide: NDArray[np.uint8]) -> Map:
    """Slopes along x, (h, w): the weighted median of those around, each between seen pixels in line; 0 where there are none."""
    h, w = d.shape
    slope = np.full((h, w), np.nan, np.float32)
    if w > 2 * REACH:
        behind, middle, ahead = (np.s_[:, k : w - 2 * REACH + k] for k in (0, REACH, 2 * REACH))
        straight = np.abs(d[ahead] + d[behind] - 2 * d[middle]) < BEND
        good = seen[behind] & seen[middle] & seen[ahead] & straight
        slope[middle] = np.where(good, (d[ahead] - d[behind]) / (2 * REACH), np.nan)
    rows, columns = (np.minimum(np.arange(-(-n // BLOCK)) * BLOCK + BLOCK // 2, n - 1) for n in (h, w))
    few = np.ascontiguousarray(slope[np.ix_(rows, columns)])
    small = cv2.resize(guide, few.shape[::-1], interpolation=cv2.INTER_AREA)
    asked = np.ones(few.shape, np.uint8)
    smooth = _core.weighted_median(few, small, asked, radius=RADIUS, step=1, colour=COLOUR, distance=0.6 * RADIUS, slack=0.0)
    return np.nan_to_num(smooth)[np.ix_(np.arange(h) // BLOCK, np.arange(w) // BLOCK)]
