"""The hull as a signed distance field, and photo-consistency carving of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import CarveConfig, VolumeConfig
from ..errors import ReconstructionError
from ..geometry.cameras import Camera
from ..geometry.rig import box_depth
from ..silhouettes.visual_hull import Mask
from ..types import Bounds, DepthMap, Image, Report
from .tsdf import SIDE, Volume, Window, fuse


def visual_hull(
    masks: Sequence[Mask],
    cameras: Sequence[Camera],
    bounds: Bounds,
    config: VolumeConfig | None = None,
    report: Report | None = None,
    windows: Sequence[Window] | None = None,
) -> Volume:
    """The visual hull as a signed distance field with a sub-voxel surface (soft silhouettes), block-sparse.

    Parameters and errors as of `mvcore.volume.tsdf.fuse`.
    """
    nothing, coarse = hull_alone(cameras, config or VolumeConfig())
    return fuse(nothing, cameras, bounds, masks, coarse, report, windows)


def hull_alone(cameras: Sequence[Camera], config: VolumeConfig) -> tuple[list[DepthMap], VolumeConfig]:
    """What fusion takes for the hull of silhouettes without depth."""
    nothing = [DepthMap(e, e) for e in (np.zeros((c.height, c.width), np.float32) for c in cameras)]
    return nothing, replace(config, solid_smoothing=config.smoothing, footprints=config.hull_footprints)


def _footprint(image: Image, pixels: float) -> tuple[Image, Image]:
    """Least and greatest value a channel within about ``pixels`` around each pixel."""
    side = 2 * max(1, round(0.5 * pixels)) + 1
    kernel = np.ones((side, side), np.uint8)
    return np.ascontiguousarray(cv2.erode(image, kernel)), np.ascontiguousarray(cv2.dilate(image, kernel))


def photo_hull(
    hull: Volume,
    images: Sequence[Image],
    cameras: Sequence[Camera],
    config: CarveConfig | None = None,
    report: Report | None = None,
) -> Volume:
    """The hull without what the photographs contradict: the photo hull of Kutulakos and Seitz (IJCV 2000).

    Parameters
    ----------
    hull : of `visual_hull`. images : (h, w, 3) uint8, undistorted and of like exposure, one a camera.

    Raises
    ------
    ReconstructionError
        Nothing is left: the photographs contradict each other everywhere.
    """
    config, report = config or CarveConfig(), report or Report()
    field = dense(hull, 1.0)
    box = hull.origin + hull.voxel * np.array([[0, 0, 0], field.shape])
    # A view that has the hull behind it sees no voxel: its footprint does not matter.
    depths = [box_depth(c, box) for c in cameras]
    sides = [hull.voxel * c.K[0, 0] / z if z > 0 else 1.0 for c, z in zip(cameras, depths, strict=True)]
    low, high = zip(*(_footprint(i, s) for i, s in zip(images, sides, strict=True)), strict=True)
    kept = _core.photo_carve(
        hull.origin.tolist(),
        hull.voxel,
        np.ascontiguousarray(field < 0),
        low,
        high,
        np.stack([c.projection for c in cameras]),
        [c.center.tolist() for c in cameras],
        threshold=config.threshold,
        least_views=config.least_views,
        rounds=config.rounds,
    )
    report.values["photo_carving"] = {"voxels": int((field < 0).sum()), "cleared": int((field < 0).sum() - kept.sum())}
    if not kept.any():
        raise ReconstructionError("photo-consistency carves everything away: the photographs' colours or poses do not agree")
    # Where nothing was carved the hull's own surface is the better one.
    smooth = _smoothed(np.where(kept, -1.0, 1.0).astype(np.float32))
    return sparse_volume(np.maximum(field, smooth), hull.origin, hull.voxel)


def _smoothed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Binomial mean over 5 voxels along each axis: a surface between full and empty voxels that is no staircase."""
    for axis in range(3):
        padded = np.pad(values, [(2, 2) if a == axis else (0, 0) for a in range(3)], mode="edge")
        n = values.shape[axis]
        parts = [np.take(padded, range(k, k + n), axis) for k in range(5)]
        values = ((parts[0] + parts[4]) + 4 * (parts[1] + parts[3]) + 6 * parts[2]) / 16
    return values


def dense(volume: Volume, beyond: float) -> NDArray[np.float32]:
    """All samples of a block-sparse field, (nx, ny, nz), ``beyond`` where no block is."""
    bx, by, bz = volume.blocks
    blocks = np.full((bx, by, bz, SIDE, SIDE, SIDE), beyond, np.float32)
    i, j, k = volume.coords.T
    blocks[i, j, k] = volume.values
    whole = blocks.transpose(0, 3, 1, 4, 2, 5).reshape(bx * SIDE, by * SIDE, bz * SIDE)
    nx, ny, nz = volume.shape
    return np.ascontiguousarray(whole[:nx, :ny, :nz])


def sparse_volume(field: NDArray[np.float32], origin: NDArray[np.float64], voxel: float) -> Volume:
    """A dense field of -1 .. 1 in blocks; those that are 1 throughout are left out."""
    nx, ny, nz = field.shape
    pad = [(0, -n % SIDE) for n in field.shape]
    whole = np.pad(field, pad, constant_values=1.0)
    bx, by, bz = (n // SIDE for n in whole.shape)
    blocks = whole.reshape(bx, SIDE, by, SIDE, bz, SIDE).transpose(0, 2, 4, 1, 3, 5)
    used = np.argwhere((blocks < 1).any((3, 4, 5)))
    values = np.ascontiguousarray(blocks[used[:, 0], used[:, 1], used[:, 2]], np.float32)
    return Volume(np.asarray(origin, np.float64), voxel, (nx, ny, nz), np.ascontiguousarray(used, np.uint32), values)
