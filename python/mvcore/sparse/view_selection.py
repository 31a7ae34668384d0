"""Where to search: the box, the depth ranges and the source views."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..config import DepthConfig
from ..errors import ReconstructionError
from ..geometry.cameras import Camera
from ..geometry.epipolar import Float
from ..geometry.rig import box_depth, common_volume, corners, in_view, surrounds
from ..types import Bounds, SparsePoints

LEAST_POINTS = 30
"""Points below which their distribution says nothing."""
INWARD = 0.4
"""Share of the points in the middle of a view, in the median view, that must lie in the cameras' common volume for it to be what they look
at. Measured: 0.8 to 1 around objects, 0.02 in a courtyard and 0.04 in a room whose walls are seen across it."""


def _robust_box(points: Float, share: float, margin: float) -> Bounds:
    low, high = np.quantile(points, share, axis=0), np.quantile(points, 1 - share, axis=0)
    pad = margin * (high - low) + 1e-6 * np.abs(high - low).max()
    return np.stack([low - pad, high + pad])


def _points_box(points: SparsePoints) -> Bounds:
    """Box of all points without outliers, and of most points of each view: few may lie on what one view alone looks at."""
    boxes = [_robust_box(points.positions, 0.002, 0.15)]
    boxes += [_robust_box(points.positions[seen], 0.05, 0.0) for seen in points.visible if seen.sum() >= LEAST_POINTS]
    return np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)])


def _inside(points: Float, box: Bounds) -> NDArray[np.bool_]:
    return np.asarray(((points >= box[0]) & (points <= box[1])).all(1))


def search_box(cameras: Sequence[Camera], points: SparsePoints) -> Bounds:
    """Box of the target, (2, 3).

    Cameras that look inwards at what their points lie on: the volume that most of them see, so that the background drops out. Cameras on
    one side, and those that look outwards or across: the points themselves, robustly. Textureless scenes fall back to the common volume.

    Raises
    ------
    ReconstructionError
        Neither points nor a common volume exist.
    """
    common = common_volume(cameras)
    if len(points) < LEAST_POINTS:
        if common is None:
            raise ReconstructionError("the views share neither features nor a common volume: give bounds, or check the poses")
        return common
    if common is not None and surrounds(cameras) and _looked_at(cameras, points, common) >= INWARD:
        return common
    return _points_box(points)


def _looked_at(cameras: Sequence[Camera], points: SparsePoints, box: Bounds) -> float:
    """Share of the points in the middle of a view, half as wide and high, that lie in a box: the median of the views; 1 without points."""
    inside, shares = _inside(points.positions, box), []
    for camera, visible in zip(cameras, points.visible, strict=True):
        size = np.array([camera.width, camera.height])
        central = (np.abs(camera.project(points.positions[visible]) - (size - 1) / 2) < size / 4).all(1)
        if central.any():
            shares.append(inside[visible][central].mean())
    return float(np.median(shares)) if shares else 1.0


def view_middles(cameras: Sequence[Camera], points: SparsePoints, box: Bounds) -> Float:
    """What each view looks at, (V, 3): the median of its points in the box; with few, the box's centre, or a place on its axis."""
    inside = _inside(points.positions, box)
    middles = []
    for camera, visible in zip(cameras, points.visible, strict=True):
        shown = points.positions[inside & visible]
        middle = box.mean(0)
        if len(shown) >= LEAST_POINTS:
            middle = np.median(shown, 0)
        elif camera.to_camera(middle[None])[0, 2] <= 0:
            middle = camera.center + box_depth(camera, box) * camera.axis
        middles.append(middle)
    return np.array(middles)


def _degrees(a: Float, b: Float) -> float:
    """Angle between two directions."""
    return float(np.degrees(np.arccos(np.clip(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300), -1, 1))))


