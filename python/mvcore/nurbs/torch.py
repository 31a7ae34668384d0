"""NURBS under autograd: gradients to control points, weights, parameters and knots (paper eqs 13-31; the only part that imports torch).

The Rust kernels serve forward and backward, in float64 on the CPU. Evaluation and its adjoint are linear in the control points and
each is the other's gradient, so gradients of gradients exist too; those to the knots are of first order only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from .. import _core
from ..errors import require

_Orders = tuple[int, int]


def _array(tensor: Tensor) -> NDArray[np.float64]:
    return np.ascontiguousarray(tensor.detach().numpy())


class _Surface(torch.autograd.Function):
    """Derivative ``orders`` of a plain B-spline surface, (N, dim)."""

    @staticmethod
    def forward(ctx: Any, control: Tensor, ku: Tensor, kv: Tensor, u: Tensor, v: Tensor, orders: _Orders) -> Tensor:
        ctx.save_for_backward(control, ku, kv, u, v)
        ctx.orders = orders
        out = _core.nurbs_surface_partials(_array(control), (_array(ku), _array(kv)), _array(u), _array(v), [orders])
        return torch.from_numpy(out[0])

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Any:  # type: ignore[override]
        control, ku, kv, u, v = ctx.saved_tensors
        k, l = ctx.orders  # noqa: E741
        to_control = to_u = to_v = to_ku = to_kv = None
        if ctx.needs_input_grad[0]:
            to_control = _Adjoint.apply(g, ku, kv, u, v, (k, l), control.shape[:2])
        if ctx.needs_input_grad[3]:
            to_u = (g * _Surface.apply(control, ku, kv, u, v, (k + 1, l))).sum(1)
        if ctx.needs_input_grad[4]:
            to_v = (g * _Surface.apply(control, ku, kv, u, v, (k, l + 1))).sum(1)
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            require((k, l) == (0, 0), "knots", "no gradient of a derivative to them", (k, l))
            to_ku, to_kv = _KnotGradient.apply(control, ku, kv, u, v, g)
        return to_control, to_ku, to_kv, to_u, to_v, None


class _Adjoint(torch.autograd.Function):
    """Σ over points of basis times gradient, (m, n, dim): what `_Surface` hands back to the control points."""

    @staticmethod
    def forward(ctx: Any, g: Tensor, ku: Tensor, kv: Tensor, u: Tensor, v: Tensor, orders: _Orders, counts: Any) -> Tensor:
        ctx.save_for_backward(g, ku, kv, u, v)
        ctx.orders = orders
        knots = (_array(ku), _array(kv))
        return torch.from_numpy(_core.nurbs_control_gradient(knots, tuple(counts), _array(u), _array(v), _array(g), orders))

    @staticmethod
    def backward(ctx: Any, to_control: Tensor) -> Any:  # type: ignore[override]
        g, ku, kv, u, v = ctx.saved_tensors
        k, l = ctx.orders  # noqa: E741
        to_g = to_u = to_v = None
        if ctx.needs_input_grad[0]:
            to_g = _Surface.apply(to_control, ku, kv, u, v, (k, l))
        if ctx.needs_input_grad[3]:
            to_u = (g * _Surface.apply(to_control, ku, kv, u, v, (k + 1, l))).sum(1)
        if ctx.needs_input_grad[4]:
            to_v = (g * _Surface.apply(to_control, ku, kv, u, v, (k, l + 1))).sum(1)
        return to_g, None, None, to_u, to_v, None, None


class _KnotGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, control: Tensor, ku: Tensor, kv: Tensor, u: Tensor, v: Tensor, g: Tensor) -> Any:
        knots = (_array(ku), _array(kv))
        out = _core.nurbs_knot_gradient(_array(control), knots, _array(u), _array(v), _array(g))
        return torch.from_numpy(out[0]), torch.from_numpy(out[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *_: Tensor) -> Any:  # type: ignore[override]
        raise NotImplementedError("gradients to the knots are of first order only")


class _Curve(torch.autograd.Function):
    """Derivative ``order`` of a plain B-spline curve, (N, dim)."""

    @staticmethod
    def forward(ctx: Any, control: Tensor, knots: Tensor, u: Tensor, order: int) -> Tensor:
        ctx.save_for_backward(control, knots, u)
        ctx.order = order
        return torch.from_numpy(_core.nurbs_curve(_array(control), _array(knots), _array(u), order, False)[order].copy())

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Any:  # type: ignore[override]
        control, knots, u = ctx.saved_tensors
        to_control = to_knots = to_u = None
        if ctx.needs_input_grad[0]:
            to_control = _CurveAdjoint.apply(g, knots, u, ctx.order, len(control))
        if ctx.needs_input_grad[2]:
            to_u = (g * _Curve.apply(control, knots, u, ctx.order + 1)).sum(1)
        if ctx.needs_input_grad[1]:
            require(ctx.order == 0, "knots", "no gradient of a derivative to them", ctx.order)
            to_knots = _CurveKnotGradient.apply(control, knots, u, g)
        return to_control, to_knots, to_u, None


class _CurveAdjoint(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, g: Tensor, knots: Tensor, u: Tensor, order: int, count: int) -> Tensor:
        ctx.save_for_backward(g, knots, u)
        ctx.order = order
        return torch.from_numpy(_core.nurbs_curve_control_gradient(_array(knots), count, _array(u), _array(g), order))

    @staticmethod
    def backward(ctx: Any, to_control: Tensor) -> Any:  # type: ignore[override]
        g, knots, u = ctx.saved_tensors
        to_g = to_u = None
        if ctx.needs_input_grad[0]:
            to_g = _Curve.apply(to_control, knots, u, ctx.order)
        if ctx.needs_input_grad[2]:
            to_u = (g * _Curve.apply(to_control, knots, u, ctx.order + 1)).sum(1)
        return to_g, None, to_u, None, None


class _CurveKnotGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, control: Tensor, knots: Tensor, u: Tensor, g: Tensor) -> Tensor:
        return torch.from_numpy(_core.nurbs_curve_knot_gradient(_array(control), _array(knots), _array(u), _array(g)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *_: Tensor) -> Any:  # type: ignore[override]
        raise NotImplementedError("gradients to the knots are of first order only")


def _checked(ndim: int, **tensors: Tensor) -> None:
    for name, tensor in tensors.items():
        want = ndim if name == "control_points" else 1
        require(isinstance(tensor, Tensor), name, "a tensor", type(tensor).__name__)
        require(tensor.device.type == "cpu", name, "a tensor on the CPU", tensor.device)
        require(tensor.dtype == torch.float64, name, "float64", tensor.dtype)
        require(tensor.dim() == want, name, f"{want} axes", tuple(tensor.shape))


def _lifted(control: Tensor, weights: Tensor | None) -> Tensor:
    if weights is None:
        return control
    require(weights.dtype == torch.float64, "weights", "float64", weights.dtype)
    require(weights.shape == control.shape[:-1], "weights", f"shape {tuple(control.shape[:-1])}", tuple(weights.shape))
    require(bool((weights > 0).all()), "weights", "positive values", float(weights.detach().min()))
    return torch.cat([control * weights[..., None], weights[..., None]], -1)


def evaluate_surface(
    control_points: Tensor, knots_u: Tensor, knots_v: Tensor, u: Tensor, v: Tensor, *, weights: Tensor | None = None
) -> Tensor:
    """Points (N, dim) of a surface at parameters u, v (N,), with gradients to all that asks for them (eqs 23-24).

    control_points (m, n, dim), knots (m + p + 1,) and (n + q + 1,), weights (m, n): float64 on the CPU. Gradients to knots need
    knots that do not coincide within the domain's inside, as `monotone_knots` makes them.
    """
    _checked(3, control_points=control_points, knots_u=knots_u, knots_v=knots_v, u=u, v=v)
    out = _Surface.apply(_lifted(control_points, weights), knots_u, knots_v, u, v, (0, 0))
    return out if weights is None else out[:, :-1] / out[:, -1:]


def evaluate_curve(control_points: Tensor, knots: Tensor, u: Tensor, *, weights: Tensor | None = None) -> Tensor:
    """Points (N, dim) of a curve at parameters u (N,), with gradients to all that asks for them (eqs 13, 20)."""
    _checked(2, control_points=control_points, knots=knots, u=u)
    out = _Curve.apply(_lifted(control_points, weights), knots, u, 0)
    return out if weights is None else out[:, :-1] / out[:, -1:]


def surface_derivative(control_points: Tensor, knots_u: Tensor, knots_v: Tensor, u: Tensor, v: Tensor, orders: tuple[int, int]) -> Tensor:
    """Derivative of a surface without weights, ``orders`` times along u and v, (N, dim); differentiable but to the knots."""
    _checked(3, control_points=control_points, knots_u=knots_u, knots_v=knots_v, u=u, v=v)
    require(min(orders) >= 0, "orders", "no negative value", orders)
    return _Surface.apply(control_points, knots_u, knots_v, u, v, (int(orders[0]), int(orders[1])))


def monotone_knots(spans: Tensor, degree: int, *, least: float = 1e-3) -> Tensor:
    """Clamped knots over 0 .. 1 whose spans are the softmax of ``spans`` (real numbers, one a span), each at least ``least`` of the mean.

    What lets an optimiser move knots: they stay ascending and apart whatever it does.
    """
    require(spans.dim() == 1 and len(spans) >= 1, "spans", "one axis, at least one value", tuple(spans.shape))
    require(0 <= least < 1, "least", "a share from 0 to below 1", least)
    width = (1 - least) * torch.softmax(spans.double(), 0) + least / len(spans)
    inner = torch.cumsum(width, 0)[:-1]
    return torch.cat([inner.new_zeros(degree + 1), inner, inner.new_ones(degree + 1)])
