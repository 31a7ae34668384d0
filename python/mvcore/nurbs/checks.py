"""Arguments checked and converted: arrays, parameters, weights, knots to insert."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InvalidInputError, require
from . import edit

Array = NDArray[np.float64]
Outside = Literal["error", "clamp"]


def floats(values: ArrayLike, argument: str, ndim: int | None = None) -> Array:
    """A C-contiguous float64 array, finite, of ``ndim`` axes; raises `InvalidInputError` naming the argument."""
    try:
        array = np.ascontiguousarray(values, np.float64)
    except (TypeError, ValueError):
        raise InvalidInputError(f"{argument}: expected numbers, got {type(values).__name__}") from None
    require(ndim is None or array.ndim == ndim, argument, f"{ndim} axes", f"shape {array.shape}")
    require(np.isfinite(array).all(), argument, "finite values", "NaN or infinity")
    return array


def parameters(values: ArrayLike, argument: str, domain: tuple[float, float], outside: Outside) -> Array:
    """Parameters as (N,) float64; those outside the domain are an error, or the nearest end when that is asked for."""
    require(outside in ("error", "clamp"), "outside", "'error' or 'clamp'", repr(outside))
    array = np.atleast_1d(floats(values, argument))
    require(array.ndim == 1, argument, "a number or one axis", f"shape {array.shape}")
    return np.ascontiguousarray(array.clip(*domain)) if outside == "clamp" else array


def homogeneous(control: Array, weights: Array | None) -> Array:
    """(w P, w), or the points themselves when there are no weights."""
    return control if weights is None else np.concatenate([control * weights[..., None], weights[..., None]], -1)


def plain(points: Array, rational: bool) -> tuple[Array, Array | None]:
    """Control points and weights of homogeneous points."""
    return (points[..., :-1] / points[..., -1:], points[..., -1].copy()) if rational else (points, None)


def checked_weights(weights: ArrayLike | None, shape: tuple[int, ...]) -> Array | None:
    """Weights of the control net's shape, all positive."""
    if weights is None:
        return None
    w = floats(weights, "weights")
    require(w.shape == shape, "weights", f"shape {shape}", w.shape)
    require((w > 0).all(), "weights", "positive values", w.min() if w.size else "none")
    return w


def frozen(array: Array) -> Array:
    """A copy that cannot be written to."""
    copy = array.copy()
    copy.flags.writeable = False
    return copy


def affine(points: Array, matrix: ArrayLike) -> Array:
    """Points moved by a homogeneous matrix whose last row is 0 .. 0 1."""
    m, dim = floats(matrix, "matrix", 2), points.shape[-1]
    require(m.shape == (dim + 1, dim + 1), "matrix", f"shape {(dim + 1, dim + 1)}", m.shape)
    require(np.array_equal(m[-1], np.eye(dim + 1)[-1]), "matrix", "an affine map, last row 0 .. 0 1", m[-1])
    return points @ m[:-1, :-1].T + m[:-1, -1]


def checked_insertion(new: ArrayLike, argument: str, knots: Array, degree: int) -> Array:
    """Values to insert: within the domain, none more than ``degree`` times in all."""
    at = parameters(new, argument, (0.0, 0.0), "error")
    low, high = knots[degree], knots[-degree - 1]
    require(((at >= low) & (at <= high)).all(), argument, f"values within {low} .. {high}", at)
    for u in np.unique(at):
        total = edit.multiplicity(knots, u) + int(np.count_nonzero(at == u))
        require(total <= degree, argument, f"{u} at most {degree} times in all", f"{total} times")
    return at


def removal_scale(control: Array, weights: Array | None) -> float:
    """What a tolerance in space is in homogeneous coordinates (Piegl and Tiller eq 5.30)."""
    if weights is None:
        return 1.0
    farthest = np.linalg.norm(control.reshape(-1, control.shape[-1]), axis=1).max()
    return float(weights.min() / (1 + farthest))
