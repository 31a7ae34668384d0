"""Poses as files hold them, as world-to-camera (R, t) in OpenCV's axes (x right, y down, z forward)."""

from __future__ import annotations

import numpy as np

from ...errors import InvalidInputError, require
from ...geometry.cameras import rotation_from
from .values import Entry, Float

OPENGL = np.diag([1.0, -1.0, -1.0])
"""From camera axes x right, y up, z back."""


def from_center(world_to_camera: Float, center: Float) -> tuple[Float, Float]:
    """(R, t) from a rotation world to camera and the camera's centre."""
    r = rotation_from(world_to_camera)
    return r, -r @ center


def from_camera_to_world(pose: Float, axes: Float | None = None) -> tuple[Float, Float]:
    """(R, t) from a 3 x 4 or 4 x 4 camera-to-world matrix; ``axes`` turn its camera axes into OpenCV's."""
    r = pose[:3, :3].T if axes is None else axes @ pose[:3, :3].T
    return from_center(r, pose[:3, 3])


def quaternion(w: float, x: float, y: float, z: float) -> Float:
    """The rotation of a Hamilton quaternion of about unit length."""
    q = np.array([w, x, y, z], float)
    length = float(np.linalg.norm(q))
    require(abs(length - 1) < 0.1, "quaternion", "length 1", f"{length:.3g}")
    w, x, y, z = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rodrigues(vector: Float) -> Float:
    """The rotation about a vector by its length in radians."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    require(np.isfinite(angle), "rotation vector", "a finite length", angle)
    x, y, z = vector / angle
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across


def read_rotation(entry: Entry) -> Float:
    """A rotation as a vector of 3 or a matrix of 9 numbers."""
    values = entry.numbers()
    if len(values) not in (3, 9):
        raise entry.fail(f"expected a rotation of 3 or 9 numbers, got {len(values)}")
    try:
        return rodrigues(np.array(values)) if len(values) == 3 else rotation_from(np.reshape(values, (3, 3)))
    except InvalidInputError as error:
        raise entry.fail(str(error)) from None
