"""Cameras from bare projection matrices, also those of a mirrored (left-handed) world.

P ~ K [R | t] fixes neither the scale nor the sign. With the sign that makes det(P[:, :3]) positive, R is a rotation; if
then all that the cameras look at lies behind them, while it lies in front under the printed sign (P[2] X > 0), the world of
P is left-handed: a turntable whose axis points the other way. Such a world is reflected before anything else is done.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .cameras import Camera
from .rig import convergence

MIRROR: NDArray[np.float64] = np.diag([1.0, 1.0, -1.0, 1.0])
"""The reflection z → -z between the caller's left-handed world and the right-handed one that is worked in; its own inverse."""
MEETING = 0.2
"""Least mean |sin| between two optical axes for which the point where they meet says what lies in front."""


def cameras_from_projections(
    matrices: Sequence[ArrayLike], sizes: Sequence[tuple[int, int]], names: Sequence[str] | None = None
) -> tuple[list[Camera], bool]:
    """Cameras of one world's projection matrices, and whether that world is mirrored.

    Parameters
    ----------
    matrices : of shape (3, 4), of any scale and sign. sizes : (width, height) of each image.

    Returns
    -------
    cameras : list[Camera]
        If mirrored, those of the world reflected by `MIRROR`: P_reflected = P MIRROR.
    mirrored : bool

    Raises
    ------
    InvalidInputError
        A matrix of another shape, or whose left 3x3 block is singular.

    Examples
    --------
    >>> P = np.array([[500.0, 0, 320, 0], [0, 500, 240, 0], [0, 0, 1, 4]])
    >>> cameras, mirrored = cameras_from_projections([P, 2 * P], [(640, 480)] * 2)
    >>> [round(float(K), 6) for K in np.diag(cameras[1].K)], mirrored
    ([500.0, 500.0, 1.0], False)
    """
    names = names or [""] * len(matrices)
    views = list(zip(matrices, sizes, names, strict=True))
    cameras = [Camera.from_projection(p, *size, name=name) for p, size, name in views]
    if not _mirrored(cameras, matrices):
        return cameras, False
    return [Camera.from_projection(np.asarray(p, np.float64) @ MIRROR, *size, name=name) for p, size, name in views], True


def _mirrored(cameras: Sequence[Camera], matrices: Sequence[ArrayLike]) -> bool:
    if any(np.linalg.det(np.asarray(p, np.float64)[:, :3]) > 0 for p in matrices) or len(cameras) < 2:
        return False
    axes = np.array([c.axis for c in cameras])
    across = np.linalg.norm(np.cross(axes[:, None], axes[None]), axis=2)
    if across.sum() / (len(axes) * (len(axes) - 1)) < MEETING:
        return False  # about parallel axes meet nowhere near: the sign is an arbitrary one
    middle = convergence(cameras)
    depth = np.array([c.to_camera(middle[None])[0, 2] for c in cameras])
    return bool((depth < 0).all())
