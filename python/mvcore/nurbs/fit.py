"""Curves and surfaces through or near points (Piegl and Tiller chapter 9)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..errors import require
from .checks import Array, floats
from .curve import Curve
from .surface import Surface

Method = Literal["centripetal", "chord", "uniform"]


def spread_parameters(points: ArrayLike, method: Method = "centripetal") -> Array:
    """Parameters (n,) from 0 to 1 of points (n, dim) in order, by the root of their distances, the distances, or evenly (eqs 9.4-9.6)."""
    p = floats(points, "points", 2)
    require(method in ("centripetal", "chord", "uniform"), "method", "centripetal, chord or uniform", repr(method))
    require(len(p) >= 2, "points", "at least two points", len(p))
    power = {"centripetal": 0.5, "chord": 1.0, "uniform": 0.0}[method]
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    require((steps > 0).all() or power == 0, "points", "neighbours that differ", "two equal ones in a row")
    total = np.concatenate([[0.0], np.cumsum(steps**power)])
    return np.asarray(total / total[-1])


def averaged_knots(u: Array, degree: int) -> Array:
    """Clamped knots for interpolation at ``u``, each the mean of ``degree`` parameters (eq 9.8)."""
    inner = np.convolve(u[1:-1], np.ones(degree) / degree, "valid") if len(u) - 2 >= degree else np.empty(0)
    return np.concatenate([np.full(degree + 1, u[0]), inner, np.full(degree + 1, u[-1])])


def spaced_knots(u: Array, count: int, degree: int) -> Array:
    """Clamped knots for a fit of ``count`` control points: about as many parameters in each span (eqs 9.68-9.69)."""
    spans = count - degree
    place = np.arange(1, spans) * (len(u) / spans)
    i = place.astype(int)
    share = place - i
    inner = (1 - share) * u[i - 1] + share * u[np.minimum(i, len(u) - 1)]
    return np.concatenate([np.full(degree + 1, u[0]), inner, np.full(degree + 1, u[-1])])


def collocation(knots: Array, count: int, u: Array, order: int = 0) -> Array:
    """(len(u), count) values of derivative ``order`` of each basis function."""
    first, values = _core.nurbs_basis(knots, count, u, order)
    columns = values.shape[2]
    out = np.zeros((len(u), count))
    np.put_along_axis(out, first[:, None] + np.arange(columns), values[:, order], 1)
    return out


def gram(knots: Array, count: int, order: int) -> Array:
    """(count, count) integrals of products of derivatives ``order`` of the basis functions, exact (Gauss-Legendre a span)."""
    degree = len(knots) - count - 1
    x, w = np.polynomial.legendre.leggauss(degree + 1)
    breaks = np.unique(knots[degree : count + 1])
    half = np.diff(breaks)[:, None] / 2
    at = (breaks[:-1, None] + half + half * x).ravel()
    b = collocation(knots, count, at, order)
    return np.asarray(b.T @ (b * (half * w).ravel()[:, None]))


def interpolate_rows(u: Array, values: Array, knots: Array) -> Array:
    """Control rows (n, K) of the spline that takes ``values`` (n, K) at ``u`` (A9.1)."""
    return np.asarray(np.linalg.solve(collocation(knots, len(u), u), values), np.float64)


def approximate_rows(
    u: Array, values: Array, knots: Array, count: int, *, weights: Array | None = None, smoothing: float = 0.0, ends: bool = True
) -> Array:
    """Control rows (count, K) of the spline nearest to ``values`` (n, K) at ``u`` by least squares (A9.6 and its kin).

    ``ends``: the first and last value are met exactly. ``smoothing`` times the integral of the squared second derivative is added
    to the mean squared distance.
    """
    n = collocation(knots, count, u)
    w = np.ones(len(u)) if weights is None else weights
    matrix = n.T @ (n * (w / w.sum())[:, None])
    wanted = n.T @ (values * (w / w.sum())[:, None])
    if smoothing > 0:
        matrix = matrix + smoothing * gram(knots, count, 2)
    # A basis function without data would leave the matrix singular: such control points follow their neighbours.
    matrix = matrix + 1e-14 * np.trace(matrix) / count * gram_like(count)
    if not ends:
        return np.linalg.solve(matrix, wanted)
    out = np.empty((count, values.shape[1]))
    out[[0, -1]] = values[[0, -1]]
    out[1:-1] = np.linalg.solve(matrix[1:-1, 1:-1], wanted[1:-1] - matrix[1:-1, [0, -1]] @ out[[0, -1]])
    return out


def gram_like(count: int) -> Array:
    """(count, count) of squared second differences, with a touch of identity."""
    d = np.diff(np.eye(count), 2, axis=0)
    return d.T @ d + 1e-6 * np.eye(count)


def _degree(degree: int, count: int, name: str = "degree") -> int:
    require(isinstance(degree, (int, np.integer)) and 1 <= degree <= 15, name, "a whole number from 1 to 15", degree)
    require(count > degree, "points", f"more than {name} = {degree} points", count)
    return int(degree)


def _given(parameters: ArrayLike | None, points: Array, method: Method) -> Array:
    if parameters is None:
        return spread_parameters(points, method)
    u = floats(parameters, "parameters", 1)
    require(len(u) == len(points), "parameters", f"{len(points)} values", len(u))
    require((np.diff(u) > 0).all(), "parameters", "ascending values", "some that do not ascend")
    return u


def interpolate_curve(points: ArrayLike, degree: int = 3, *, parameters: ArrayLike | None = None, method: Method = "centripetal") -> Curve:
    """The spline curve through points (n, dim) in order (A9.1)."""
    p = floats(points, "points", 2)
    degree = _degree(degree, len(p))
    u = _given(parameters, p, method)
    knots = averaged_knots(u, degree)
    return Curve(interpolate_rows(u, p, knots), knots)


def approximate_curve(
    points: ArrayLike,
    count: int,
    degree: int = 3,
    *,
    parameters: ArrayLike | None = None,
    method: Method = "centripetal",
    weights: ArrayLike | None = None,
    smoothing: float = 0.0,
    closed: bool = False,
) -> Curve:
    """The spline curve of ``count`` control points nearest to points (n, dim) by least squares (A9.6, A9.7).

    weights : (n,) of the points, not negative. smoothing : of the second derivative, 0 for none. closed : a periodic curve, the last
    point joined to the first; else the curve begins at the first point and ends at the last, unless weights or smoothing say otherwise.
    """
    p = floats(points, "points", 2)
    degree = _degree(degree, count)
    require(len(p) >= count, "count", f"at most as many as points, {len(p)}", count)
    require(smoothing >= 0, "smoothing", "at least 0", smoothing)
    w = None
    if weights is not None:
        w = floats(weights, "weights", 1)
        require(len(w) == len(p) and (w >= 0).all() and w.sum() > 0, "weights", f"{len(p)} values, none negative", w.shape)
    if closed:
        loop = np.concatenate([p, p[:1]]) if parameters is None else p
        u = _given(parameters, loop, method)[: len(p)]
        return closed_fit(u, p, count, degree, w, smoothing)
    u = _given(parameters, p, method)
    knots = spaced_knots(u, count, degree)
    rows = approximate_rows(u, p, knots, count, weights=w, smoothing=smoothing, ends=w is None and smoothing == 0)
    return Curve(rows, knots)


def wrapping(count: int, degree: int) -> Array:
    """(count + degree, count) that repeats the first ``degree`` of ``count`` rows at the end."""
    return np.eye(count)[np.arange(count + degree) % count]


def periodic_knots(count: int, degree: int) -> Array:
    """Uniform knots of ``count + degree`` control points with the domain 0 .. 1."""
    return np.arange(-degree, count + degree + 1) / count


def closed_fit(u: Array, points: Array, count: int, degree: int, weights: Array | None = None, smoothing: float = 0.0) -> Curve:
    """The periodic curve of ``count`` control points over 0 .. 1 nearest to points at ``u``."""
    knots = periodic_knots(count, degree)
    wrap = wrapping(count, degree)
    n = collocation(knots, count + degree, u) @ wrap
    w = np.full(len(u), 1 / len(u)) if weights is None else weights / weights.sum()
    matrix = n.T @ (n * w[:, None]) + smoothing * (wrap.T @ gram(knots, count + degree, 2) @ wrap)
    d = np.roll(np.eye(count), 1, 0) - 2 * np.eye(count) + np.roll(np.eye(count), -1, 0)
    matrix += 1e-12 * np.trace(matrix) / count * (d.T @ d + 1e-3 * np.eye(count))
    return Curve(wrap @ np.linalg.solve(matrix, n.T @ (points * w[:, None])), knots)


def _grid_parameters(grid: Array, axis: int, method: Method) -> Array:
    """Means over the lines of a grid of points; lines of no length do not count (section 9.2.5)."""
    lines = np.moveaxis(grid, axis, 0)
    steps = np.linalg.norm(np.diff(lines, axis=0), axis=2) ** {"centripetal": 0.5, "chord": 1.0, "uniform": 0.0}[method]
    total = steps.sum(0)
    good = total > 1e-12 * max(total.max(), 1e-300)
    require(good.any(), "grid", "points that differ", "all points of each line equal")
    u = np.concatenate([[0.0], np.cumsum((steps[:, good] / total[good]).mean(1))])
    require((np.diff(u) > 0).all(), "grid", "neighbouring lines that differ", "two equal ones in a row")
    return np.asarray(u / u[-1])


def interpolate_surface(grid: ArrayLike, degree: tuple[int, int] = (3, 3), *, method: Method = "centripetal") -> Surface:
    """The spline surface through a grid of points (m, n, dim) (A9.4)."""
    g = floats(grid, "grid", 3)
    p, q = (_degree(d, n) for d, n in zip(degree, g.shape, strict=False))
    u, v = (_grid_parameters(g, axis, method) for axis in (0, 1))
    ku, kv = averaged_knots(u, p), averaged_knots(v, q)
    m, n, dim = g.shape
    rows = interpolate_rows(u, g.reshape(m, -1), ku).reshape(m, n, dim)
    columns = interpolate_rows(v, rows.transpose(1, 0, 2).reshape(n, -1), kv).reshape(n, m, dim)
    return Surface(columns.transpose(1, 0, 2), ku, kv)


def approximate_surface(
    grid: ArrayLike,
    counts: tuple[int, int],
    degree: tuple[int, int] = (3, 3),
    *,
    method: Method = "centripetal",
    weights: ArrayLike | None = None,
    smoothing: float = 0.0,
) -> Surface:
    """The spline surface of ``counts`` control points nearest to a grid of points (m, n, dim) by least squares (A9.7).

    weights : (m, n) of the points. With weights all unknowns are solved for at once (`fit_scattered`); without, direction by
    direction, the corners met exactly when there is no smoothing.
    """
    g = floats(grid, "grid", 3)
    p, q = (_degree(d, c) for d, c in zip(degree, counts, strict=True))
    require(counts[0] <= g.shape[0] and counts[1] <= g.shape[1], "counts", f"at most the grid's {g.shape[:2]}", counts)
    require(smoothing >= 0, "smoothing", "at least 0", smoothing)
    u, v = (_grid_parameters(g, axis, method) for axis in (0, 1))
    if weights is not None:
        w = floats(weights, "weights", 2)
        require(w.shape == g.shape[:2], "weights", f"shape {g.shape[:2]}", w.shape)
        uu, vv = np.meshgrid(u, v, indexing="ij")
        points = g.reshape(-1, g.shape[2])
        return fit_scattered(points, uu.ravel(), vv.ravel(), counts, (p, q), weights=w.ravel(), smoothing=smoothing)
    ku, kv = spaced_knots(u, counts[0], p), spaced_knots(v, counts[1], q)
    m, n, dim = g.shape
    ends = smoothing == 0
    rows = approximate_rows(u, g.reshape(m, -1), ku, counts[0], smoothing=smoothing, ends=ends).reshape(counts[0], n, dim)
    columns = rows.transpose(1, 0, 2).reshape(n, -1)
    control = approximate_rows(v, columns, kv, counts[1], smoothing=smoothing, ends=ends).reshape(counts[1], counts[0], dim)
    return Surface(control.transpose(1, 0, 2), ku, kv)


def fit_scattered(
    points: ArrayLike,
    u: ArrayLike,
    v: ArrayLike,
    counts: tuple[int, int],
    degree: tuple[int, int] = (3, 3),
    *,
    weights: ArrayLike | None = None,
    smoothing: float = 1e-9,
    knots: tuple[ArrayLike, ArrayLike] | None = None,
) -> Surface:
    """The spline surface of ``counts`` control points nearest to points (N, dim) with parameters u, v (N,), by least squares.

    Uniform clamped knots over the parameters' range unless given. ``smoothing`` times the thin-plate energy joins the mean squared
    distance, parameters taken over 0 .. 1; it also settles what no point tells. Solved by conjugate gradients on the evaluation
    kernel and its adjoint: no matrix is made.
    """
    p = floats(points, "points", 2)
    us, vs = floats(u, "u", 1), floats(v, "v", 1)
    require(len(us) == len(vs) == len(p) > 0, "u, v", f"{len(p)} values each, at least one", (len(us), len(vs)))
    require(smoothing >= 0, "smoothing", "at least 0", smoothing)
    w = np.ones(len(p)) if weights is None else floats(weights, "weights", 1)
    require(len(w) == len(p) and (w >= 0).all() and w.sum() > 0, "weights", f"{len(p)} values, none negative", w.shape)
    w = (w / w.sum())[:, None]
    degrees = tuple(_degree(d, c) for d, c in zip(degree, counts, strict=True))
    if knots is None:
        ku, kv = (_uniform(x, c, d, name) for x, c, d, name in zip((us, vs), counts, degrees, ("u", "v"), strict=True))
    else:
        ku, kv = floats(knots[0], "knots_u", 1), floats(knots[1], "knots_v", 1)
    lengths = [k[-d - 1] - k[d] for k, d in zip((ku, kv), degrees, strict=True)]
    grams = [[gram(k, c, o) * length ** (2 * o - 1) for o in range(3)] for k, c, length in zip((ku, kv), counts, lengths, strict=True)]

    def energy(net: Array) -> Array:
        terms = ((2, 0, 1.0), (1, 1, 2.0), (0, 2, 1.0))
        parts = [f * np.einsum("ij,jkd,kl->ild", grams[0][a], net, grams[1][b], optimize=True) for a, b, f in terms]
        return np.asarray(sum(parts))

    def normal(net: Array) -> Array:
        at = _core.nurbs_surface_partials(np.ascontiguousarray(net), (ku, kv), us, vs, [(0, 0)])[0]
        back = _core.nurbs_control_gradient((ku, kv), counts, us, vs, np.ascontiguousarray(at * w), (0, 0))
        return back + smoothing * energy(net)

    wanted = _core.nurbs_control_gradient((ku, kv), counts, us, vs, np.ascontiguousarray(p * w), (0, 0))
    mass = _core.nurbs_control_gradient((ku, kv), counts, us, vs, np.ascontiguousarray(w), (0, 0))
    stiff = sum(f * np.outer(np.diag(grams[0][a]), np.diag(grams[1][b])) for a, b, f in ((2, 0, 1.0), (1, 1, 2.0), (0, 2, 1.0)))
    scale = mass + smoothing * np.asarray(stiff)[..., None]
    start = np.broadcast_to((p * w).sum(0), (*counts, p.shape[1])).copy()
    return Surface(_conjugate_gradients(normal, wanted, np.maximum(scale, 1e-12 * scale.max()), start), ku, kv)


def _uniform(u: Array, count: int, degree: int, name: str) -> Array:
    low, high = float(u.min()), float(u.max())
    require(low < high, name, "values that differ", "all the same")
    inner = np.linspace(low, high, count - degree + 1)
    return np.concatenate([np.full(degree, low), inner, np.full(degree, high)])


def _conjugate_gradients(apply, wanted: Array, scale: Array, start: Array, most: int = 1000) -> Array:  # type: ignore[no-untyped-def]
    """Solves apply(x) = wanted for each coordinate, preconditioned by the diagonal ``scale``."""

    def dot(a: Array, b: Array) -> Array:
        return np.asarray((a * b).sum((0, 1)))

    x = start
    r = wanted - apply(x)
    z = r / scale
    d = z
    rz = dot(r, z)
    first = np.maximum(dot(wanted, wanted / scale), 1e-300)
    for _ in range(most):
        if (rz <= 1e-26 * first).all():
            break
        a = apply(d)
        alpha = rz / np.maximum(dot(d, a), 1e-300)
        x = x + alpha * d
        r = r - alpha * a
        z = r / scale
        rz, before = dot(r, z), np.maximum(rz, 1e-300)
        d = z + (rz / before) * d
    return x
