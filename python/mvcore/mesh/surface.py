"""From the field to a clean mesh: Marching Cubes, small parts, smoothing, decimation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import SurfaceConfig
from ..errors import ReconstructionError, require
from ..geometry.cameras import Camera
from ..volume.tsdf import SIDE, Volume

Float = NDArray[np.float64]
Faces = NDArray[np.uint32]


@dataclass(frozen=True)
class Surface:
    """vertices : (V, 3) float64, world. faces : (F, 3) uint32, counter-clockwise from outside."""

    vertices: Float
    faces: Faces


def marching_cubes(values: NDArray[np.float32], level: float = 0.0) -> tuple[NDArray[np.float32], Faces]:
    """Isosurface of a dense volume.

    Parameters
    ----------
    values : (nx, ny, nz) float32, C order; below ``level`` is inside, NaN is unknown.

    Returns
    -------
    vertices : (V, 3) float32 in sample coordinates. faces : (F, 3) uint32, counter-clockwise from outside.

    Examples
    --------
    >>> x, y, z = np.mgrid[-9:10, -9:10, -9:10].astype(np.float32)
    >>> vertices, faces = marching_cubes(np.sqrt(x**2 + y**2 + z**2) - 6.3)
    >>> len(vertices) - len(faces) // 2
    2
    """
    values = np.asarray(values)
    require(values.ndim == 3, "values", "shape (nx, ny, nz)", values.shape)
    shifted = np.ascontiguousarray(values if level == 0 else values - np.float32(level), np.float32)
    return _core.isosurface_dense(shifted)


def isosurface(volume: Volume | Iterable[Volume], decimation: float = 0.0) -> Surface:
    """The surface of a block-sparse field in world coordinates; parts of one (`mvcore.volume.tsdf.fuse_tiles`) are joined.

    Vertices on a layer that two parts share are equal to the bit in both, and become one.

    Parameters
    ----------
    decimation : voxels by which the inside of each part's surface may move to have fewer faces (`decimate`); borders stay.
    """
    points, faces, count = [], [], 0
    grid: Volume | None = None
    for part in [volume] if isinstance(volume, Volume) else volume:
        p, f = _core.isosurface_sparse(part.coords, part.values)
        grid = replace(part, coords=part.coords[:0], values=part.values[:0])
        del part
        if decimation:
            wide, f = _used(*_core.decimate(p.astype(np.float64), f, decimation, keep_borders=True))
            p = wide.astype(np.float32)
        points.append(p)
        f += np.uint32(count)
        faces.append(f)
        count += len(p)
    require(grid is not None, "volume", "one part or more", "none")
    assert grid is not None
    vertices, triangles = (points[0], faces[0]) if len(points) == 1 else _joined(np.concatenate(points), faces)
    del points, faces
    world = vertices.astype(np.float64)
    world *= grid.voxel
    world += grid.origin
    return Surface(world, triangles)


def _joined(vertices: NDArray[np.float32], faces: list[Faces]) -> tuple[NDArray[np.float32], Faces]:
    """One vertex where parts have one each: vertices of a single part never coincide."""
    shared = np.flatnonzero((vertices % SIDE == 0).any(1))
    rows = np.ascontiguousarray(vertices[shared]).view(np.dtype((np.void, 12))).ravel()
    _, first, number = np.unique(rows, return_index=True, return_inverse=True)
    owner = np.arange(len(vertices), dtype=np.uint32)
    owner[shared] = shared[first[number]]
    for n, part in enumerate(faces):
        faces[n] = _renumbered(owner, part)
    return _used(vertices, np.concatenate(faces))


CHUNK = 1 << 18
"""Faces whose vertices are looked up at a time: NumPy makes indices of eight bytes of them."""


def _renumbered(number: NDArray[np.uint32], faces: Faces) -> Faces:
    out = np.empty_like(faces)
    for n in range(0, len(faces), CHUNK):
        out[n : n + CHUNK] = number[faces[n : n + CHUNK]]
    return out


def extract_surface(volume: Volume | Iterable[Volume], config: SurfaceConfig | None = None, solid: bool = False) -> Surface:
    """Isosurface of a field or its parts, then `cleaned`.

    Raises
    ------
    ReconstructionError
        The field has no surface.
    """
    parts = iter([volume] if isinstance(volume, Volume) else volume)
    first = next(parts, None)
    require(first is not None, "volume", "one part or more", "none")
    assert first is not None
    return cleaned(isosurface(chain([first], parts)), first.voxel, config, solid)


def cleaned(surface: Surface, voxel: float, config: SurfaceConfig | None = None, solid: bool = False) -> Surface:
    """Small parts dropped and small holes closed, then smoothed and decimated as configured.

    Parameters
    ----------
    voxel : of the field, world units.
    solid : the surface is closed (silhouettes were given): bubbles inside it are dropped too.

    Raises
    ------
    ReconstructionError
        There is no surface.
    """
    config = config or SurfaceConfig()
    if not len(surface.faces):
        raise ReconstructionError("the depth maps agree on no surface inside the bounds")
    if solid:
        surface = drop_cavities(surface)
    surface = drop_small_parts(surface, config.min_component)
    surface = close_holes(surface, config.close_holes)
    if config.smooth:
        surface = smooth(surface, config.smooth)
    return decimate(surface, config.decimation * voxel, config.max_faces)


def compact(vertices: Float, faces: Faces) -> Surface:
    """A surface of these faces alone, without the vertices that none of them has."""
    return Surface(*_used(vertices, faces))


def _used(vertices: NDArray[Any], faces: Faces) -> tuple[NDArray[Any], Faces]:
    """The vertices that faces have, and the faces with their new numbers."""
    used = np.zeros(len(vertices), bool)
    for n in range(0, len(faces), CHUNK):
        used[faces[n : n + CHUNK]] = True
    number = np.cumsum(used, dtype=np.uint32) - np.uint32(1)
    return vertices[used], _renumbered(number, faces)


def drop_small_parts(surface: Surface, share: float) -> Surface:
    """Drops connected parts of less than ``share`` times the area of the largest."""
    if share <= 0 or not len(surface.faces):
        return surface
    part = _core.components(surface.faces)
    size = np.bincount(part, _areas(surface))
    return compact(surface.vertices, surface.faces[size[part] >= share * size.max()])


def _areas(surface: Surface) -> Float:
    """(F,) in square world units."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    b -= a
    c -= a
    return np.asarray(0.5 * np.linalg.norm(np.cross(b, c), axis=1))


