"""Surfaces and curves as meshes, OBJ free-form geometry and STEP files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import require
from .checks import Array
from .curve import Curve
from .search import subdivided
from .surface import Surface

if TYPE_CHECKING:
    import trimesh

Shape = Curve | Surface

MOST_PIECES = 4096
"""Chords of a span along an axis."""


def tessellate(surface: Surface, tolerance: float, *, max_vertices: int = 4_000_000) -> tuple[Array, NDArray[np.int64], Array]:
    """Vertices (N, dim), triangles (F, 3) and parameters (N, 2) of a mesh nowhere farther than ``tolerance`` from the surface.

    Each span is cut as finely as its second derivatives ask for, then lines are added where the surface still leaves the middle of an
    edge or cell by more than the tolerance. Counter-clockwise about S_u x S_v. Edges that meet, and poles, share vertices.
    """
    require(np.isfinite(tolerance) and tolerance > 0, "tolerance", "a positive value", tolerance)
    axes = [_estimated(surface, d, tolerance) for d in (0, 1)]
    for _ in range(12):
        require(len(axes[0]) * len(axes[1]) <= max_vertices, "tolerance", f"one that {max_vertices} vertices can hold", tolerance)
        halves = [_too_coarse(surface, axes, d, tolerance) for d in (0, 1)]
        if not any(len(h) for h in halves):
            break
        axes = [np.sort(np.concatenate([a, h])) for a, h in zip(axes, halves, strict=True)]
    grid = surface.evaluate_grid(*axes)
    m, n, dim = grid.shape
    number = np.arange(m * n).reshape(m, n)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    points = grid.reshape(-1, dim)
    merged = _merged(points, (m, n), tolerance)
    faces = merged[faces]
    good = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    used, compact = np.unique(faces[good], return_inverse=True)
    at = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    return points[used], compact.reshape(-1, 3), at[used]


def to_mesh(surface: Surface, tolerance: float) -> trimesh.Trimesh:
    """A mesh nowhere farther than ``tolerance`` from a surface in space; vertex normals are the surface's own."""
    import trimesh

    require(surface.control_points.shape[2] == 3, "surface", "three coordinates", surface.control_points.shape[2])
    vertices, faces, at = tessellate(surface, tolerance)
    return trimesh.Trimesh(vertices, faces, vertex_normals=surface.normal(at[:, 0], at[:, 1]), process=False)


def _estimated(surface: Surface, axis: int, tolerance: float) -> Array:
    """Parameters along an axis so that chords stay within a third of the tolerance: h² |S''| / 8 a span."""
    breaks = surface.breaks
    own, p = breaks[axis], surface.degree[axis]
    inner = np.linspace(0, 1, 2 * p + 1)
    along = own[:-1, None] + np.diff(own)[:, None] * inner
    other = breaks[1 - axis]
    across = np.sort(np.concatenate([other, subdivided(other, 3)]))
    pair = (along.ravel(), across) if axis == 0 else (across, along.ravel())
    second = surface.derivatives_grid(pair[0], pair[1], 2)[(2, 0) if axis == 0 else (0, 2)]
    second = np.linalg.norm(second, axis=2)
    worst = (second.max(1) if axis == 0 else second.max(0)).reshape(along.shape).max(1)
    with np.errstate(over="ignore", invalid="ignore"):
        wanted = np.ceil(np.diff(own) * np.sqrt(worst * 3 / (8 * tolerance)))
    pieces = np.nan_to_num(wanted, nan=MOST_PIECES).clip(1, MOST_PIECES).astype(int)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(own[:-1], own[1:], pieces, strict=True)]
    return np.concatenate([*parts, own[-1:]])


def _too_coarse(surface: Surface, axes: list[Array], axis: int, tolerance: float) -> Array:
    """Middles of the intervals along an axis whose edges, or cells, the surface leaves by more than the tolerance."""
    a = axes[axis]
    middle = (a[:-1] + a[1:]) / 2
    grid = surface.evaluate_grid(*axes)
    grid = grid if axis == 0 else grid.transpose(1, 0, 2)
    pair = (middle, axes[1]) if axis == 0 else (axes[0], middle)
    at = surface.evaluate_grid(*pair)
    at = at if axis == 0 else at.transpose(1, 0, 2)
    off = np.linalg.norm(at - (grid[:-1] + grid[1:]) / 2, axis=2).max(1)
    # The diagonal of each cell is an edge as well.
    other = axes[1 - axis]
    between = (other[:-1] + other[1:]) / 2
    pair = (middle, between) if axis == 0 else (between, middle)
    at = surface.evaluate_grid(*pair)
    at = at if axis == 0 else at.transpose(1, 0, 2)
    # S at the middle against the diagonal's; parts the two directions share are left to the one with the longer chord.
    twist = np.linalg.norm(at - (grid[:-1, :-1] + grid[1:, 1:]) / 2, axis=2).max(1)
    return middle[(off > tolerance) | (twist > tolerance)]


def _merged(points: Array, shape: tuple[int, int], tolerance: float) -> NDArray[np.int64]:
    """For each vertex of a grid the one it is joined to: along edges that meet and edges that are one point."""
    number = np.arange(len(points)).reshape(shape)
    out = np.arange(len(points))
    near = 1e-9 * max(1e-300, float(np.abs(points).max())) + 1e-6 * tolerance
    for first, last in ((number[0], number[-1]), (number[:, 0], number[:, -1])):
        if np.linalg.norm(points[first] - points[last], axis=1).max() <= near:
            out[last] = first
    for edge in (number[0], number[-1], number[:, 0], number[:, -1]):
        if np.linalg.norm(points[edge] - points[edge[0]], axis=1).max() <= near:
            out[edge] = edge[0]
    while (out[out] != out).any():
        out = out[out]
    return out
