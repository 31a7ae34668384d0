"""What a rig of cameras looks at."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..types import Bounds
from .cameras import Camera
from .epipolar import Float

SURROUND = 0.8
"""Length of the mean viewing direction below which cameras look in many directions (about 75 degrees to either side)."""


COMMON = 0.6
"""Share of the cameras that must see a place for it to belong to a surrounded target's volume."""


def convergence(cameras: Sequence[Camera]) -> Float:
    """The point nearest to all optical axes: what the cameras look at. Shape (3,)."""
    matrix, vector = np.zeros((3, 3)), np.zeros(3)
    for c in cameras:
        across = np.eye(3) - np.outer(c.axis, c.axis)
        matrix += across
        vector += across @ c.center
    center = np.mean([c.center for c in cameras], 0)
    # Parallel axes meet nowhere: a little damping keeps the solution finite.
    return np.linalg.solve(matrix + 1e-6 * len(cameras) * np.eye(3), vector + 1e-6 * len(cameras) * center)


def in_view(camera: Camera, points: Float) -> NDArray[np.bool_]:
    """Which points (n, 3) fall on the image, (n,)."""
    x = camera.project(points)
    with np.errstate(invalid="ignore"):
        return (x[:, 0] >= -0.5) & (x[:, 1] >= -0.5) & (x[:, 0] <= camera.width - 0.5) & (x[:, 1] <= camera.height - 0.5)


def surrounds(cameras: Sequence[Camera]) -> bool:
    """Whether the cameras look in many directions: inwards from around a target, or outwards from amid what they see."""
    return float(np.linalg.norm(np.mean([c.axis for c in cameras], 0))) < SURROUND


def corners(box: Bounds) -> Float:
    """The eight corners of a box, (8, 3)."""
    return np.array(list(itertools.product(*np.asarray(box, np.float64).T)))


def box_depth(camera: Camera, box: Bounds) -> float:
    """Middle of the z-depths at which a box lies in front of a camera: that of its centre where all of it does, 0 where none of it does."""
    z = camera.to_camera(corners(box))[:, 2]
    return 0.5 * (max(float(z.min()), 0.0) + max(float(z.max()), 0.0))


def common_volume(cameras: Sequence[Camera], samples: int = 64) -> Bounds | None:
    """Box of the places that most cameras see around the point they look at; None where they look at no common place."""
    target = convergence(cameras)
    distances = np.array([(target - c.center) @ c.axis for c in cameras])
    if np.median(distances) <= 0:
        return None
    reach = np.median(distances)
    steps = np.linspace(-reach, reach, samples)
    grid = target + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    seen = np.zeros(len(grid), np.int32)
    for c in cameras:
        near = (grid - c.center) @ c.axis > 0.2 * reach
        seen += in_view(c, grid) & near
    inside = grid[seen >= max(2, COMMON * len(cameras))]
    if not len(inside):
        return None
    half = 0.5 * (steps[1] - steps[0])
    return np.stack([inside.min(0) - half, inside.max(0) + half])