def close_holes(surface: Surface, most_edges: int) -> Surface:
    """Closes the holes of at most ``most_edges`` edges (1000 or fewer) by the least area, where the patch lies in the surface."""
    if most_edges < 3 or not len(surface.faces):
        return surface
    return Surface(surface.vertices, np.concatenate([surface.faces, _core.close_holes(surface.vertices, surface.faces, most_edges)]))


def drop_cavities(surface: Surface) -> Surface:
    """Drops closed parts that face inward (their signed volume is negative): no photograph sees into a bubble."""
    part = _core.components(surface.faces)
    a, b, c = (surface.vertices[surface.faces[:, k]] - surface.vertices.mean(0) for k in range(3))
    inward = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c))) <= 0
    some = np.nonzero(inward[part])[0]
    # An open part has no inside.
    inward[part[some[_at_border(surface.faces[some])]]] = False
    return compact(surface.vertices, surface.faces[~inward[part]])


def _at_border(faces: Faces) -> NDArray[np.bool_]:
    """Faces with an edge that no other face has, (f,) bool."""
    wide = faces.astype(np.int64)
    ends = np.sort(np.stack([wide, np.roll(wide, -1, 1)], -1).reshape(-1, 2), 1)
    _, first, count = np.unique(ends[:, 0] << 32 | ends[:, 1], return_index=True, return_counts=True)
    border = np.zeros(len(faces), bool)
    border[first[count == 1] // 3] = True
    return border


def drop_unseen(surface: Surface, cameras: Sequence[Camera], voxel: float, reach: float) -> Surface:
    """Drops faces that no camera sees and that lie farther than ``reach`` voxels from all that one sees.

    Where silhouettes bound a surface, nothing else says where it runs on the sides that no photograph shows. All of it stays if nothing
    is seen at all.

    Parameters
    ----------
    voxel : scale of the surface's detail, world units.
    reach : voxels; never less than one and a half pixel footprints, for faces finer than pixels lie between their rays.
    """
    seen = np.zeros(len(surface.vertices), bool)
    least = 0.0
    for camera in cameras:
        depth, face = _core.rasterize(surface.vertices, surface.faces, camera.projection, camera.width, camera.height)
        hit = face >= 0
        if hit.any():
            seen[surface.faces[face[hit]]] = True
            least = max(least, float(np.median(depth[hit])) / camera.K[0, 0])
    if not seen.any() or seen.all():
        return surface
    within = max(reach * voxel, 1.5 * least)
    distance, _ = _core.nearest(surface.vertices[~seen], surface.vertices[seen], within)
    seen[~seen] = np.isfinite(distance)
    return compact(surface.vertices, surface.faces[seen[surface.faces].any(1)])


def smooth(surface: Surface, rounds: int) -> Surface:
    """Taubin smoothing (λ 0.5, μ -0.53): noise goes, volume stays."""
    v, f = surface.vertices.copy(), surface.faces.astype(np.int64)
    edges = np.unique(np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), 1), axis=0)
    degree = np.bincount(edges.ravel(), minlength=len(v))[:, None].clip(1)
    for _ in range(rounds):
        for step in (0.5, -0.53):
            mean = np.stack(
                [
                    np.bincount(edges[:, 0], v[edges[:, 1], k], len(v)) + np.bincount(edges[:, 1], v[edges[:, 0], k], len(v))
                    for k in range(3)
                ],
                1,
            )
            v += step * (mean / degree - v)
    return Surface(v, surface.faces)


def decimate(surface: Surface, error: float = 0.0, max_faces: int | None = None) -> Surface:
    """Collapses edges by quadric errors (Garland and Heckbert, SIGGRAPH 1997).

    Parameters
    ----------
    error : world units by which the surface may move, as a root mean square over the faces that meet at an edge.
    max_faces : 4 or more, kept to whatever it moves; None sets no limit.

    Examples
    --------
    >>> x, y, z = np.mgrid[-9:10, -9:10, -9:10].astype(np.float32)
    >>> vertices, faces = marching_cubes(np.sqrt(x**2 + y**2 + z**2) - 6.3)
    >>> len(decimate(Surface(vertices.astype(float), faces), error=0.2).faces) < len(faces) / 2
    True
    """
    require(np.isfinite(error) and error >= 0, "error", "0 or more", error)
    require(max_faces is None or max_faces >= 4, "max_faces", "4 or more, or None", max_faces)
    vertices, faces = np.ascontiguousarray(surface.vertices), np.ascontiguousarray(surface.faces)
    limit = () if max_faces is None else (max_faces,)
    return compact(*_core.decimate(vertices, faces, error, *limit))