def nearest_angles(cameras: Sequence[Camera], middles: Float) -> list[float]:
    """Degrees between each view and its nearest neighbour, at what both look at (`view_middles`)."""
    angles = np.full((len(cameras), len(cameras)), np.inf)
    for (i, a), (j, b) in itertools.combinations(enumerate(cameras), 2):
        middle = 0.5 * (middles[i] + middles[j])
        angles[i, j] = angles[j, i] = _degrees(middle - a.center, middle - b.center)
    return [float(a) for a in angles.min(1)]


def depth_ranges(cameras: Sequence[Camera], points: SparsePoints, box: Bounds, stretch: float, bounded: bool) -> list[tuple[float, float]]:
    """(nearest, farthest) z-depth of each view.

    The 1 % and 99 % depths of the points in view, stretched, and the box where points are few. With bounds given by the caller
    (``bounded``) the box alone.
    """
    ranges = []
    for c in cameras:
        z_box = c.to_camera(corners(box))[:, 2]
        far_box = max(float(z_box.max()), 1e-9)
        near_box = max(float(z_box.min()), 0.02 * far_box)
        # All points in the picture, also those matched elsewhere: far background is rarely matched in every view.
        seen = points.positions[in_view(c, points.positions)]
        if bounded or len(seen) < LEAST_POINTS:
            ranges.append((near_box, far_box))
            continue
        z = c.to_camera(seen)[:, 2]
        low, high = np.quantile(z, [0.01, 0.99])
        ranges.append((float(low / (1 + stretch)), float(high * (1 + stretch))))
    return ranges


def _weight(angle: Float, config: DepthConfig) -> Float:
    sigma = np.where(angle < config.best_angle, 1.0, 10.0) if config.best_angle else 10.0
    weight = np.exp(-((angle - config.best_angle) ** 2) / (2 * sigma**2))
    return np.where((angle >= 0.5) & (angle <= config.max_angle), weight, 0.0)


def view_scores(cameras: Sequence[Camera], points: SparsePoints, box: Bounds, config: DepthConfig) -> Float:
    """How well each view serves another as source, (V, V): Σ exp(-(θ - θ0)² / 2σ²) over the points that both show.

    Where views share few points, the angle under which they see what both look at decides instead. A view that has all of the box behind
    it serves none.
    """
    n = len(cameras)
    centers = np.array([c.center for c in cameras])
    scores = np.zeros((n, n))
    middles = view_middles(cameras, points, box)
    shows = [box_depth(c, box) > 0 for c in cameras]
    for i in range(n):
        to_i = points.positions - centers[i]
        to_i /= np.linalg.norm(to_i, axis=1, keepdims=True).clip(1e-300)
        for j in range(i + 1, n):
            both = points.visible[i] & points.visible[j]
            shared = 0.0
            if both.any():
                to_j = points.positions[both] - centers[j]
                to_j /= np.linalg.norm(to_j, axis=1, keepdims=True).clip(1e-300)
                angles = np.degrees(np.arccos(np.clip((to_i[both] * to_j).sum(1), -1, 1)))
                shared = float(_weight(angles, config).sum())
            middle = 0.5 * (middles[i] + middles[j])
            angle = _degrees(middle - centers[i], middle - centers[j])
            # A prior worth a few points; it must still rank wide angles, where the Gaussian has vanished.
            wide = max(float(_weight(np.array([angle]), config)[0]), 1e-3 * max(0.0, 1 - angle / config.max_angle))
            turn = np.degrees(np.arccos(np.clip(cameras[i].axis @ cameras[j].axis, -1, 1)))
            apart = np.linalg.norm(centers[i] - centers[j]) > 1e-9 * max(np.abs(centers).max(), 1e-300)
            facing = angle <= config.max_angle and turn <= 90 and apart and shows[i] and shows[j]
            scores[i, j] = scores[j, i] = shared + 5.0 * wide if facing else 0.0
    return scores


def choose_sources(scores: Float, count: int) -> list[list[int]]:
    """The best sources of each view, best first; views that share nothing have none."""
    return [[int(j) for j in np.argsort(-row, kind="stable")[:count] if row[j] > 0] for row in scores]
