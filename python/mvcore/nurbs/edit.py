"""Changes of a spline's form that leave its shape alone: knot insertion, degree elevation, extraction, knot removal.

All act on ``rows``, (n, K) float64: the n control points of one direction, K values each (homogeneous coordinates, and for a surface
those of the whole other direction).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def multiplicity(knots: Array, u: float) -> int:
    """How often ``u`` stands in the knot vector."""
    return int(np.count_nonzero(knots == u))


def insert(knots: Array, rows: Array, new: Array) -> tuple[Array, Array]:
    """Knots and rows with the values ``new`` added (Boehm; A5.1, and A5.4 when there are several)."""
    p = len(knots) - len(rows) - 1
    for u in np.sort(np.asarray(new, np.float64)):
        k = int(np.searchsorted(knots, u, "right")) - 1
        s = multiplicity(knots, u)
        first, last = k - p + 1, k - s
        out = np.empty((len(rows) + 1, rows.shape[1]))
        out[:first] = rows[:first]
        out[last + 1 :] = rows[last:]
        i = np.arange(first, last + 1)
        alpha = ((u - knots[i]) / (knots[i + p] - knots[i]))[:, None]
        out[i] = alpha * rows[i] + (1 - alpha) * rows[i - 1]
        knots, rows = np.insert(knots, k + 1, u), out
    return knots, rows


def extract(knots: Array, rows: Array, a: float, b: float) -> tuple[Array, Array]:
    """The part of the spline over [a, b], clamped at both ends."""
    p = len(knots) - len(rows) - 1
    new = [u for u in (a, b) for _ in range(p - multiplicity(knots, u))]
    knots, rows = insert(knots, rows, np.array(new))
    first = int(np.searchsorted(knots, a, "right")) - 1 - p
    last = int(np.searchsorted(knots, b, "left")) - 1
    inner = knots[(knots > a) & (knots < b)]
    return np.concatenate([np.full(p + 1, a), inner, np.full(p + 1, b)]), rows[first : last + 1].copy()


def _blossom(knots: Array, rows: Array, span: int, arguments: Array) -> Array:
    """The polar form of the piece over ``span`` at ``degree`` arguments (de Boor's triangle, an argument a level)."""
    p = len(arguments)
    d = rows[span - p : span + 1].copy()
    for level, u in enumerate(arguments, 1):
        r = np.arange(level, p + 1)
        low, high = knots[span - p + r], knots[span + 1 + r - level]
        alpha = ((u - low) / (high - low))[:, None]
        d[level:] = (1 - alpha) * d[level - 1 : -1] + alpha * d[level:]
    return d[-1]


def elevate(knots: Array, rows: Array, times: int) -> tuple[Array, Array]:
    """The same shape with its degree ``times`` higher, clamped (what A5.9 computes).

    Control point i is the mean of the polar form over all ways to leave one of its knots out.
    """
    p = len(knots) - len(rows) - 1
    knots, rows = extract(knots, rows, knots[p], knots[-p - 1])
    for _ in range(times):
        p = len(knots) - len(rows) - 1
        distinct, counts = np.unique(knots, return_counts=True)
        raised = np.repeat(distinct, counts + 1)
        out = np.empty((len(raised) - p - 2, rows.shape[1]))
        for i in range(len(out)):
            own = raised[i + 1 : i + p + 2]
            low, high = raised[i], raised[i + p + 2]
            # Any piece within the point's support will do; the middle one keeps the affine combinations short.
            starts = np.flatnonzero((knots[:-1] < knots[1:]) & (knots[:-1] >= low) & (knots[1:] <= high))
            span = int(starts[len(starts) // 2])
            out[i] = sum(_blossom(knots, rows, span, np.delete(own, j)) for j in range(p + 1)) / (p + 1)
        knots, rows = raised, out
    return knots, rows


def _removal(knots: Array, rows: Array, last: int) -> tuple[float, Array, int]:
    """Least greatest move of a control point when the knot at index ``last`` goes, the new points, and the index of their first."""
    p = len(knots) - len(rows) - 1
    u = knots[last]
    s = multiplicity(knots, u) - 1
    rest = np.delete(knots, last)
    k = last - 1
    if s == p:
        # The spline jumps here: without the knot its two points are one.
        gap = rows[k - p + 1] - rows[k - p]
        return float(np.abs(gap).max()), rows[:0], int(k - p + 1)
    i = np.arange(k - p + 1, k - s + 1)
    alpha = (u - rest[i]) / (rest[i + p] - rest[i])
    # Row i of the present points is alpha Q_i + (1 - alpha) Q_(i-1); Q before and after the window are present points.
    unknown = len(i) - 1
    matrix = np.zeros((len(i), unknown + 2))
    matrix[np.arange(len(i)), np.arange(len(i))] = 1 - alpha
    matrix[np.arange(len(i)), np.arange(len(i)) + 1] = alpha
    ends = np.stack([rows[k - p], rows[k - s + 1]])
    wanted = rows[i] - matrix[:, [0, -1]] @ ends
    inner = matrix[:, 1:-1]
    found = np.linalg.lstsq(inner, wanted, rcond=None)[0] if unknown else np.zeros((0, rows.shape[1]))
    residual = wanted - inner @ found
    return float(np.abs(residual).max(initial=0.0)), found, int(k - p + 1)


def remove(knots: Array, rows: Array, tolerance: float, dim: int) -> tuple[Array, Array]:
    """Fewer knots, no point of the shape moved by more than ``tolerance`` in the rows' own coordinates (in place of A5.8).

    Always the knot whose removal costs least goes next. A spline moves no more than its control points, so the costs' sum bounds
    the deviation; ``dim`` coordinates make a point.
    """
    budget = tolerance / np.sqrt(dim)
    while True:
        p = len(knots) - len(rows) - 1
        inner = [i for i in range(p + 1, len(rows)) if knots[i] != knots[i + 1] and knots[i] > knots[p]]
        trials = [(*_removal(knots, rows, i), i) for i in inner]
        best = min(trials, key=lambda t: t[0], default=None)
        if best is None or best[0] > budget:
            return knots, rows
        cost, found, first, last = best
        rows = np.concatenate([rows[:first], found, rows[first + len(found) + 1 :]])
        knots, budget = np.delete(knots, last), budget - cost


def reverse(knots: Array, rows: Array) -> tuple[Array, Array]:
    """Run through backwards, over the same domain."""
    p = len(knots) - len(rows) - 1
    return (knots[p] + knots[-p - 1]) - knots[::-1], rows[::-1].copy()
