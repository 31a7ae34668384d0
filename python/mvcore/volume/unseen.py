"""Where a visual hull need not be made: blocks of it that no camera sees, found on a coarse field."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..geometry.cameras import Camera

if TYPE_CHECKING:
    from .tsdf import Volume

COARSE = 4
"""Voxels of the field to one of the coarse one: a sixteenth of the blocks, and cells half a block wide."""
SIDE = 8


def unseen_blocks(
    coarse: Iterable[Volume], cameras: Sequence[Camera], fine: Volume, reach: float
) -> NDArray[np.bool_] | None:
    """Blocks near whose coarse surface no camera sees any of it, (nx, ny, nz) bool.

    A block without coarse surface near it is not among them: thin parts that the coarse field lacks are kept.

    Parameters
    ----------
    coarse : the field with voxels of `COARSE` times the size, in parts.
    fine : the grid of the field itself.
    reach : voxels around what is seen that are needed as well.
    """
    vertices, faces = _surface(coarse)
    if not len(faces):
        return None
    seen = np.zeros(len(vertices), bool)
    for camera in cameras:
        # Faces are as large as the coarse voxels, of several pixels each.
        size = (max(2, -(-camera.width // 2)), max(2, -(-camera.height // 2)))
        small = camera.resized(*size)
        _, face = _core.rasterize(vertices, faces, small.projection, *size)
        seen[faces[np.unique(face[face >= 0])]] = True
    at = np.floor((vertices - fine.origin) / (SIDE * fine.voxel)).astype(np.int64)
    at = at.clip(0, np.array(fine.blocks) - 1)
    surface, needed = np.zeros(fine.blocks, bool), np.zeros(fine.blocks, bool)
    surface[tuple(at.T)] = True
    needed[tuple(at[seen].T)] = True
    # A block for the smoothing, and what a vertex may be off.
    return _dilated(surface, 1) & ~_dilated(needed, 1 + math.ceil((reach + COARSE) / SIDE))


def _surface(coarse: Iterable[Volume]) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint32)], 0
    for part in coarse:
        v, f = _core.isosurface_sparse(part.coords, part.values)
        vertices.append(part.origin + part.voxel * v.astype(np.float64))
        faces.append(f + np.uint32(count))
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def _dilated(flags: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Grown by so many blocks along each axis, diagonals included."""
    for axis in range(3):
        out = flags.copy()
        for step in range(1, min(steps, flags.shape[axis] - 1) + 1):
            near, far = [slice(None)] * 3, [slice(None)] * 3
            near[axis], far[axis] = slice(step, None), slice(None, -step)
            out[tuple(near)] |= flags[tuple(far)]
            out[tuple(far)] |= flags[tuple(near)]
        flags = out
    return flags
