"""Signed distance to silhouettes, and how much the visual hull counts against depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..geometry.cameras import Camera
from ..silhouettes.occluder_repair import pixels_of
from ..types import DepthMap


def silhouette_distance(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Signed distance to a mask's border in pixels, positive outside, (h, w) float32; 65,536 where there is no border."""
    inside = (mask > 0).astype(np.uint8)
    # Where one of the two is zero the pixel itself is a site.
    squared = _core.distance_transform(inside)[0] + _core.distance_transform(1 - inside)[0]
    distance = np.sqrt(squared.astype(np.float32)) - np.float32(0.5)
    return np.asarray(np.where(inside > 0, -distance, distance), np.float32)


def _open_share(depths: Sequence[DepthMap], masks: Sequence[NDArray[np.uint8]]) -> float:
    """Share of the masks' pixels without depth, the mean of the views that show anything."""
    shares = [float((d.depth[m > 0] == 0).mean()) for d, m in zip(depths, masks, strict=True) if m.any()]
    return float(np.mean(shares)) if shares else 1.0


ON_HULL = 0.01
"""Times a target's extent: distance from the visual hull within which a point lies on it."""


HULL_POINTS = 2000
"""Points a view, about, by which that is judged."""


def hull_share(depths: Sequence[DepthMap], cameras: Sequence[Camera], masks: Sequence[NDArray[np.uint8]]) -> float:
    """Share of the measured surface that is the visual hull's, 1 where nothing was measured: much of a ball, little of a pickup's bed.

    What the hull says where nothing was measured is as trustworthy as that. Points count by their squared confidence: where little is
    measured, much of it is wrong.

    Parameters
    ----------
    depths : filtered, one a camera. masks : (h, w) uint8, non-zero on the target, one a camera.
    """
    clouds, weights = [], []
    for view, camera, mask in zip(depths, cameras, masks, strict=True):
        y, x = np.nonzero((view.depth > 0) & (mask > 0))
        step = max(1, len(x) // HULL_POINTS)
        x, y = x[::step], y[::step]
        clouds.append(camera.unproject(np.column_stack([x, y]), view.depth[y, x]))
        weights.append(np.square(view.confidence[y, x], dtype=np.float64))
    points, weight = np.concatenate(clouds), np.concatenate(weights)
    if not weight.sum():
        return 1.0
    # A point lies as deep within the hull as within the outline to which it is nearest.
    depth_in_hull = np.full(len(points), -np.inf)
    for camera, mask in zip(cameras, masks, strict=True):
        outside = silhouette_distance(mask)
        seen, x, y = pixels_of(camera, points)
        z = camera.to_camera(points[seen])[:, 2]
        depth_in_hull[seen] = np.maximum(depth_in_hull[seen], outside[y, x] * z / camera.K[0, 0])
    low, high = np.quantile(points, (0.05, 0.95), axis=0)
    return float(weight[np.abs(depth_in_hull) < ON_HULL * np.linalg.norm(high - low)].sum() / weight.sum())
