"""Silhouettes that an occluder cuts, repaired from the depth of the other views."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.cameras import Camera
from ..types import DepthMap

POINT_STEP = 2
"""Pixels between the points that `repaired_masks` projects."""


REACH = 9
"""Pixels over which their density is measured, and gaps between them closed."""


def repaired_masks(depths: Sequence[DepthMap], cameras: Sequence[Camera], masks: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
    """Masks with what other views' depth contradicts filled in: an occluder cuts a silhouette without cutting the target.

    Surface points that the other views agree on and that fall densely outside a mask mean that something stands before them there.
    Stray points along a silhouette are too thin to count; so is everything where no depth is known.

    Parameters
    ----------
    depths : filtered depth maps of the target, one a camera. masks : (h, w) uint8, non-zero on the target.
    """
    points = []
    for view, camera in zip(depths, cameras, strict=True):
        y, x = np.nonzero(view.depth[::POINT_STEP, ::POINT_STEP])
        pixels = np.column_stack([x, y]) * POINT_STEP
        points.append(camera.unproject(pixels, view.depth[pixels[:, 1], pixels[:, 0]]))
    return [_repaired(m, c, [p for k, p in enumerate(points) if k != n]) for n, (m, c) in enumerate(zip(masks, cameras, strict=True))]


def _pixels(camera: Camera, points: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Which points (N, 3) fall into the image, (N,) bool, and the columns and rows of their pixels, one an image point."""
    nearest = np.rint(camera.project(points))
    seen = ((nearest >= 0) & (nearest < (camera.width, camera.height))).all(1)
    x, y = nearest[seen].astype(np.int64).T
    return seen, x, y


def _repaired(mask: NDArray[np.uint8], camera: Camera, points: list[NDArray[np.float64]]) -> NDArray[np.uint8]:
    inside = (mask > 0).astype(np.uint8)
    hits = np.zeros(mask.shape, np.float32)
    for cloud in points:
        _, x, y = _pixels(camera, cloud)
        # Each view counts once at a pixel.
        seen = np.zeros(mask.shape, np.float32)
        seen[y, x] = 1
        hits += seen
    # A surface that one view sees squarely has one point a step squared; more than one view must have seen it.
    density = cv2.boxFilter(np.where(inside > 0, 0, hits).astype(np.float32), -1, (REACH, REACH)) * POINT_STEP**2
    share = cv2.boxFilter(1.0 - inside.astype(np.float32), -1, (REACH, REACH))
    doubted = ((density > 1.2 * share) & (inside == 0)).astype(np.uint8)
    small, large = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (n, n)) for n in (REACH, 2 * REACH + 1))
    solid = cv2.morphologyEx(cv2.morphologyEx(doubted, cv2.MORPH_CLOSE, small), cv2.MORPH_OPEN, large)
    if not solid.any():
        return inside
    # What hangs on it in slits of the mask, with some of it on both sides, a post say; and the rim between it and the mask.
    across = np.eye(2 * REACH + 1, dtype=np.uint8)
    lines = (across, across[::-1].copy(), np.ones((1, len(across)), np.uint8), np.ones((len(across), 1), np.uint8))
    slits = np.bitwise_or.reduce([cv2.morphologyEx(inside, cv2.MORPH_CLOSE, line) for line in lines]) & doubted
    _, part = cv2.connectedComponents(solid | slits)
    filled = inside | solid | (np.isin(part, np.unique(part[solid > 0])) & (slits > 0)).astype(np.uint8)
    around = cv2.dilate(solid, small, iterations=2)
    return filled | (cv2.morphologyEx(filled, cv2.MORPH_CLOSE, small) & around)
