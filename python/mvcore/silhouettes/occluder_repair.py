"""Silhouettes that an occluder or a mistake cuts, repaired from what the other views measured."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..geometry.cameras import Camera
from ..types import DepthMap

CELL = 3.0
"""Voxels a side of the cells that votes are counted in: more than the noise of depth that views agree on."""
LEAST_SUPPORT = 2
"""Depth maps that must agree on a surface before it counts against a silhouette."""


def repaired_masks(
    depths: Sequence[DepthMap], cameras: Sequence[Camera], masks: Sequence[NDArray[np.uint8]], voxel: float
) -> list[NDArray[np.uint8]]:
    """Masks filled where measured surface contradicts them: what stands before a target cuts its silhouette, and so does a bad mask.

    The measured surface votes cell by cell. Depth maps that show it speak for it; silhouettes that see it outside, and depth maps that
    look through it, speak against it. Where more speak for it than against it, those silhouettes are wrong there. Depth that is wrong
    lies outside most silhouettes and is seen through.

    Parameters
    ----------
    depths : filtered depth maps of the target, one a camera. masks : (h, w) uint8, non-zero on the target. voxel : of the fusion, world
        units.

    Returns
    -------
    list
        (h, w) uint8 of 0 and 1, one a camera.
    """
    inside = [(m > 0).astype(np.uint8) for m in masks]
    cell = CELL * voxel
    points = _surface_cells(depths, cameras, cell)
    votes = np.zeros((2, len(points)), np.int32)
    outside = []
    for camera, view, mask in zip(cameras, depths, inside, strict=True):
        seen, x, y = pixels_of(camera, points)
        z = camera.to_camera(points[seen])[:, 2]
        beyond = view.depth[y, x] - z
        known = view.depth[y, x] > 0
        # A silhouette's border is as uncertain as measured points are.
        away = _core.distance_transform(mask)[0][y, x] * np.square(z / camera.K[0, 0])
        off = away > (0.5 * cell) ** 2
        votes[0, seen] += known & (np.abs(beyond) <= cell)
        votes[1, seen] += off | (known & (beyond > cell))
        outside.append(seen[off])
    wrong = (votes[0] >= LEAST_SUPPORT) & (votes[0] > votes[1])
    return [_filled(mask, camera, points[n[wrong[n]]], cell) for mask, camera, n in zip(inside, cameras, outside, strict=True)]


def pixels_of(camera: Camera, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of the points (N, 3) that fall into the image, and the columns and rows of their pixels."""
    nearest = np.rint(camera.project(points))
    with np.errstate(invalid="ignore"):
        seen = np.flatnonzero(((nearest >= 0) & (nearest < (camera.width, camera.height))).all(1))
    x, y = nearest[seen].astype(np.int64).T
    return seen, x, y


def _surface_cells(depths: Sequence[DepthMap], cameras: Sequence[Camera], cell: float) -> NDArray[np.float64]:
    """Mean of the measured points in each cell that has any, (N, 3): as many as the surface is large, for any number of views."""
    keys, sums = [np.zeros(0, np.int64)], [np.zeros((0, 4))]
    origin = np.mean([c.center for c in cameras], 0)
    for view, camera in zip(depths, cameras, strict=True):
        known = view.depth[view.depth > 0]
        # Two points along a cell's side.
        step = max(1, int(0.5 * cell * camera.K[0, 0] / float(np.median(known)))) if len(known) else 1
        y, x = np.nonzero(view.depth[::step, ::step])
        points = camera.unproject(step * np.column_stack([x, y]), view.depth[::step, ::step][y, x]) - origin
        key, total = _summed(_keys(points / cell), np.column_stack([points, np.ones(len(points))]))
        keys.append(key)
        sums.append(total)
    _, total = _summed(np.concatenate(keys), np.concatenate(sums))
    return np.asarray(origin + total[:, :3] / total[:, 3:])


def _summed(keys: NDArray[np.int64], rows: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Distinct keys, and the sum of the rows of each."""
    distinct, which = np.unique(keys, return_inverse=True)
    return distinct, np.column_stack([np.bincount(which, r, len(distinct)) for r in rows.T])


def _keys(places: NDArray[np.float64]) -> NDArray[np.int64]:
    """Cells (N, 3) as single numbers: a million along each axis, of which those beyond share the last."""
    most = 1 << 20
    x, y, z = np.clip(np.floor(places), -most, most - 1).astype(np.int64).T + most
    return np.asarray((x << 42) | (y << 21) | z)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _filled(mask: NDArray[np.uint8], camera: Camera, points: NDArray[np.float64], cell: float) -> NDArray[np.uint8]:
    """The mask with points outside it, the gaps between these, and those to the mask."""
    if not len(points):
        return mask
    marks = np.zeros_like(mask)
    _, x, y = pixels_of(camera, points)
    marks[y, x] = 1
    disc = _disc(_reach(camera, points, cell))
    joined = mask | marks
    return np.asarray(joined | (cv2.morphologyEx(joined, cv2.MORPH_CLOSE, disc) & cv2.dilate(marks, disc)))


def _reach(camera: Camera, points: NDArray[np.float64], cell: float) -> int:
    """Pixels that a cell covers where points (N, 3) in view lie, the median of them, rounded up."""
    return int(np.ceil(cell * camera.K[0, 0] / float(np.median(camera.to_camera(points)[:, 2]))))
