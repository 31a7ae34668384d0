"""What a coarse field says of a fine one's blocks: where a visual hull need not be made."""

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
"""Voxels of the field to one of the coarse one: a 64th of the voxels, and two samples along a block's side."""
SIDE = 8
FREE, SOLID, UNSEEN = 1, -1, 2
"""Of a block: free or solid throughout, or with a surface that no camera sees. 0 says nothing."""


def hints(parts: Iterable[Volume], cameras: Sequence[Camera], fine: Volume, reach: float) -> NDArray[np.int8]:
    """A hint for each block of a field, (nx, ny, nz) int8.

    Parameters
    ----------
    parts : of the same field at each `COARSE`-th sample along the axes.
    fine : the grid of the field itself.
    reach : voxels around what is seen beyond which surfaces are `UNSEEN`.
    """
    out = np.zeros(fine.blocks, np.int8)
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint32)], 0
    for part in parts:
        _put_signs(out, part)
        v, f = _core.isosurface_sparse(part.coords, part.values)
        vertices.append(part.origin + part.voxel * v.astype(np.float64))
        faces.append(f + np.uint32(count))
        count += len(v)
    if count:
        out[_unseen(np.concatenate(vertices), np.concatenate(faces), cameras, fine, reach)] = UNSEEN
    return out


def _put_signs(out: NDArray[np.int8], part: Volume) -> None:
    """Marks the blocks in which all samples of a part have one sign; those of blocks that it lacks stay."""
    n = COARSE
    inside, outside = part.values < 0, part.values > 0
    for x, y, z in np.ndindex(n, n, n):
        # A block's samples and those where the next block begins, as far as the coarse block has them.
        cut = np.s_[:, 2 * x : 2 * x + 3, 2 * y : 2 * y + 3, 2 * z : 2 * z + 3]
        solid, free = inside[cut].all((1, 2, 3)), outside[cut].all((1, 2, 3))
        at = part.coords.astype(np.int64) * n + (x, y, z)
        # The layer of blocks that two parts share is whole in one of them.
        kept = (solid | free) & (at < out.shape).all(1)
        out[tuple(at[kept].T)] = np.where(solid, SOLID, FREE)[kept]


def _unseen(
    vertices: NDArray[np.float64], faces: NDArray[np.uint32], cameras: Sequence[Camera], fine: Volume, reach: float
) -> NDArray[np.bool_]:
    """Blocks near whose coarse surface no camera sees any of it, (nx, ny, nz).

    A block without coarse surface near it is not among them: thin parts that the coarse field lacks are kept.
    """
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
