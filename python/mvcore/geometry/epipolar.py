"""Epipolar geometry of calibrated views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .cameras import Camera

Float = NDArray[np.float64]


def fundamental(a: Camera, b: Camera) -> Float:
    """F with ``x_bᵀ F x_a = 0``, shape (3, 3)."""
    rotation = b.R @ a.R.T
    x, y, z = b.t - rotation @ a.t
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(b.K).T @ cross @ rotation @ np.linalg.inv(a.K)


def epipolar_errors(a: Camera, b: Camera, x_a: Float, x_b: Float) -> Float:
    """Distance in pixels of each x_b from the epipolar line of x_a, (n,)."""
    lines = np.column_stack([x_a, np.ones(len(x_a))]) @ fundamental(a, b).T
    distance = np.abs((np.column_stack([x_b, np.ones(len(x_b))]) * lines).sum(1))
    return distance / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-300)
