"""Fusion of depth maps and silhouettes into a block-sparse signed distance field (paper eqs 39-41, for any pose)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import VolumeConfig
from ..errors import ReconstructionError, require
from ..geometry.cameras import Camera
from ..geometry.rig import box_depth, corners
from ..silhouettes.occluder_repair import repaired_masks
from ..types import Bounds, DepthMap, Report
from . import coarse
from .hull_prior import _open_share, hull_share, silhouette_distance

Window = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels of an image that may be a part of what the camera saw."""
SIDE = 8
"""Voxels along a block's side."""


@dataclass(frozen=True)
class Volume:
    """A truncated signed distance field in blocks of 8 x 8 x 8 voxels.

    origin : (3,) world position of sample (0, 0, 0). voxel : sample distance, world units. shape : samples along x, y, z.
    coords : (B, 3) uint32, ascending block coordinates. values : (B, 8, 8, 8) float32, distance over truncation, negative
    inside, NaN unobserved.
    """

    origin: NDArray[np.float64]
    voxel: float
    shape: tuple[int, int, int]
    coords: NDArray[np.uint32]
    values: NDArray[np.float32]

    @property
    def blocks(self) -> tuple[int, int, int]:
        """Blocks along x, y, z."""
        nx, ny, nz = (-(-n // SIDE) for n in self.shape)
        return nx, ny, nz


DEPTH_STEP = 4
"""Pixels between the depths from which a view's scale and the voxel size are taken."""


def _depths_inside(camera: Camera, view: DepthMap, bounds: Bounds) -> NDArray[np.float32]:
    """Depths of a view, each `DEPTH_STEP` pixels, that lie inside the bounds."""
    y, x = np.nonzero(view.depth[::DEPTH_STEP, ::DEPTH_STEP])
    z = view.depth[::DEPTH_STEP, ::DEPTH_STEP][y, x]
    points = camera.unproject(DEPTH_STEP * np.column_stack([x, y]), z)
    return np.asarray(z[((points >= bounds[0]) & (points <= bounds[1])).all(1)])


def voxel_size(cameras: Sequence[Camera], depths: Sequence[DepthMap], bounds: Bounds, config: VolumeConfig) -> float:
    """Voxel size in world units: ``config.footprints`` median pixel footprints (depth over focal length) inside the bounds."""
    return _voxel(cameras, [_depths_inside(c, d, bounds) for c, d in zip(cameras, depths, strict=True)], bounds, config)


def _voxel(cameras: Sequence[Camera], inside: Sequence[NDArray[np.float32]], bounds: Bounds, config: VolumeConfig) -> float:
    if config.voxel is not None:
        require(config.voxel > 0, "voxel", "a positive size", config.voxel)
        return config.voxel
    every = np.concatenate([z / c.K[0, 0] for z, c in zip(inside, cameras, strict=True)])
    if not len(every):  # silhouettes alone: the box stands for the target
        every = np.array([box_depth(c, bounds) / c.K[0, 0] for c in cameras])
        every = every[every > 0]
    require(len(every), "bounds", "a box in front of the cameras", bounds.tolist())
    return config.footprints * float(np.median(every))


class _Known(Sequence[DepthMap]):
    """Depth maps, without depth where there is none; an item is asked for when it is indexed."""

    def __init__(self, depths: Sequence[DepthMap | None], cameras: Sequence[Camera]) -> None:
        require(len(depths) == len(cameras), "depths", f"{len(cameras)}, one a camera", len(depths))
        self._depths, self._cameras = depths, cameras

    def __len__(self) -> int:
        return len(self._depths)

    def __getitem__(self, n: Any) -> Any:
        view, camera = self._depths[n], self._cameras[n]
        if view is not None:
            return view
        empty = np.zeros((camera.height, camera.width), np.float32)
        return DepthMap(empty, empty)


_Blocks = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Block coordinates from the first up to the second."""


@dataclass
class _Maps:
    """Depth, weights and silhouette's distance of each view, or a rectangle of them.

    cuts : left, top, and the whole map's width and height.
    """

    depths: list[NDArray[np.float32]] = field(default_factory=list)
    weights: list[NDArray[np.float32]] = field(default_factory=list)
    silhouettes: list[NDArray[np.float32]] = field(default_factory=list)
    cuts: list[tuple[int, int, int, int]] = field(default_factory=list)

    def add(
        self,
        depth: NDArray[np.float32],
        weight: NDArray[np.float32],
        silhouette: NDArray[np.float32],
        cut: tuple[int, int, int, int],
    ) -> None:
        """Append a view."""
        self.depths.append(depth)
        self.weights.append(weight)
        self.silhouettes.append(silhouette)
        self.cuts.append(cut)


@dataclass(frozen=True)
class _Fusion:
    """What the tiles of a fusion share: little beside the views' maps, which are read when a tile needs them."""

    depths: Sequence[DepthMap]
    cameras: Sequence[Camera]
    scales: list[float]
    outlines: Sequence[NDArray[np.uint8]] | None
    windows: list[Window]
    complete: bool
    solid_weight: float
    bounds: Bounds
    config: VolumeConfig
    voxel: float

    @classmethod
    def of(
        cls,
        maps: Sequence[DepthMap | None],
        cameras: Sequence[Camera],
        bounds: Bounds,
        masks: Sequence[NDArray[np.uint8]] | None,
        config: VolumeConfig,
        windows: Sequence[Window] | None,
        found: Sequence[NDArray[np.uint8]] | None,
    ) -> _Fusion:
        bounds, depths = np.asarray(bounds, np.float64), _Known(maps, cameras)
        inside = [_depths_inside(c, d, bounds) for c, d in zip(cameras, depths, strict=True)]
        voxel = _voxel(cameras, inside, bounds, config)
        outlines = found if masks is None else repaired_masks(depths, cameras, masks, voxel)
        solid_weight = 0.0
        if outlines is not None:
            open_share = _open_share(depths, outlines)
            # Little that was measured says little against the hull.
            trust = 1 - (1 - open_share) * (1 - hull_share(depths, cameras, outlines))
            solid_weight = config.solid_share * trust**2 * open_share * len(depths)
        return cls(
            depths,
            cameras,
            [_distance(c, z, bounds) for c, z in zip(cameras, inside, strict=True)],
            outlines,
            list(windows or [(0.0, 0.0, c.width - 1.0, c.height - 1.0) for c in cameras]),
            masks is None and found is not None,
            solid_weight,
            bounds,
            config,
            voxel,
        )

    def grid(self, voxel: float) -> Volume:
        """An empty volume of this voxel size around the bounds."""
        nx, ny, nz = (int(n) for n in np.ceil((self.bounds[1] - self.bounds[0]) / voxel) + 5)
        nothing = np.zeros((0, 3), np.uint32), np.zeros((0, SIDE, SIDE, SIDE), np.float32)
        return Volume(self.bounds[0] - 2 * voxel, voxel, (nx, ny, nz), *nothing)

    def coarse(self, grid: Volume) -> Iterator[Volume]:
        """The same field at some of the grid's samples, in parts."""
        n = coarse.COARSE
        nx, ny, nz = (-(-count // n) + 1 for count in grid.shape)
        config = replace(
            self.config,
            truncation=max(1.0, self.config.truncation / n),
            smoothing=self.config.smoothing / n,
            solid_smoothing=self.config.solid_smoothing / n,
        )
        return replace(self, config=config).tiles(replace(grid, voxel=n * grid.voxel, shape=(nx, ny, nz)))

    def run(
        self,
        grid: Volume,
        tile: list[list[int]] | None = None,
        hollow: bool = False,
        hints: NDArray[np.int8] | None = None,
    ) -> Volume:
        """The field, or the blocks from tile[0] up to tile[1]; MemoryError beyond ``max_memory``.

        ``hollow`` leaves out what lies so deep inside masks' hull that no surface passes; ``hints``
        of a coarser field, (nx, ny, nz) of the whole grid, help to tell.
        """
        config = self.config
        blocks = np.array([[0, 0, 0], grid.blocks] if tile is None else tile)
        maps = self._maps(grid.origin + SIDE * grid.voxel * blocks, grid.voxel)
        coords, values = _core.fuse(
            grid.origin.tolist(),
            grid.voxel,
            list(grid.shape),
            maps.depths,
            maps.weights,
            None if self.outlines is None else maps.silhouettes,
            self.windows,
            np.stack([c.projection for c in self.cameras]),
            tile=tile,
            cuts=maps.cuts,
            hints=None if hints is None else np.ascontiguousarray(hints[_slices(blocks)]),
            truncation=config.truncation * grid.voxel,
            free_weight=config.free_weight,
            min_weight=config.min_weight,
            solid_weight=self.solid_weight,
            smoothing=config.smoothing if self.outlines is None or self.complete else config.solid_smoothing,
            measured_smoothing=config.smoothing,
            hull_tolerance=config.hull_tolerance,
            complete=self.complete,
            hollow=hollow,
            max_memory=config.max_memory,
        )
        return replace(grid, coords=coords, values=values)

    def _maps(self, box: Bounds, voxel: float) -> _Maps:
        """What the views that may see a box show of it; a pixel that says nothing of the others."""
        maps = _Maps()
        for n, (camera, window) in enumerate(zip(self.cameras, self.windows, strict=True)):
            if not _may_see(camera, window, box):
                maps.add(_NOTHING, _NOTHING, _NOTHING, (0, 0, 1, 1))
                continue
            x0, y0, x1, y1 = _rectangle(camera, box)
            view = self.depths[n]
            part = DepthMap(_part(view.depth, x0, y0, x1, y1), _part(view.confidence, x0, y0, x1, y1))
            outline = _NOTHING
            if self.outlines is not None:
                outline = self._outline(n, box, voxel, (x0, y0, x1, y1))
            maps.add(part.depth, _weights(part, self.scales[n]), outline, (x0, y0, camera.width, camera.height))
        return maps

    def _outline(self, n: int, box: Bounds, voxel: float, part: tuple[int, int, int, int]) -> NDArray[np.float32]:
        """Distance from a silhouette in a part of its view, exact as far as it matters in the box."""
        assert self.outlines is not None
        camera, (x0, y0, x1, y1) = self.cameras[n], part
        nearest = camera.to_camera(corners(box))[:, 2].min()
        mask = self.outlines[n]
        if nearest <= 0:
            return _part(silhouette_distance(mask), x0, y0, x1, y1)
        # Nobody asks how far outside a block or beyond the truncation it is.
        reach = (self.config.truncation + 3 * SIDE) * voxel * camera.K[0, 0] / nearest
        margin = int(min(reach + 8, max(mask.shape)))
        left, top = max(0, x0 - margin), max(0, y0 - margin)
        distance = silhouette_distance(mask[top : y1 + margin, left : x1 + margin])
        return _part(distance, x0 - left, y0 - top, x1 - left, y1 - top)

    def _map_bytes(self, grid: Volume, low: NDArray[np.int64], high: NDArray[np.int64]) -> int:
        """Of what the views show of some blocks."""
        box = grid.origin + SIDE * grid.voxel * np.stack([low - 1, high + 2])
        pixels = 0
        for camera, window in zip(self.cameras, self.windows, strict=True):
            if _may_see(camera, window, box):
                x0, y0, x1, y1 = _rectangle(camera, box)
                pixels += (x1 - x0) * (y1 - y0)
        return pixels * (8 if self.outlines is None else 12)

    def _is_wide(self, grid: Volume, whole: _Blocks, halves: Sequence[_Blocks]) -> bool:
        """Whether what the views show of some blocks takes too much memory, and less for either half."""
        taken = self._map_bytes(grid, *whole)
        if taken <= self.config.max_memory or (whole[1] - whole[0]).max() < 2:
            return False
        return all(self._map_bytes(grid, *half) < taken for half in halves)

    def tiles(self, grid: Volume, hints: NDArray[np.int8] | None = None) -> Iterator[Volume]:
        """All blocks, in parts that fit."""
        return self._tiles(grid, hints, np.zeros(3, np.int64), np.array(grid.blocks))

    def _tiles(self, grid: Volume, hints: NDArray[np.int8] | None, low: NDArray[np.int64], high: NDArray[np.int64]) -> Iterator[Volume]:
        """The blocks from ``low`` up to ``high``, cut in halves until each part fits."""
        # A block more on every side for the smoothing, and one at the far side, of which the last cells take their samples.
        wide = [np.maximum(low - 1, 0).tolist(), np.minimum(high + 2, grid.blocks).tolist()]
        axis = int((high - low).argmax())
        middle = (low[axis] + high[axis]) // 2
        halves = [(low, np.where(np.arange(3) == axis, middle, high)), (np.where(np.arange(3) == axis, middle, low), high)]
        try:
            found = None if self._is_wide(grid, (low, high), halves) else self.run(grid, wide, hollow=True, hints=hints)
        except MemoryError as error:
            found = None
            if high[axis] - low[axis] < 2:
                raise ReconstructionError(f"max_memory = {self.config.max_memory} bytes is too little for a volume: {error}") from None
        if found is None:
            for part in halves:
                yield from self._tiles(grid, hints, *part)
            return
        kept = ((found.coords >= low) & (found.coords <= high)).all(1)
        coords, values = found.coords[kept], found.values[kept]
        for axis in range(3):
            seam = coords[:, axis] == high[axis]
            np.moveaxis(values, axis + 1, 1)[seam, 1:] = np.nan
        yield replace(grid, coords=coords, values=values)


def fuse(
    depths: Sequence[DepthMap | None],
    cameras: Sequence[Camera],
    bounds: Bounds,
    masks: Sequence[NDArray[np.uint8]] | None = None,
    config: VolumeConfig | None = None,
    report: Report | None = None,
    windows: Sequence[Window] | None = None,
) -> Volume:
    """Fuse depth maps inside ``bounds``; with masks the field is carved to the visual hull and closed inside it.

    The whole field is one volume: beyond ``config.max_memory`` its voxels grow. `fuse_tiles` keeps them.

    Parameters
    ----------
    depths : one a camera, of the camera's size, or None where it has none; weights are
        confidence times (the view's distance of the target / z)⁴, as σz grows with z².
    bounds : (2, 3) world.
    masks : (h, w) uint8, non-zero on the target.
    windows : what each camera saw, of which its masks may be a part cut out; by default the masks' own size.

    Raises
    ------
    ReconstructionError
        Nothing lies inside the bounds.
    """
    config, report = config or VolumeConfig(), report or Report()
    job = _Fusion.of(depths, cameras, bounds, masks, config, windows, None)
    voxel = job.voxel
    while True:
        try:
            volume = job.run(job.grid(voxel))
            break
        except MemoryError:
            voxel *= 1.2
    if voxel > job.voxel:
        report.warn(f"voxels grew from {job.voxel:.4g} to {voxel:.4g} to stay within max_memory = {config.max_memory} bytes")
    _say(volume, [(len(volume.coords), volume.values.nbytes)] if len(volume.coords) else [], report)
    return volume


TILE = 256 << 20
"""Bytes of a tile at most, and of the maps that it reads: larger ones save little time."""


def fuse_tiles(
    depths: Sequence[DepthMap | None],
    cameras: Sequence[Camera],
    bounds: Bounds,
    masks: Sequence[NDArray[np.uint8]] | None = None,
    config: VolumeConfig | None = None,
    report: Report | None = None,
    windows: Sequence[Window] | None = None,
    found: Sequence[NDArray[np.uint8]] | None = None,
    unseen_reach: float | None = None,
) -> Iterator[Volume]:
    """The same in parts of at most ``config.max_memory`` or `TILE` bytes, one where it fits. None is in
    memory but the one handed out. Blocks deep inside the masks' hull are left out.

    Neighbours share a layer of samples, equal to the bit, and each cell between samples is in one part alone:
    `mvcore.mesh.surface.isosurface` joins their surfaces to that of the whole. Parameters and errors as of `fuse`, and

    depths, masks : any sequence; an item is asked for when a pass over all views or a tile needs it and is not kept, so that one which
        reads from disk holds only the maps of the views that may see the tile.
    found : silhouettes that were found in the photographs, instead of masks: their hull stands in where no depth map reaches, and cuts
        nothing.
    unseen_reach : with masks, voxels from what a camera sees beyond which the hull is not made where nothing was measured: the surface
        is open there. None makes all of it.
    """
    config, report = config or VolumeConfig(), report or Report()
    config = replace(config, max_memory=min(config.max_memory, TILE))
    job = _Fusion.of(depths, cameras, bounds, masks, config, windows, found)
    grid = job.grid(job.voxel)

    def made() -> Iterator[Volume]:
        parts, hints = [], None
        if masks is not None and unseen_reach is not None:
            hints = coarse.hints(job.coarse(grid), cameras, grid, unseen_reach)
        for part in job.tiles(grid, hints):
            if len(part.coords):
                parts.append((len(part.coords), part.values.nbytes))
                yield part
        _say(grid, parts, report)

    return made()


def _say(grid: Volume, parts: list[tuple[int, int]], report: Report) -> None:
    if not parts:
        raise ReconstructionError("no surface lies inside the bounds: check the bounds, the masks and the depth maps")
    blocks, most = sum(p[0] for p in parts), max(p[1] for p in parts)
    report.values["volume"] = {"voxel": grid.voxel, "shape": list(grid.shape), "blocks": blocks, "bytes": most, "tiles": len(parts)}


def _slices(blocks: NDArray[Any]) -> tuple[slice, ...]:
    return tuple(slice(int(low), int(high)) for low, high in blocks.T)


_NOTHING = np.zeros((1, 1), np.float32)
"""What stands in for a map that no voxel asks."""


def _may_see(camera: Camera, window: Window, box: Bounds) -> bool:
    """Whether any of a box may fall on a camera's image or window; True where its corners do not tell."""
    z = camera.to_camera(corners(box))[:, 2]
    if z.min() <= 0:
        return bool(z.max() > 0)
    low, high = (f(camera.project(corners(box)), axis=0) for f in (np.min, np.max))
    first, last = np.minimum(window[:2], 0) - 1, np.maximum(window[2:], (camera.width - 1, camera.height - 1)) + 1
    return bool((low <= last).all() and (high >= first).all())


MARGIN = 4
"""Pixels around what a box covers that interpolation may read."""


def _rectangle(camera: Camera, box: Bounds) -> tuple[int, int, int, int]:
    """Columns and rows, ends excluded, of the pixels that a box may be seen in, one at least."""
    width, height = camera.width, camera.height
    if camera.to_camera(corners(box))[:, 2].min() <= 0:
        return 0, 0, width, height
    at, most = camera.project(corners(box)), np.array([width, height]) - 1
    low = (np.floor(at.min(0)) - MARGIN).clip(0, most).astype(int)
    high = (np.ceil(at.max(0)) + MARGIN).clip(0, most).astype(int)
    return int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1


def _part(values: NDArray[np.float32], x0: int, y0: int, x1: int, y1: int) -> NDArray[np.float32]:
    return np.ascontiguousarray(values[y0:y1, x0:x1])


def _distance(camera: Camera, inside: NDArray[np.float32], bounds: Bounds) -> float:
    """z-depth at which a view's depth weighs its confidence: the farther of the box's middle and the median depth in it.

    Where cameras look inwards that is the middle of what they look at; in rooms and streets the median, as the box begins at the camera.
    """
    return max(box_depth(camera, bounds), float(np.median(inside)) if len(inside) else 0.0)


def _weights(view: DepthMap, scale: float) -> NDArray[np.float32]:
    """Confidence times (scale / z)⁴, as σz grows with z²; the scale is the view's median depth inside the bounds, 0 with none."""
    if scale <= 0:  # nothing of it is fused
        return view.confidence
    # No depth is a distance of zero here: its weight is never asked for.
    nearer = np.clip(np.float32(scale) / np.maximum(view.depth, np.float32(1e-6 * scale)), 0.1, 2.0)
    np.square(nearer, out=nearer)
    np.square(nearer, out=nearer)
    return np.multiply(nearer, view.confidence, out=nearer)
