"""NURBS curves (paper eqs 13-22; Piegl and Tiller chapters 2-5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

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
from .search import between, creases, extremes, nearest, project, sampled, subdivided


@dataclass(frozen=True, eq=False)
class Curve:
    """A B-spline or, with weights, a NURBS curve (eqs 13, 20).

    Parameters
    ----------
    control_points : (n, dim), any dim.
    knots : (n + degree + 1,) ascending; the degree follows from the counts. Clamped (eq 14), unclamped or periodic: the domain is
        ``knots[degree] .. knots[n]``.
    weights : (n,) positive, or none.

    Raises `InvalidInputError` naming the argument that does not fit.
    """

    control_points: Array
    knots: Array
    weights: Array | None = None

    def __post_init__(self) -> None:
        control = floats(self.control_points, "control_points", 2)
        require(control.shape[1] >= 1, "control_points", "at least one coordinate", control.shape)
        knots = floats(self.knots, "knots", 1)
        for name, value in (("control_points", control), ("knots", knots)):
            object.__setattr__(self, name, frozen(value))
        w = checked_weights(self.weights, control.shape[:1])
        object.__setattr__(self, "weights", None if w is None else frozen(w))
        _core.nurbs_basis(self.knots, len(control), knots[:0], 0)

    @classmethod
    def closed(cls, control_points: ArrayLike, degree: int = 3, weights: ArrayLike | None = None) -> Curve:
        """A periodic curve over 0 .. n: the first ``degree`` of the n control points come round again."""
        control = floats(control_points, "control_points", 2)
        require(len(control) > degree, "control_points", f"more than {degree} points", len(control))
        w = checked_weights(weights, control.shape[:1])
        knots = np.arange(-degree, len(control) + degree + 1, dtype=np.float64)
        wrapped = np.concatenate([control, control[:degree]])
        return cls(wrapped, knots, None if w is None else np.concatenate([w, w[:degree]]))

    @property
    def degree(self) -> int:
        """Polynomial degree."""
        return len(self.knots) - len(self.control_points) - 1

    @property
    def domain(self) -> tuple[float, float]:
        """First and last parameter."""
        return float(self.knots[self.degree]), float(self.knots[len(self.control_points)])

    @property
    def homogeneous(self) -> Array:
        """(n, dim + 1) points (w P, w), or (n, dim) without weights."""
        return homogeneous(self.control_points, self.weights)

    @property
    def breaks(self) -> Array:
        """The distinct knots within the domain, ends included."""
        low, high = self.domain
        return np.unique(self.knots[(self.knots >= low) & (self.knots <= high)])

    @property
    def is_closed(self) -> bool:
        """Whether the last point is the first, to rounding."""
        ends = self.evaluate(list(self.domain))
        return bool(np.abs(ends[0] - ends[1]).max() <= 1e-12 * np.abs(self.control_points).max())

    def evaluate(self, u: ArrayLike, *, outside: Outside = "error") -> Array:
        """Points (N, dim) at N parameters (eq 13; A3.1, A4.1)."""
        return self.derivatives(u, 0, outside=outside)[0]

    def derivatives(self, u: ArrayLike, order: int = 2, *, outside: Outside = "error") -> Array:
        """(order + 1, N, dim): the points and their derivatives (eqs 17-19, 22; A3.2, A4.2)."""
        require(order >= 0, "order", "at least 0", order)
        at = parameters(u, "u", self.domain, outside)
        control = np.ascontiguousarray(self.homogeneous)
        return _core.nurbs_curve(control, self.knots, at, order, self.weights is not None)

    def tangent(self, u: ArrayLike) -> Array:
        """Unit tangents (N, dim)."""
        d = self.derivatives(u, 1)[1]
        return d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), np.finfo(float).tiny)

    def curvature(self, u: ArrayLike) -> Array:
        """(N,) curvature, |C' x C''| / |C'|³ written for any dimension; never negative."""
        _c, d, dd = self.derivatives(u, 2)
        speed = np.einsum("ni,ni->n", d, d)
        area = speed * np.einsum("ni,ni->n", dd, dd) - np.einsum("ni,ni->n", d, dd) ** 2
        return np.sqrt(area.clip(0)) / speed**1.5

    def normal(self, u: ArrayLike) -> Array:
        """Unit principal normals (N, dim): the way the curve bends; zero where it is straight."""
        _c, d, dd = self.derivatives(u, 2)
        t = d / np.linalg.norm(d, axis=1, keepdims=True)
        across = dd - np.einsum("ni,ni->n", dd, t)[:, None] * t
        size = np.linalg.norm(across, axis=1, keepdims=True)
        return np.where(size > 1e-12 * np.abs(dd).max(initial=1e-300), across / np.maximum(size, 1e-300), 0.0)

    def arc_length(self, start: float | None = None, end: float | None = None, *, tolerance: float = 1e-10) -> float:
        """Length between two parameters, by Gauss-Legendre on pieces halved until it changes by less than ``tolerance``, relative."""
        low, high = self.domain
        a, b = (low if start is None else float(start)), (high if end is None else float(end))
        parameters([a, b], "start, end", self.domain, "error")
        require(a <= b, "end", f"at least start = {a}", b)
        if a == b:
            return 0.0
        inside = self.breaks[(self.breaks > a) & (self.breaks < b)]
        edges = np.concatenate([[a], inside, [b]])
        require(a >= low and b <= high, "start, end", f"values within {low} .. {high}", (a, b))
        x, w = np.polynomial.legendre.leggauss(12)
        length = -1.0
        for _ in range(12):
            half = np.diff(edges)[:, None] / 2
            at = (edges[:-1, None] + half + half * x).ravel().clip(low, high)
            speed = np.linalg.norm(self.derivatives(at, 1)[1], axis=1).reshape(-1, len(x))
            before, length = length, float((speed * w * half).sum())
            if abs(length - before) <= tolerance * length:
                break
            edges = np.sort(np.concatenate([edges, (edges[:-1] + edges[1:]) / 2]))
        return length

    def closest_point(self, points: ArrayLike) -> tuple[Array, Array, Array]:
        """Parameters (N,), points (N, dim) and distances (N,) of the curve's points nearest to ``points`` (inversion, section 6.1)."""
        wanted = floats(points, "points", 2)
        require(wanted.shape[1] == self.control_points.shape[1], "points", f"{self.control_points.shape[1]} columns", wanted.shape)
        start = between(self.breaks, 4 * self.degree)
        at = start[nearest(self.evaluate(start), wanted)][:, None]

        def jets(x: Array) -> tuple[Array, Array, Array]:
            points, first, second = self.derivatives(x[:, 0], 2)
            return points, first[:, None], second[:, None, None]

        edges = [creases(self.knots, self.degree)]
        u = project(jets, lambda x: self.evaluate(x[:, 0]), wanted, at, edges, [self.is_closed])[:, 0].copy()
        found = self.evaluate(u)
        return u, found, np.linalg.norm(found - wanted, axis=1)

    def bounding_box(self) -> Array:
        """(2, dim) least and greatest coordinates of the curve itself, not of its control points."""
        return extremes(lambda at: self.evaluate(at[:, 0]), [sampled(self.breaks, 4 * self.degree)])

    def insert_knots(self, new: ArrayLike) -> Curve:
        """The same curve with the knots ``new``, which may repeat (A5.1, A5.4)."""
        at = checked_insertion(new, "new", self.knots, self.degree)
        return self._with(*edit.insert(self.knots, self.homogeneous, at))

    def refine(self, pieces: int = 2) -> Curve:
        """The same curve with each span cut into equal ``pieces``."""
        require(pieces >= 1, "pieces", "at least 1", pieces)
        return self.insert_knots(subdivided(self.breaks, pieces))

    def elevate_degree(self, times: int = 1) -> Curve:
        """The same curve, clamped, of a degree ``times`` higher (A5.9)."""
        require(times >= 0, "times", "at least 0", times)
        return self._with(*edit.elevate(self.knots, self.homogeneous, times))

    def remove_knots(self, tolerance: float) -> Curve:
        """A curve with fewer knots, nowhere farther than ``tolerance`` from this one."""
        require(tolerance >= 0, "tolerance", "at least 0", tolerance)
        allowed = tolerance * removal_scale(self.control_points, self.weights)
        rows = self.homogeneous
        return self._with(*edit.remove(self.knots, rows, allowed, rows.shape[1]))

    def clamped(self) -> Curve:
        """The same curve with its end knots repeated ``degree + 1`` times."""
        return self._with(*edit.extract(self.knots, self.homogeneous, *self.domain))

    def split(self, u: float) -> tuple[Curve, Curve]:
        """The parts before and after ``u``, each over its part of the domain."""
        low, high = self.domain
        require(low < u < high, "u", f"a value between {low} and {high}", u)
        rows = self.homogeneous
        return self._with(*edit.extract(self.knots, rows, low, u)), self._with(*edit.extract(self.knots, rows, u, high))

    def reverse(self) -> Curve:
        """The same curve run through backwards."""
        return self._with(*edit.reverse(self.knots, self.homogeneous))

    def transformed(self, matrix: ArrayLike) -> Curve:
        """Moved by an affine (dim + 1, dim + 1) matrix."""
        return Curve(affine(self.control_points, matrix), self.knots, self.weights)

    def _with(self, knots: Array, rows: Array) -> Curve:
        control, weights = plain(rows, self.weights is not None)
        return Curve(control, knots, weights)
