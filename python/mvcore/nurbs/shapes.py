"""Exact conics and quadrics, and surfaces built from curves (Piegl and Tiller chapters 7, 8 and 10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..errors import require
from . import edit
from .checks import Array, floats, plain
from .curve import Curve
from .fit import averaged_knots, interpolate_rows
from .surface import Surface

_Z = (0.0, 0.0, 1.0)


def arc(
    start: float = 0.0,
    end: float = 2 * np.pi,
    radius: float = 1.0,
    *,
    center: ArrayLike = (0.0, 0.0, 0.0),
    x_axis: ArrayLike = (1.0, 0.0, 0.0),
    y_axis: ArrayLike = (0.0, 1.0, 0.0),
) -> Curve:
    """A circular arc from angle ``start`` to ``end`` in radians, in the plane of two axes, exact; degree 2 (A7.1).

    Axes of other lengths or at other angles give an arc of an ellipse. Two coordinates a vector give a plane curve.
    """
    c, x, y = (floats(a, name, 1) for a, name in ((center, "center"), (x_axis, "x_axis"), (y_axis, "y_axis")))
    require(len(c) == len(x) == len(y), "center", "as many coordinates as the axes", (len(c), len(x), len(y)))
    require(radius > 0, "radius", "a positive value", radius)
    sweep = end - start
    require(0 < sweep <= 2 * np.pi + 1e-12, "end", "an angle above start by at most 2 pi", sweep)
    count = int(np.ceil(sweep / (np.pi / 2) - 1e-9))
    half = sweep / count / 2
    angles = start + half * np.arange(2 * count + 1)
    lengths = np.where(np.arange(2 * count + 1) % 2, radius / np.cos(half), radius)
    weights = np.where(np.arange(2 * count + 1) % 2, np.cos(half), 1.0)
    cosine, sine = np.cos(angles), np.sin(angles)
    if abs(sweep - 2 * np.pi) < 1e-12:
        cosine[-1], sine[-1] = cosine[0], sine[0]
    control = c + lengths[:, None] * (cosine[:, None] * x + sine[:, None] * y)
    knots = np.concatenate([[0.0], np.repeat(np.arange(count + 1) / count, 2), [1.0]])
    return Curve(control, knots, weights)


def circle(
    radius: float = 1.0,
    *,
    center: ArrayLike = (0.0, 0.0, 0.0),
    x_axis: ArrayLike = (1.0, 0.0, 0.0),
    y_axis: ArrayLike = (0.0, 1.0, 0.0),
) -> Curve:
    """A full circle, nine control points."""
    return arc(0.0, 2 * np.pi, radius, center=center, x_axis=x_axis, y_axis=y_axis)


def ellipse(a: float, b: float, *, center: ArrayLike = (0.0, 0.0, 0.0)) -> Curve:
    """A full ellipse in the xy plane with semi-axes ``a`` along x and ``b`` along y."""
    require(a > 0 and b > 0, "a, b", "positive values", (a, b))
    c = floats(center, "center", 1)
    x, y = np.eye(len(c))[:2]
    return arc(center=c, x_axis=a * x, y_axis=b * y)


def revolve(curve: Curve, *, point: ArrayLike = (0.0, 0.0, 0.0), axis: ArrayLike = _Z, angle: float = 2 * np.pi) -> Surface:
    """The surface that a curve sweeps about an axis through ``point``; u goes round, v along the curve (A8.1)."""
    p, a = floats(point, "point", 1), floats(axis, "axis", 1)
    require(curve.control_points.shape[1] == 3, "curve", "three coordinates", curve.control_points.shape[1])
    size = np.linalg.norm(a)
    require(p.shape == a.shape == (3,) and size > 0, "axis", "a non-zero 3-vector", a)
    a = a / size
    turn = arc(0.0, angle, center=(0.0, 0.0), x_axis=(1.0, 0.0), y_axis=(0.0, 1.0))
    assert turn.weights is not None
    foot = p + ((curve.control_points - p) @ a)[:, None] * a
    x = curve.control_points - foot
    y = np.cross(a, x)
    control = foot + turn.control_points[:, None, :1] * x + turn.control_points[:, None, 1:] * y
    own = np.ones(len(curve.control_points)) if curve.weights is None else curve.weights
    return Surface(control, turn.knots, curve.knots, turn.weights[:, None] * own)


def sphere(radius: float = 1.0, *, center: ArrayLike = (0.0, 0.0, 0.0)) -> Surface:
    """A sphere; u is the longitude, v goes from the lower pole to the upper; normals point outwards."""
    c = floats(center, "center", 1)
    half = arc(-np.pi / 2, np.pi / 2, radius, center=c, x_axis=(1.0, 0.0, 0.0), y_axis=_Z)
    points = half.control_points.copy()
    points[[0, -1], :2] = c[:2]
    return revolve(Curve(points, half.knots, half.weights), point=c)


def torus(major: float, minor: float, *, center: ArrayLike = (0.0, 0.0, 0.0)) -> Surface:
    """A torus about z with a tube of radius ``minor`` whose middle is ``major`` from the axis; normals point outwards."""
    require(major > minor > 0, "minor", "positive and less than major", (major, minor))
    c = floats(center, "center", 1)
    tube = circle(minor, center=c + np.array([major, 0, 0]), y_axis=_Z)
    return revolve(tube, point=c)


def cylinder(radius: float = 1.0, height: float = 1.0, *, center: ArrayLike = (0.0, 0.0, 0.0)) -> Surface:
    """The side of a cylinder about z, standing on ``center``; normals point outwards."""
    require(height > 0, "height", "a positive value", height)
    return extrude(circle(radius, center=center), (0.0, 0.0, height))


def extrude(curve: Curve, vector: ArrayLike) -> Surface:
    """The surface that a curve sweeps along ``vector``; u runs along the curve."""
    d = floats(vector, "vector", 1)
    require(d.shape == curve.control_points.shape[1:], "vector", f"{curve.control_points.shape[1]} coordinates", d.shape)
    require(np.any(d != 0), "vector", "a non-zero vector", d)
    return ruled(curve, Curve(curve.control_points + d, curve.knots, curve.weights))


def compatible(curves: Sequence[Curve]) -> tuple[Array, Array, bool]:
    """Common knots over 0 .. 1 and homogeneous control points (count, n, dim) of curves brought to one degree."""
    require(len(curves) >= 1, "curves", "at least one curve", len(curves))
    dims = {c.control_points.shape[1] for c in curves}
    require(len(dims) == 1, "curves", "the same number of coordinates", sorted(dims))
    rational = any(c.weights is not None for c in curves)
    degree = max(c.degree for c in curves)
    shapes = []
    for curve in curves:
        weights = np.ones(len(curve.control_points)) if rational and curve.weights is None else curve.weights
        same = Curve(curve.control_points, curve.knots, weights).clamped()
        same = same.elevate_degree(degree - same.degree)
        low, high = same.domain
        knots = (same.knots - low) / (high - low)
        shapes.append((np.round(knots, 14), same.homogeneous))
    every = np.unique(np.concatenate([k for k, _ in shapes]))
    times = {u: max(edit.multiplicity(k, u) for k, _ in shapes) for u in every}
    rows = []
    for knots, points in shapes:
        new = [u for u in every for _ in range(times[u] - edit.multiplicity(knots, u))]
        knots, points = edit.insert(knots, points, np.array(new))
        rows.append(points)
    return knots, np.stack(rows), rational


def ruled(first: Curve, second: Curve) -> Surface:
    """Straight lines between points of two curves at the same share of their domains; u runs along them."""
    knots, points, rational = compatible([first, second])
    control, weights = plain(points.transpose(1, 0, 2), rational)
    return Surface(control, knots, np.array([0.0, 0.0, 1.0, 1.0]), weights)


def loft(curves: Sequence[Curve], degree: int = 3, parameters: ArrayLike | None = None) -> Surface:
    """A surface through all of ``curves``, skinned; u runs along them, v across (section 10.3).

    parameters : v of each curve, ascending from 0 to 1; by default from the mean distance between their control points.
    """
    require(len(curves) >= 2, "curves", "at least two curves", len(curves))
    require(degree >= 1, "degree", "at least 1", degree)
    degree = min(degree, len(curves) - 1)
    knots, points, rational = compatible(curves)
    if parameters is None:
        places = plain(points, rational)[0]
        steps = np.linalg.norm(np.diff(places, axis=0), axis=2).mean(1)
        require((steps > 0).all(), "curves", "curves that differ from their neighbours", "two equal ones")
        v = np.concatenate([[0.0], np.cumsum(steps) / steps.sum()])
    else:
        v = floats(parameters, "parameters", 1)
        require(len(v) == len(curves) and v[0] == 0 and v[-1] == 1, "parameters", f"{len(curves)} values from 0 to 1", v)
        require((np.diff(v) > 0).all(), "parameters", "ascending values", v)
    across = averaged_knots(v, degree)
    rows = interpolate_rows(v, points.reshape(len(points), -1), across)
    control, weights = plain(rows.reshape(points.shape).transpose(1, 0, 2), rational)
    require(weights is None or (weights > 0).all(), "curves", "weights that stay positive when skinned", "some that do not")
    return Surface(control, knots, across, weights)
