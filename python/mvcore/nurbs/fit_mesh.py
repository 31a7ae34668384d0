"""A target's surface as one NURBS surface: cross-sections along an axis, closed curves, skinned, refined until a tolerance holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ReconstructionError, require
from ..evaluation.metrics import sample_surface
from .checks import Array, floats
from .fit import approximate_rows, closed_fit, spaced_knots
from .surface import Surface

_SAMPLES = 4
"""Sections and points of a section for each control point."""
_WHOLE = 0.5
"""Share of a section's length that its largest loop must have to stand for it."""
_CAP = (0.0, 0.35, 0.7, 0.9)
"""Shares of the end sections that close the ends."""


@dataclass(frozen=True, eq=False)
class TargetFit:
    """What `fit_target` found.

    surface : closed in u, collapsed to a point at both ends of v.
    max_deviation, rms_deviation : from the target's points to the surface, in the target's units.
    control_points : how many. converged : whether the tolerance holds.
    ignored : share of the sections' length that lies in loops other than each section's largest, which one surface cannot follow.
    """

    surface: Surface
    max_deviation: float
    rms_deviation: float
    control_points: int
    converged: bool
    ignored: float


def fit_target(
    target: Any,
    tolerance: float,
    *,
    axis: ArrayLike | None = None,
    max_control_points: int = 40_000,
    degree: int = 3,
    samples: int = 20_000,
) -> TargetFit:
    """One closed NURBS surface fitted to a mesh or a point cloud (paper section 2.2; Piegl and Tiller section 10.3).

    Parameters
    ----------
    target : a trimesh.Trimesh, a `Reconstruction` or anything else with ``vertices`` and ``faces``; or points (N, 3).
    tolerance : greatest deviation allowed, in the target's units.
    axis : direction across the sections; by default the target's longest principal axis.
    max_control_points : where refinement ends although the tolerance does not hold.
    samples : points of the target at which the deviation is measured, besides a mesh's vertices.

    A section that falls into several loops is followed along its largest one: wheels, handles and holes stay outside the surface, and
    the reported deviation tells. Raises `ReconstructionError` where the target has no closed section.
    """
    require(np.isfinite(tolerance) and tolerance > 0, "tolerance", "a positive value", tolerance)
    require(max_control_points >= 64, "max_control_points", "at least 64", max_control_points)
    vertices, faces = _target(target)
    frame = _frame(vertices, axis)
    middle = vertices.mean(0)
    local = (vertices - middle) @ frame.T
    wanted = sample_surface((vertices, None), samples)
    if faces is not None:
        wanted = np.concatenate([wanted, sample_surface((vertices, faces.astype(np.uint32)), samples)])
    count_u, count_v = 12, 8
    best: TargetFit | None = None
    while count_u * count_v <= max_control_points:
        loops, ignored = _sections(local, faces, _SAMPLES * count_v, _SAMPLES * count_u)
        surface = _skinned(loops @ frame + middle, count_u, count_v, degree)
        distance = surface.closest_point(wanted)[3]
        size = surface.control_points.shape[0] * surface.control_points.shape[1]
        rms, greatest = float(np.sqrt((distance**2).mean())), float(distance.max())
        found = TargetFit(surface, greatest, rms, size, greatest <= tolerance, ignored)
        if best is None or greatest < best.max_deviation:
            best = found
        if found.converged:
            return found
        # The finer of the two spacings waits for the other.
        around, along = _spacing(loops)
        if around / count_u >= along / count_v:
            count_u = int(count_u * 1.5)
        else:
            count_v = int(count_v * 1.5)
    assert best is not None
    return best


def _target(target: Any) -> tuple[Array, NDArray[np.int64] | None]:
    target = getattr(target, "mesh", target)
    if hasattr(target, "vertices") and hasattr(target, "faces"):
        vertices, faces = floats(target.vertices, "target.vertices", 2), np.asarray(target.faces, np.int64)
        require(len(faces) > 0 and faces.shape[1:] == (3,), "target.faces", "triangles", faces.shape)
        require(faces.min() >= 0 and faces.max() < len(vertices), "target.faces", f"numbers below {len(vertices)}", faces.max())
        # Where a texture's seam runs a mesh has two vertices in one place; sections must run on.
        vertices, joined = np.unique(vertices, axis=0, return_inverse=True)
        faces = joined.reshape(-1)[faces]
    else:
        vertices, faces = floats(target, "target", 2), None
    require(vertices.shape[1] == 3 and len(vertices) >= 16, "target", "at least 16 points of three coordinates", vertices.shape)
    return vertices, faces


