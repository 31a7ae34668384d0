"""Where to search: the box, the depth ranges and the source views."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ..config import DepthConfig
from ..errors import ReconstructionError
from ..geometry.cameras import Camera
from ..geometry.epipolar import Float
from ..geometry.rig import common_volume, in_view, surrounds
from ..types import Bounds, SparsePoints

LEAST_POINTS = 30
"""Points below which their distribution says nothing."""


def _robust_box(points: Float, share: float, margin: float) -> Bounds:
    low, high = np.quantile(points, share, axis=0), np.quantile(points, 1 - share, axis=0)
    pad = margin * (high - low) + 1e-6 * np.abs(high - low).max()
    return np.stack([low - pad, high + pad])


def target_box(cameras: Sequence[Camera], points: SparsePoints) -> Bounds:
    """Box of the target, (2, 3).

    Cameras around a target: the volume that most of them see, so that the background drops out. Cameras on one side: the
    points themselves, robustly. Textureless scenes fall back to the common volume.

    Raises
    ------
    ReconstructionError
        Neither points nor a common volume exist.
    """
    common = common_volume(cameras)
    if surrounds(cameras) and common is not None:
        return common
    if len(points) >= LEAST_POINTS:
        return _robust_box(points.positions, 0.002, 0.15)
    if common is None:
        raise ReconstructionError("the views share neither features nor a common volume: give bounds, or check the poses")
    return common


def depth_ranges(cameras: Sequence[Camera], points: SparsePoints, box: Bounds, stretch: float, bounded: bool) -> list[tuple[float, float]]:
    """(nearest, farthest) z-depth of each view.

    The 1 % and 99 % depths of the points in view, stretched, and the box where points are few. With bounds given by the caller
    (``bounded``) the box alone.
    """
    corners = np.array(list(itertools.product(*box.T)))
    ranges = []
    for c in cameras:
        z_box = c.to_camera(corners)[:, 2]
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

    Where views share few points, the angle under which they see the target's middle decides instead.
    """
    n = len(cameras)
    centers = np.array([c.center for c in cameras])
    scores = np.zeros((n, n))
    middle = np.median(points.positions, 0) if len(points) >= LEAST_POINTS and not surrounds(cameras) else box.mean(0)
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
            a, b = middle - centers[i], middle - centers[j]
            angle = np.degrees(np.arccos(np.clip(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300), -1, 1)))
            # A prior worth a few points; it must still rank wide angles, where the Gaussian has vanished.
            wide = max(float(_weight(np.array([angle]), config)[0]), 1e-3 * max(0.0, 1 - angle / config.max_angle))
            turn = np.degrees(np.arccos(np.clip(cameras[i].axis @ cameras[j].axis, -1, 1)))
            apart = np.linalg.norm(centers[i] - centers[j]) > 1e-9 * max(np.abs(centers).max(), 1e-300)
            facing = angle <= config.max_angle and turn <= 90 and apart
            scores[i, j] = scores[j, i] = shared + 5.0 * wide if facing else 0.0
    return scores


def choose_sources(scores: Float, count: int) -> list[list[int]]:
    """The best sources of each view, best first; views that share nothing have none."""
    return [[int(j) for j in np.argsort(-row, kind="stable")[:count] if row[j] > 0] for row in scores]
