"""A frame at the rig: absolute coordinates (UTM, ECEF) leave float64 few digits for the scene, and float32 none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .cameras import Calibration, Camera
from .projections import MIRROR

Float = NDArray[np.float64]

GRID = 2.0**-26
"""Share of the rig's extent on which camera centres lie in the local frame: 1e-8, far below any calibration's error.
The same rig at another place in the world then has the same local cameras to the bit, and the same mesh."""


@dataclass(frozen=True)
class LocalFrame:
    """``point_in_world = M (point + origin)``, M the identity, or the reflection in z of a left-handed world (`MIRROR`).

    origin : (3,) float64, world units, in the world of the cameras. mirrored : the caller's world is left-handed.
    """

    origin: Float
    mirrored: bool = False

    @classmethod
    def of(cls, cameras: Calibration | Sequence[Camera]) -> LocalFrame:
        """At the first camera's centre, as written: no arithmetic on large numbers."""
        mirrored = isinstance(cameras, Calibration) and cameras.mirrored
        return cls(np.array(cameras[0].center, np.float64), mirrored)

    def cameras(self, cameras: Sequence[Camera]) -> list[Camera]:
        """The cameras in the local frame."""
        centers = np.stack([c.center for c in cameras]) - self.origin
        extent = float(np.abs(centers).max())
        if extent > 0:
            step = 2.0 ** np.round(np.log2(extent * GRID))
            centers = np.round(centers / step) * step
        return [replace(c, t=-c.R @ x) for c, x in zip(cameras, centers, strict=True)]

    def _reflected(self, points: Float) -> Float:
        return points * np.diag(MIRROR)[:3] if self.mirrored else points

    def inwards(self, points: Float) -> Float:
        """World points (..., 3) in the local frame."""
        return self._reflected(np.asarray(points, np.float64)) - self.origin

    def world(self, points: Float) -> Float:
        """Local points (..., 3) in the world."""
        return self._reflected(np.asarray(points, np.float64) + self.origin)

    def box_inwards(self, box: Float) -> Float:
        """A world box (2, 3) in the local frame."""
        return np.sort(self.inwards(box), axis=0)

    def world_box(self, box: Float) -> Float:
        """A local box (2, 3) in the world."""
        return np.sort(self.world(box), axis=0)

    def faces(self, faces: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """Faces (F, 3) that are counter-clockwise from outside in the local frame, so in the world."""
        return np.ascontiguousarray(faces[:, ::-1]) if self.mirrored else faces

    def pose(self, pose: Float) -> Float:
        """A rigid motion (..., 4, 4) of local points as one of world points."""
        out = np.array(pose, np.float64)
        out[..., :3, 3] += self.origin - out[..., :3, :3] @ self.origin
        return MIRROR @ out @ MIRROR if self.mirrored else out
