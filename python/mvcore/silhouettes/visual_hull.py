"""Space carving: the visual hull of silhouettes, and what photo-consistency takes off it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import CarveConfig
from ..errors import require
from ..geometry.cameras import Camera
from ..geometry.rig import box_depth
from ..types import Bounds

Mask = NDArray[np.uint8]


@dataclass(frozen=True)
class Occupancy:
    """Voxels that are full or empty.

    origin : (3,) world position of voxel (0, 0, 0). voxel : their distance, world units. occupied : (nx, ny, nz) bool.
    """

    origin: NDArray[np.float64]
    voxel: float
    occupied: NDArray[np.bool_]

    def box(self, margin: float = 1.0) -> Bounds:
        """Of the full voxels, wider by ``margin`` voxels on every side, (2, 3) world; some voxel must be full."""
        full = np.argwhere(self.occupied)
        return np.asarray(self.origin + self.voxel * np.stack([full.min(0) - margin, full.max(0) + margin]))

    def shell(self) -> NDArray[np.float64]:
        """World positions (n, 3) of the full voxels that have an empty neighbour."""
        o = self.occupied
        padded = np.pad(o, 1)
        inner = np.ones_like(o)
        for axis in range(3):
            for step in (0, 2):
                window = [slice(1, -1)] * 3
                window[axis] = slice(step, step + o.shape[axis])
                inner &= padded[tuple(window)]
        return self.origin + self.voxel * np.argwhere(o & ~inner)


def carve_silhouettes(
    masks: Sequence[Mask],
    cameras: Sequence[Camera],
    bounds: Bounds,
    *,
    voxel: float | None = None,
    resolution: int = 128,
    tolerance: float = 0.04,
    least_views: int = 2,
) -> Occupancy:
    """Voxels inside the visual hull, by the vote of the cameras that see them.

    Parameters
    ----------
    masks : (h, w) uint8, non-zero on the target, one a camera. bounds : (2, 3) world.
    voxel : world units; by default the longest side of the bounds over ``resolution`` - 1.
    tolerance : share of the cameras that see a voxel and may call it background: one wrong mask among many does no harm.
    least_views : fewest cameras that must see a voxel.

    Raises
    ------
    InvalidInputError
        Empty bounds, more than 255 masks, or a tolerance outside [0, 1).

    Examples
    --------
    >>> camera = Camera(K=[[50, 0, 31.5], [0, 50, 31.5], [0, 0, 1]], R=np.eye(3), t=[0, 0, 4], width=64, height=64)
    >>> disc = np.zeros((64, 64), np.uint8)
    >>> disc = cv2.circle(disc, (31, 31), 12, 255, -1)
    >>> hull = carve_silhouettes([disc, disc], [camera, camera], np.array([[-2.0, -2, -2], [2, 2, 2]]), resolution=33)
    >>> bool(hull.occupied[16, 16, 16]), bool(hull.occupied[0, 16, 16])
    (True, False)
    """
    bounds = np.asarray(bounds, np.float64)
    size = bounds[1] - bounds[0]
    require((size > 0).all(), "bounds", "x0 < x1, y0 < y1, z0 < z1", bounds.tolist())
    require(len(masks) == len(cameras), "masks", f"{len(cameras)}, one a camera", len(masks))
    require(resolution >= 2, "resolution", "at least 2", resolution)
    step = float(voxel if voxel is not None else size.max() / (resolution - 1))
    shape = [int(n) for n in np.floor(size / step + 1e-9) + 1]
    inside = _core.carve(
        bounds[0].tolist(),
        step,
        shape,
        [np.ascontiguousarray(m) for m in masks],
        np.stack([c.projection for c in cameras]),
        tolerance=tolerance,
        least_views=least_views,
    )
    return Occupancy(bounds[0], step, inside)


def shadow(hull: Occupancy, camera: Camera, grow: float = 1.0) -> Mask:
    """Pixels whose ray meets a full voxel, (h, w) uint8 of 0 and 255; voxels count ``grow`` times their size."""
    return splat(hull.shell(), grow * hull.voxel, camera)


def splat(points: NDArray[np.float64], size: float, camera: Camera) -> Mask:
    """Pixels that points (n, 3) cover, each a cube of ``size`` in world units, (h, w) uint8 of 0 and 255."""
    image = np.zeros((camera.height, camera.width), np.uint8)
    if not len(points):
        return image
    z = camera.to_camera(points)[:, 2]
    points, z = points[z > 0], z[z > 0]
    x = np.rint(camera.project(points)).astype(np.int64)
    inside = ((x >= 0) & (x < (camera.width, camera.height))).all(1)
    image[x[inside, 1], x[inside, 0]] = 255
    if not inside.any():
        return image
    # A cube's diagonal reaches 0.87 of its side to either side.
    reach = int(np.ceil(0.87 * size * camera.K[0, 0] / float(np.quantile(z[inside], 0.1))))
    return cv2.dilate(image, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1)))


def _grown(mask: Mask, camera: Camera, bounds: Bounds, voxel: float) -> Mask:
    """The mask wider by half a voxel's diagonal, so that a voxel counts where any part of it is inside."""
    depth = max(box_depth(camera, bounds), voxel)
    reach = int(np.ceil(0.87 * voxel * camera.K[0, 0] / depth))
    return cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1)))


