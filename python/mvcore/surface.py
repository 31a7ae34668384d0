"""From the field to a clean mesh: Marching Cubes, small parts, smoothing, decimation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import _core
from .config import SurfaceConfig
from .errors import ReconstructionError, require
from .volume import Volume

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


def isosurface(volume: Volume) -> Surface:
    """The surface of a block-sparse field in world coordinates."""
    vertices, faces = _core.isosurface_sparse(list(volume.blocks), volume.coords, volume.values)
    return Surface(volume.origin + volume.voxel * vertices.astype(np.float64), faces)


def extract_surface(volume: Volume, config: SurfaceConfig | None = None, solid: bool = False) -> Surface:
    """Isosurface, small parts dropped, then smoothed and decimated as configured.

    ``solid`` says that the field is closed (silhouettes were given): bubbles inside it are dropped too.

    Raises
    ------
    ReconstructionError
        The field has no surface.
    """
    config = config or SurfaceConfig()
    surface = isosurface(volume)
    if not len(surface.faces):
        raise ReconstructionError("the depth maps agree on no surface inside the bounds")
    if solid:
        surface = drop_cavities(surface)
    surface = drop_small_parts(surface, config.min_component)
    if config.smooth:
        surface = smooth(surface, config.smooth)
    if config.max_faces is not None and len(surface.faces) > config.max_faces:
        surface = decimate(surface, config.max_faces)
    return surface


def _compact(vertices: Float, faces: Faces) -> Surface:
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.uint32) - 1
    return Surface(vertices[used], number[faces].astype(np.uint32))


def drop_small_parts(surface: Surface, share: float) -> Surface:
    """Drops connected parts with fewer than ``share`` times the faces of the largest."""
    if share <= 0 or not len(surface.faces):
        return surface
    part = _core.components(surface.faces)
    size = np.bincount(part)
    return _compact(surface.vertices, surface.faces[size[part] >= share * size.max()])


def drop_cavities(surface: Surface) -> Surface:
    """Drops closed parts that face inward (their signed volume is negative): no photograph sees into a bubble."""
    part = _core.components(surface.faces)
    a, b, c = (surface.vertices[surface.faces[:, k]] - surface.vertices.mean(0) for k in range(3))
    volume = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)))
    return _compact(surface.vertices, surface.faces[volume[part] > 0])


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


def decimate(surface: Surface, max_faces: int) -> Surface:
    """Quadric-error decimation to about ``max_faces`` faces (fast-simplification)."""
    import fast_simplification

    require(max_faces >= 4, "max_faces", "at least 4", max_faces)
    # The library works in float32: centred and scaled, nothing of the position is lost.
    center = surface.vertices.mean(0)
    scale = np.abs(surface.vertices - center).max()
    points = ((surface.vertices - center) / scale).astype(np.float32)
    v, f = fast_simplification.simplify(points, surface.faces.astype(np.int32), target_count=max_faces)
    return _compact(v.astype(np.float64) * scale + center, f.astype(np.uint32))
