"""A frame at the rig: absolute coordinates (UTM, ECEF) leave float64 few digits for the scene, and float32 none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .cameras import Camera

Float = NDArray[np.float64]

GRID = 2.0**-26
"""Share of the rig's extent on which camera centres lie in the local frame: 1e-8, far below any calibration's error.
The same rig at another place in the world then has the same local cameras to the bit, and the same mesh."""


@dataclass(frozen=True)
class LocalFrame:
    """``point_in_world = point + origin``. origin : (3,) float64, world units."""

    origin: Float

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> LocalFrame:
        """At the first camera's centre, as written: no arithmetic on large numbers."""
        return cls(np.array(cameras[0].center, np.float64))

    def cameras(self, cameras: Sequence[Camera]) -> list[Camera]:
        """The cameras in the local frame."""
        centers = np.stack([c.center for c in cameras]) - self.origin
        extent = float(np.abs(centers).max())
        if extent > 0:
            step = 2.0 ** np.round(np.log2(extent * GRID))
            centers = np.round(centers / step) * step
        return [replace(c, t=-c.R @ x) for c, x in zip(cameras, centers, strict=True)]

    def inwards(self, points: Float) -> Float:
        """World points (..., 3) in the local frame."""
        return np.asarray(points, np.float64) - self.origin

    def world(self, points: Float) -> Float:
        """Local points (..., 3) in the world."""
        return np.asarray(points, np.float64) + self.origin

    def pose(self, pose: Float) -> Float:
        """A rigid motion (..., 4, 4) of local points as one of world points."""
        out = np.array(pose, np.float64)
        out[..., :3, 3] += self.origin - out[..., :3, :3] @ self.origin
        return out