MOST_VIEWS = 255
"""Views that `carve_silhouettes` takes."""
EXPLAINED = 0.97
"""Share of what the fullest hull shows of the masks that a smaller one must show."""


def bounded_hull(masks: Sequence[Mask], cameras: Sequence[Camera], bounds: Bounds, config: CarveConfig) -> Occupancy:
    """The hull in a box of its own, without the phantoms that few views cannot rule out.

    Near few cameras, or outside most pictures, hardly anything speaks against a voxel. So as many cameras must see a voxel as the
    masks allow: the most for which the hull still covers them.
    """
    masks, cameras = at_most(MOST_VIEWS, masks, cameras)
    counts = sorted({max(2, round(share * len(cameras))) for share in (1.0, 0.75, 0.5, 0.25)}, reverse=True)
    hulls = [_tight_hull(masks, cameras, bounds, config, least) for least in counts]
    covered = [_covered(h, masks, cameras) for h in hulls]
    return next(h for h, share in zip(hulls, covered, strict=True) if share >= EXPLAINED * max(covered))


def at_most(count: int, masks: Sequence[Mask], cameras: Sequence[Camera]) -> tuple[Sequence[Mask], Sequence[Camera]]:
    """Views spread evenly: the kernel counts votes in bytes, and as many as it takes say the same of a hull as all."""
    if len(masks) <= count:
        return masks, cameras
    chosen = np.linspace(0, len(masks) - 1, count).round().astype(int)
    return [masks[n] for n in chosen], [cameras[n] for n in chosen]


def large_parts(mask: Mask, share: float) -> Mask:
    """The parts of a mask (0 and 1) that have at least ``share`` of the largest part's pixels, and 16."""
    count, part, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count <= 1:
        return mask
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return (area >= max(16, share * area.max()))[part].astype(np.uint8)


def _covered(hull: Occupancy, masks: Sequence[Mask], cameras: Sequence[Camera]) -> float:
    """Share of the masks that the hull's shadow covers."""
    total = sum(np.count_nonzero(m) for m in masks)
    return sum(np.count_nonzero((m > 0) & (shadow(hull, c) > 0)) for m, c in zip(masks, cameras, strict=True)) / max(total, 1)


def _tight_hull(masks: Sequence[Mask], cameras: Sequence[Camera], bounds: Bounds, config: CarveConfig, least: int) -> Occupancy:
    """The hull of masks grown by a voxel, its box twice refined; empty where the masks have nothing in common."""
    box = np.asarray(bounds, np.float64)
    hull = Occupancy(box[0], 1.0, np.zeros((1, 1, 1), bool))
    for _ in range(3):
        voxel = float((box[1] - box[0]).max()) / (config.resolution - 1)
        grown = [_grown(m, c, box, voxel) for m, c in zip(masks, cameras, strict=True)]
        hull = carve_silhouettes(grown, cameras, box, voxel=voxel, tolerance=config.tolerance, least_views=least)
        if not hull.occupied.any():
            break
        box = hull.box()
    return hull


def supported(
    masks: Sequence[Mask], cameras: Sequence[Camera], bounds: Bounds, config: CarveConfig, tolerance: float, least_views: int = 2
) -> list[Mask]:
    """Per camera the pixels whose rays meet a voxel that the *other* cameras' masks support, (h, w) uint8 of 0 and 255.

    All but the share ``tolerance`` of those that see it must, and at least ``least_views`` must see it. Foreground elsewhere is noise.
    Where the others have nothing in common, these are all pixels.
    """
    hull = bounded_hull(masks, cameras, bounds, config)
    box = np.asarray(bounds, np.float64)
    if hull.occupied.any():
        box = hull.box(2.0)
    voxel = float((box[1] - box[0]).max()) / (config.resolution - 1)
    grown = [_grown(m, c, box, voxel) for m, c in zip(masks, cameras, strict=True)]
    found = []
    for n, camera in enumerate(cameras):
        others = [m for k, m in enumerate(grown) if k != n]
        theirs = [c for k, c in enumerate(cameras) if k != n]
        least = min(least_views, len(others))
        hull = carve_silhouettes(others, theirs, box, resolution=config.resolution, tolerance=tolerance, least_views=least)
        seen = shadow(hull, camera, 1.5)
        found.append(seen if seen.any() else np.full_like(seen, 255))
    return found
