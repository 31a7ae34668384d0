"""Searches over parameters: nearest points, damped descent, extremes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .. import _core

Array = NDArray[np.float64]


def subdivided(breaks: Array, pieces: int) -> Array:
    """Parameters that cut each interval of ``breaks`` into equal pieces, the breaks themselves left out."""
    inner = np.arange(1, pieces) / pieces
    return (breaks[:-1, None] + np.diff(breaks)[:, None] * inner).ravel()


def sampled(breaks: Array, pieces: int) -> Array:
    """The breaks and the parameters that cut each interval into pieces, ascending."""
    return np.sort(np.concatenate([breaks, subdivided(breaks, pieces)]))


def between(breaks: Array, pieces: int) -> Array:
    """Middles of the pieces that each interval of ``breaks`` is cut into: never on an edge, where a surface may be a point."""
    edges = sampled(breaks, pieces)
    return (edges[:-1] + edges[1:]) / 2


def nearest(points: Array, wanted: Array, size: int = 1 << 22) -> NDArray[np.int64]:
    """Number of the point nearest to each wanted one."""
    dim = points.shape[1]
    if dim <= 3:
        return _core.nearest(*(np.pad(x, ((0, 0), (0, 3 - dim))) for x in (wanted, points)))[1]
    found = np.empty(len(wanted), np.int64)
    squares = (points**2).sum(1)
    step = max(1, size // max(1, len(points)))
    for k in range(0, len(wanted), step):
        found[k : k + step] = (squares - 2 * wanted[k : k + step] @ points.T).argmin(1)
    return found


def creases(knots: Array, degree: int) -> Array:
    """The ends of the domain and the knots between them at which the tangent may jump."""
    low, high = knots[degree], knots[-degree - 1]
    values, times = np.unique(knots, return_counts=True)
    return np.concatenate([[low], values[(times >= degree) & (values > low) & (values < high)], [high]])


Jets = Callable[[Array], tuple[Array, Array, Array]]
"""Parameters (N, d) to points (N, dim), first derivatives (N, d, dim) and second ones (N, d, d, dim)."""


def project(jets: Jets, evaluate: Callable[[Array], Array], wanted: Array, at: Array, edges: list[Array], closed: list[bool]) -> Array:
    """Parameters (N, d) of the points nearest to ``wanted`` (N, dim), from starts ``at`` (N, d): inversion, section 6.1.

    Newton within the smooth piece of the shape that a start lies in; ``edges`` are the pieces' ends along each parameter. What ends on
    a piece's edge is tried in the piece beyond, round the seam where ``closed``.
    """
    piece = np.stack([np.clip(np.searchsorted(e, x, "right") - 1, 0, len(e) - 2) for e, x in zip(edges, at.T, strict=True)], 1)

    def bounds(of: NDArray[np.intp]) -> tuple[Array, Array]:
        low = np.stack([e[k] for e, k in zip(edges, of.T, strict=True)], 1)
        high = np.stack([e[k + 1] for e, k in zip(edges, of.T, strict=True)], 1)
        # Derivatives at an inner edge are those of the piece after it: the piece before ends just short of it.
        last = np.array([len(e) - 2 for e in edges])
        return low, np.where(of == last, high, np.nextafter(high, low))

    at, best = _newton(jets, evaluate, wanted, at, *bounds(piece))
    active = np.arange(len(at))
    for _ in range(8):
        improved: list[NDArray[np.intp]] = []
        for k, e in enumerate(edges):
            for side in (-1, 1):
                low, high = bounds(piece[active])
                there = at[active, k] <= low[:, k] if side < 0 else at[active, k] >= high[:, k]
                beyond = piece[active, k] + side
                there &= closed[k] | ((beyond >= 0) & (beyond < len(e) - 1))
                some = active[there]
                next_piece, start = piece[some].copy(), at[some].copy()
                next_piece[:, k] = beyond[there] % (len(e) - 1)
                low, high = bounds(next_piece)
                start[:, k] = high[:, k] if side < 0 else low[:, k]
                found, value = _newton(jets, evaluate, wanted[some], start, low, high)
                better = value < best[some]
                some = some[better]
                at[some], best[some], piece[some] = found[better], value[better], next_piece[better]
                improved.append(some)
        active = np.unique(np.concatenate(improved))
        if not len(active):
            break
    return at


def _newton(jets: Jets, evaluate: Callable[[Array], Array], wanted: Array, at: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Parameters and square distances of the nearest points within boxes of parameters (N, d): damped Newton steps."""
    at = at.clip(low, high)
    best = ((evaluate(at) - wanted) ** 2).sum(1)
    axes = np.arange(at.shape[1])
    for _ in range(60 if len(at) else 0):
        points, first, second = jets(at)
        off = points - wanted
        slope = np.einsum("nid,nd->ni", first, off)
        metric = np.einsum("nid,njd->nij", first, first)
        hessian = metric + np.einsum("nijd,nd->nij", second, off)
        # Newton where the Hessian is safely positive, Gauss-Newton elsewhere; on a box's edge only free parameters move.
        safe = (hessian[:, 0, 0] > 1e-3 * metric[:, 0, 0]) & (np.linalg.det(hessian) > 1e-3 * np.linalg.det(metric))
        hessian = np.where(safe[:, None, None], hessian, metric)
        held = ((at <= low) & (slope > 0)) | ((at >= high) & (slope < 0))
        hessian = np.where(held[:, :, None] | held[:, None, :], 0.0, hessian)
        size = np.einsum("nii->n", metric)[:, None] + 1e-300
        hessian[:, axes, axes] += np.where(held, 1.0, 1e-14 * size)
        step = -np.linalg.solve(hessian, np.where(held, 0.0, slope)[..., None])[..., 0]
        waiting, moved = np.ones(len(at), bool), 0.0
        for _ in range(8):
            trial = np.where(waiting[:, None], at + step, at).clip(low, high)
            value = ((evaluate(trial) - wanted) ** 2).sum(1)
            better = waiting & (value < best)
            moved = max(moved, float(np.abs(trial - at)[better].max(initial=0.0)))
            at, best = np.where(better[:, None], trial, at), np.where(better, value, best)
            waiting &= ~better
            if not waiting.any():
                break
            step = step / 4
        if moved <= 1e-15 * float((high - low).max()):
            break
    return at, best


def extremes(evaluate: Callable[[Array], Array], axes: list[Array]) -> Array:
    """Least and greatest coordinates over a box of parameters: the best of a grid, then ever smaller grids around them."""
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))
    values = evaluate(grid)
    low, high = np.array([a[0] for a in axes]), np.array([a[-1] for a in axes])
    spread = np.array([np.diff(a).max() for a in axes])
    around = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * len(axes), indexing="ij"), -1).reshape(-1, len(axes))
    out = np.empty((2, values.shape[1]))
    for row, sign in enumerate((1.0, -1.0)):
        for k in range(values.shape[1]):
            at = grid[np.argsort(sign * values[:, k])[:8]]
            size = spread
            for _ in range(40):
                trial = (at[:, None] + around * size).clip(low, high)
                height = sign * evaluate(trial.reshape(-1, len(axes)))[:, k].reshape(len(at), -1)
                at = np.take_along_axis(trial, height.argmin(1)[:, None, None], 1)[:, 0]
                size = size / 2
            out[row, k] = sign * height.min()
    return out