def _frame(vertices: Array, axis: ArrayLike | None) -> Array:
    """Rows: two directions in the sections' plane, then the axis."""
    if axis is None:
        values, vectors = np.linalg.eigh(np.cov(vertices.T))
        z = vectors[:, values.argmax()]
        z = z * np.sign(z[np.abs(z).argmax()])
    else:
        z = floats(axis, "axis", 1)
        require(z.shape == (3,) and np.linalg.norm(z) > 0, "axis", "a non-zero 3-vector", z)
        z = z / np.linalg.norm(z)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _sections(local: Array, faces: NDArray[np.int64] | None, count: int, points: int) -> tuple[Array, float]:
    """(rows, points, 3) loops along the axis, the first and last collapsed, and the share of length ignored."""
    low, high = local[:, 2].min(), local[:, 2].max()
    # Closer together towards the ends, where a rounded target's sections change fastest.
    share = (1 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2
    heights = low + (high - low) * share
    loops, kept, total = [], 0.0, 0.0
    if faces is not None:
        least, most = (f(local[faces, 2], 1) for f in (np.min, np.max))
    for z in heights:
        if faces is None:
            loop, own, every = _slab(local, z, (high - low) / count)
        else:
            loop, own, every = _largest_loop(local, faces[(least <= z) & (z < most)], z)
        total, kept = total + every, kept + own
        if loop is not None:
            loops.append(np.column_stack([_resampled(loop, points), np.full(points, z)]))
    if len(loops) < 4:
        raise ReconstructionError(f"the target has closed sections at {len(loops)} of {count} heights; at least 4 are needed")
    for n in range(1, len(loops)):
        loops[n] = _aligned(loops[n], loops[n - 1])
    ends = []
    for loop, z in ((loops[0], low), (loops[-1], high)):
        tip = local[np.abs(local[:, 2] - z) <= 1e-9 * (high - low) + 1e-12].mean(0)
        # A flat end keeps its outline: the cap is the end section drawn together, at the end's height.
        ends.append([np.column_stack([tip[:2] + k * (loop[:, :2] - tip[:2]), np.full(points, z)]) for k in _CAP])
    return np.stack([*ends[0], *loops, *reversed(ends[1])]), 1 - kept / max(total, 1e-300)


def _largest_loop(local: Array, cut: NDArray[np.int64], z: float) -> tuple[Array | None, float, float]:
    """The loop of greatest area in which the plane at height ``z`` cuts the mesh, by the faces that it cuts; its length and that of all.

    Where that is a minor part, as in an open mesh or among many parts, the outline of the whole section stands in.
    """
    above = local[:, 2] > z
    edges = np.stack([cut, np.roll(cut, -1, 1)], 2)
    crossing = above[edges[..., 0]] != above[edges[..., 1]]
    # Of a face's two crossing edges, the one entered first as the face runs round: from above to below, then from below to above.
    down = np.argmax(crossing & above[edges[..., 0]], 1)
    up = np.argmax(crossing & above[edges[..., 1]], 1)
    n = np.arange(len(cut))
    start, end = (np.sort(edges[n, k], 1) for k in (up, down))
    size = len(local)
    keys = np.concatenate([start[:, 0] * size + start[:, 1], end[:, 0] * size + end[:, 1]])
    distinct, number = np.unique(keys, return_inverse=True)
    a, b = distinct // size, distinct % size
    share = (z - local[a, 2]) / (local[b, 2] - local[a, 2])
    places = local[a, :2] + share[:, None] * (local[b, :2] - local[a, :2])
    follow = dict(zip(number[: len(cut)].tolist(), number[len(cut) :].tolist(), strict=True))
    best: Array | None = None
    best_area, own, every = 0.0, 0.0, 0.0
    while follow:
        first, at = follow.popitem()
        chain = [first]
        while at in follow:
            chain.append(at)
            at = follow.pop(at)
        loop = places[chain]
        length = float(np.linalg.norm(loop - np.roll(loop, 1, 0), axis=1).sum())
        every += length
        area = _area(loop)
        if len(chain) >= 3 and at == first and abs(area) > best_area:
            best, best_area, own = loop if area > 0 else loop[::-1], abs(area), length
    if own < _WHOLE * every:
        best = _outline(places, np.maximum) if len(places) >= 12 else None
    return best, own, every


def _area(loop: Array) -> float:
    x, y = loop.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def _slab(local: Array, z: float, thickness: float) -> tuple[Array | None, float, float]:
    """The outline of a cloud's points near height ``z``."""
    near = local[np.abs(local[:, 2] - z) <= thickness][:, :2]
    loop = _outline(near, np.add) if len(near) >= 12 else None
    return loop, float(loop is not None), 1.0


def _outline(points: Array, join: np.ufunc) -> Array | None:
    """A closed polyline about points (n, 2) by angle: in each sector their mean (``np.add``) or the farthest (``np.maximum``)."""
    middle = (points.min(0) + points.max(0)) / 2
    off = points - middle
    sectors = int(np.clip(len(points) // 4, 12, 360))
    sector = ((np.arctan2(off[:, 1], off[:, 0]) + np.pi) / (2 * np.pi) * sectors).astype(int) % sectors
    radius = np.zeros(sectors)
    join.at(radius, sector, np.linalg.norm(off, axis=1))
    count = np.bincount(sector, minlength=sectors)
    filled = np.flatnonzero(count)
    if len(filled) < sectors // 3:
        return None
    radius = radius[filled] / (count[filled] if join is np.add else 1)
    angle = (filled + 0.5) / sectors * 2 * np.pi - np.pi
    return np.asarray(middle + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1))


def _resampled(loop: Array, points: int) -> Array:
    """Evenly spaced points along a closed polyline, beginning where it crosses the ray from its middle along x."""
    closed = np.concatenate([loop, loop[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    off = closed[:-1] - loop.mean(0)
    start = length[np.abs(np.arctan2(off[:, 1], off[:, 0])).argmin()]
    at = (start + np.arange(points) / points * length[-1]) % length[-1]
    return np.stack([np.interp(at, length, closed[:, k]) for k in (0, 1)], 1)


def _aligned(loop: Array, before: Array) -> Array:
    """The loop begun where it lies nearest to the one before it, point by point."""
    a, b = (np.fft.fft(x[:, :2] - x[:, :2].mean(0), axis=0) for x in (loop, before))
    match = np.fft.ifft((a * b.conj()).sum(1)).real
    return np.roll(loop, -int(match.argmax()), 0)


def _spacing(loops: Array) -> tuple[float, float]:
    """Greatest length around a section, and the mean length along the rows."""
    around = np.linalg.norm(loops - np.roll(loops, 1, 1), axis=2).sum(1).max()
    along = np.linalg.norm(np.diff(loops, axis=0), axis=2).sum(0).mean()
    return float(around), float(along)


def _skinned(rows: Array, count_u: int, count_v: int, degree: int) -> Surface:
    """Closed curves fitted to the rows, then a fit across them."""
    u = np.arange(rows.shape[1]) / rows.shape[1]
    flat = rows.transpose(1, 0, 2).reshape(rows.shape[1], -1)
    around = closed_fit(u, flat, count_u, degree)
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=2).mean(1)
    v = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-9 * steps.sum()))])
    v /= v[-1]
    curves = np.asarray(around.control_points).reshape(-1, len(rows), 3)
    count_v = min(count_v + 2 * len(_CAP), len(rows))
    knots = spaced_knots(v, count_v, degree)
    net = approximate_rows(v, curves.transpose(1, 0, 2).reshape(len(rows), -1), knots, count_v)
    return Surface(net.reshape(count_v, -1, 3).transpose(1, 0, 2), around.knots, knots)
