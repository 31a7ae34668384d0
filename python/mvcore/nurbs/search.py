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


def descend(
    cost: Callable[[Array], Array], at: Array, step: Array, best: Array, domain: list[tuple[float, float]], closed: list[bool]
) -> tuple[Array, Array, float]:
    """One damped step of many independent minimisations: shortened where the cost would rise; the greatest move comes back too.

    Along a closed parameter a step goes on at the other end of the domain; along an open one it ends there.
    """
    low, high = np.array(domain).T
    round_again = np.array(closed)
    moved = np.zeros(len(at))
    waiting = np.ones(len(at), bool)
    for _ in range(8):
        trial = np.where(waiting[:, None], at + step, at)
        trial = np.where(round_again, low + (trial - low) % (high - low), trial).clip(low, high)
        value = cost(trial)
        better = waiting & (value < best)
        moved[better] = np.abs(step)[better].max(1)
        at, best = np.where(better[:, None], trial, at), np.where(better, value, best)
        waiting &= ~better
        step = step / 4
        if not waiting.any():
            break
    return at, best, float(moved.max(initial=0.0))


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
