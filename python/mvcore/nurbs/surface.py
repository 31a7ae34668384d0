"""NURBS surfaces (paper eqs 23-31; Piegl and Tiller chapters 3-6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..errors import require
from . import edit
from .checks import (
    Array,
    Outside,
    affine,
    checked_insertion,
    checked_weights,
    floats,
    frozen,
    homogeneous,
    parameters,
    plain,
    removal_scale,
)
from .curve import Curve
from .search import between, creases, extremes, nearest, project, sampled, subdivided

Direction = Literal["u", "v"]
Edit = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class Surface:
    """A tensor-product B-spline or, with weights, a NURBS surface (eqs 23-24).

    Parameters
    ----------
    control_points : (m, n, dim), any dim; m along u, n along v.
    knots_u, knots_v : (m + degree_u + 1,), (n + degree_v + 1,) ascending; the degrees follow from the counts.
    weights : (m, n) positive, or none.

    Raises `InvalidInputError` naming the argument that does not fit.
    """

    control_points: Array
    knots_u: Array
    knots_v: Array
    weights: Array | None = None

    def __post_init__(self) -> None:
        control = floats(self.control_points, "control_points", 3)
        require(control.shape[2] >= 1, "control_points", "at least one coordinate", control.shape)
        u, v = floats(self.knots_u, "knots_u", 1), floats(self.knots_v, "knots_v", 1)
        w = checked_weights(self.weights, control.shape[:2])
        for name, value in (("control_points", control), ("knots_u", u), ("knots_v", v)):
            object.__setattr__(self, name, frozen(value))
        object.__setattr__(self, "weights", None if w is None else frozen(w))
        _core.nurbs_surface(control, (u, v), u[:0], u[:0], 0, False)

    @property
    def knots(self) -> tuple[Array, Array]:
        """Both knot vectors."""
        return self.knots_u, self.knots_v

    @property
    def degree(self) -> tuple[int, int]:
        """Degrees along u and v."""
        m, n = self.control_points.shape[:2]
        return len(self.knots_u) - m - 1, len(self.knots_v) - n - 1

    @property
    def domain(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """First and last parameter of u, and of v."""
        p, q = self.degree
        u, v = self.knots
        return (float(u[p]), float(u[-p - 1])), (float(v[q]), float(v[-q - 1]))

    @property
    def breaks(self) -> tuple[Array, Array]:
        """The distinct knots of u and of v within the domain, ends included."""
        pairs = zip(self.knots, self.domain, strict=True)
        return tuple(np.unique(k[(k >= low) & (k <= high)]) for k, (low, high) in pairs)  # type: ignore[return-value]

    @property
    def homogeneous(self) -> Array:
        """(m, n, dim + 1) points (w P, w), or (m, n, dim) without weights."""
        return homogeneous(self.control_points, self.weights)

    @property
    def is_closed(self) -> tuple[bool, bool]:
        """Whether, along u and along v, the last isoparametric curve is the first, to rounding."""
        grid = self.evaluate_grid(*(sampled(b, 2) for b in self.breaks))
        near = 1e-12 * np.abs(self.control_points).max()
        return bool(np.abs(grid[0] - grid[-1]).max() <= near), bool(np.abs(grid[:, 0] - grid[:, -1]).max() <= near)

    def evaluate(self, u: ArrayLike, v: ArrayLike, *, outside: Outside = "error") -> Array:
        """Points (N, dim) at N pairs of parameters (eq 23; A3.5, A4.3)."""
        return self.derivatives(u, v, 0, outside=outside)[0, 0]

    def derivatives(self, u: ArrayLike, v: ArrayLike, order: int = 2, *, outside: Outside = "error") -> Array:
        """(order + 1, order + 1, N, dim): entry [k, l] is differentiated k times along u and l along v (eqs 25-31; A3.6, A4.4).

        As in A3.6 the orders sum to at most ``order``; the other entries are zero.
        """
        require(order >= 0, "order", "at least 0", order)
        us, vs = (parameters(x, name, d, outside) for x, name, d in zip((u, v), "uv", self.domain, strict=True))
        if len(us) != len(vs):
            require(1 in (len(us), len(vs)), "v", f"as many values as u, {len(us)}", len(vs))
            us, vs = (np.ascontiguousarray(x) for x in np.broadcast_arrays(us, vs))
        return _core.nurbs_surface(self._net, self.knots, us, vs, order, self.weights is not None)

    def evaluate_grid(self, u: ArrayLike, v: ArrayLike, *, outside: Outside = "error") -> Array:
        """Points (len(u), len(v), dim) at all pairs of parameters."""
        return self.derivatives_grid(u, v, 0, outside=outside)[0, 0]

    def derivatives_grid(self, u: ArrayLike, v: ArrayLike, order: int = 2, *, outside: Outside = "error") -> Array:
        """(order + 1, order + 1, len(u), len(v), dim), as `derivatives`, at all pairs of parameters."""
        require(order >= 0, "order", "at least 0", order)
        us, vs = (parameters(x, name, d, outside) for x, name, d in zip((u, v), "uv", self.domain, strict=True))
        return _core.nurbs_surface_grid(self._net, self.knots, us, vs, order, self.weights is not None)

    @property
    def _net(self) -> Array:
        return np.ascontiguousarray(self.homogeneous)

    def tangent(self, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Unit tangents (N, dim) along u and along v."""
        d = self.derivatives(u, v, 1)
        return tuple(x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300) for x in (d[1, 0], d[0, 1]))  # type: ignore[return-value]

    def normal(self, u: ArrayLike, v: ArrayLike) -> Array:
        """Unit normals (N, 3), along S_u x S_v; where that vanishes, as at a pole, the normal of a point close by."""
        us, vs = (np.atleast_1d(floats(x, name)) for x, name in ((u, "u"), (v, "v")))
        us, vs = (np.ascontiguousarray(x) for x in np.broadcast_arrays(us, vs))
        cross, scale = self._cross(us, vs)
        flat = np.linalg.norm(cross, axis=1) <= 1e-10 * scale
        if flat.any():
            middle = [(low + high) / 2 for low, high in self.domain]
            near = [x[flat] + 1e-5 * (m - x[flat]) for x, m in zip((us, vs), middle, strict=True)]
            cross[flat] = self._cross(*near)[0]
        return np.asarray(cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300))

    def _cross(self, u: Array, v: Array) -> tuple[Array, float]:
        self._need_space()
        d = self.derivatives(u, v, 1)
        size = np.ptp(self.control_points.reshape(-1, 3), axis=0).max()
        (a, b), (p, q) = self.domain
        return np.cross(d[1, 0], d[0, 1]), float(size * size / (b - a) / (q - p))

    def _need_space(self) -> None:
        require(self.control_points.shape[2] == 3, "control_points", "three coordinates for this", self.control_points.shape[2])

    def curvature(self, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Gaussian and mean curvature (N,) each; the mean's sign follows the normal S_u x S_v. NaN at poles."""
        self._need_space()
        d = self.derivatives(u, v, 2)
        su, sv = d[1, 0], d[0, 1]
        with np.errstate(invalid="ignore", divide="ignore"):
            normal = np.cross(su, sv)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            e, f, g = (np.einsum("ni,ni->n", a, b) for a, b in ((su, su), (su, sv), (sv, sv)))
            l, m, n = (np.einsum("ni,ni->n", x, normal) for x in (d[2, 0], d[1, 1], d[0, 2]))  # noqa: E741
            area = e * g - f * f
            return (l * n - m * m) / area, (e * n - 2 * f * m + g * l) / (2 * area)

    def closest_point(self, points: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """u, v (N,), points (N, dim) and distances (N,) of the surface's points nearest to ``points`` (inversion, section 6.1).

        Newton from the nearest of a grid of samples, at least eight a span each way: a nearer point that no sample leads to is missed.
        """
        wanted = floats(points, "points", 2)
        dim = self.control_points.shape[2]
        require(wanted.shape[1] == dim, "points", f"{dim} columns", wanted.shape)
        axes = [between(b, max(8, 2 * p)) for b, p in zip(self.breaks, self.degree, strict=True)]
        number = nearest(self.evaluate_grid(*axes).reshape(-1, dim), wanted)
        at = np.stack([axes[0][number // len(axes[1])], axes[1][number % len(axes[1])]], 1)

        def jets(x: Array) -> tuple[Array, Array, Array]:
            d = self.derivatives(x[:, 0], x[:, 1], 2)
            across = np.stack([d[1, 1], d[0, 2]], 1)
            return d[0, 0], np.stack([d[1, 0], d[0, 1]], 1), np.stack([np.stack([d[2, 0], d[1, 1]], 1), across], 1)

        edges = [creases(k, p) for k, p in zip(self.knots, self.degree, strict=True)]
        at = project(jets, lambda x: self.evaluate(x[:, 0], x[:, 1]), wanted, at, edges, list(self.is_closed))
        found = self.evaluate(at[:, 0], at[:, 1])
        return at[:, 0].copy(), at[:, 1].copy(), found, np.linalg.norm(found - wanted, axis=1)

    def bounding_box(self) -> Array:
        """(2, dim) least and greatest coordinates of the surface itself, not of its control points."""
        axes = [sampled(b, 2 * p) for b, p in zip(self.breaks, self.degree, strict=True)]
        return extremes(lambda at: self.evaluate(at[:, 0], at[:, 1]), axes)

    def curve(self, direction: Direction, at: float) -> Curve:
        """The isoparametric curve along ``direction`` at the fixed value ``at`` of the other parameter."""
        d = _axis(direction)
        other = self if d == 1 else self.swap()
        low, high = other.domain[0]
        require(low <= at <= high, "at", f"a value within {low} .. {high}", at)
        homog = other.homogeneous
        rows = np.ascontiguousarray(homog.reshape(len(homog), -1))
        points = _core.nurbs_curve(rows, other.knots_u, np.array([float(at)]), 0, False)[0, 0].reshape(homog.shape[1:])
        return Curve(*_named(points, other.knots_v, self.weights is not None))

    def insert_knots(self, direction: Direction, new: ArrayLike) -> Surface:
        """The same surface with the knots ``new`` along a direction (A5.3, A5.5)."""
        d = _axis(direction)
        at = checked_insertion(new, "new", self.knots[d], self.degree[d])
        return self._edited(d, lambda knots, rows: edit.insert(knots, rows, at))

    def refine(self, pieces: int = 2) -> Surface:
        """The same surface with each span cut into equal ``pieces`` both ways."""
        require(pieces >= 1, "pieces", "at least 1", pieces)
        breaks = self.breaks
        return self.insert_knots("u", subdivided(breaks[0], pieces)).insert_knots("v", subdivided(breaks[1], pieces))

    def elevate_degree(self, direction: Direction, times: int = 1) -> Surface:
        """The same surface, clamped along a direction, of a degree ``times`` higher there (A5.10)."""
        require(times >= 0, "times", "at least 0", times)
        return self._edited(_axis(direction), lambda knots, rows: edit.elevate(knots, rows, times))

    def remove_knots(self, direction: Direction, tolerance: float) -> Surface:
        """A surface with fewer knots along a direction, nowhere farther than ``tolerance`` from this one."""
        require(tolerance >= 0, "tolerance", "at least 0", tolerance)
        allowed = tolerance * removal_scale(self.control_points, self.weights)
        dim = self.homogeneous.shape[2]
        return self._edited(_axis(direction), lambda knots, rows: edit.remove(knots, rows, allowed, dim))

    def clamped(self) -> Surface:
        """The same surface with its end knots repeated ``degree + 1`` times both ways."""
        out = self
        for d in (0, 1):
            low, high = out.domain[d]
            out = out._edited(d, lambda knots, rows, a=low, b=high: edit.extract(knots, rows, a, b))  # type: ignore[misc]
        return out

    def split(self, direction: Direction, at: float) -> tuple[Surface, Surface]:
        """The parts before and after a parameter, each over its part of the domain."""
        d = _axis(direction)
        low, high = self.domain[d]
        require(low < at < high, "at", f"a value between {low} and {high}", at)
        return (
            self._edited(d, lambda knots, rows: edit.extract(knots, rows, low, at)),
            self._edited(d, lambda knots, rows: edit.extract(knots, rows, at, high)),
        )

    def reverse(self, direction: Direction) -> Surface:
        """The same surface run through backwards along a direction."""
        return self._edited(_axis(direction), edit.reverse)

    def swap(self) -> Surface:
        """The same surface with u and v exchanged; its normal turns round."""
        w = None if self.weights is None else self.weights.T
        return Surface(self.control_points.transpose(1, 0, 2), self.knots_v, self.knots_u, w)

    def transformed(self, matrix: ArrayLike) -> Surface:
        """Moved by an affine (dim + 1, dim + 1) matrix."""
        return Surface(affine(self.control_points, matrix), *self.knots, self.weights)

    def _edited(self, axis: int, change: Edit) -> Surface:
        net = np.moveaxis(self.homogeneous, axis, 0)
        knots, rows = change(self.knots[axis], np.ascontiguousarray(net.reshape(len(net), -1)))
        net = np.moveaxis(rows.reshape(len(rows), *net.shape[1:]), 0, axis)
        control, weights = plain(net, self.weights is not None)
        both = (knots, self.knots_v) if axis == 0 else (self.knots_u, knots)
        return Surface(control, *both, weights)


def _axis(direction: str) -> int:
    require(direction in ("u", "v"), "direction", "'u' or 'v'", repr(direction))
    return "uv".index(direction)


def _named(points: Array, knots: NDArray[np.float64], rational: bool) -> tuple[Array, Array, Array | None]:
    control, weights = plain(points, rational)
    return control, knots, weights
