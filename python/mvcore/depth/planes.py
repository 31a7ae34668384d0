"""Slanted planes of inverse depth: sweep, semi-global aggregation, refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import DepthConfig
from .views import Map, Scale

NO_DEPTHS: list[Map] = []
NO_BACKS = np.zeros((0, 12), np.float32)


def _slopes(inverse: Map) -> tuple[Map, Map]:
    """Slopes per pixel of a map from its 5x5 surroundings, after a median that keeps edges."""
    smooth = cv2.medianBlur(inverse, 5)
    scale = 1.0 / 128.0  # sum of the Sobel kernel's weights times their distances
    return (
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=5, scale=scale, borderType=cv2.BORDER_REPLICATE),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=5, scale=scale, borderType=cv2.BORDER_REPLICATE),
    )


def _upsample(planes: Map, width: int, height: int) -> Map:
    """Planes (h, w, 4) on a finer grid: each pixel takes the nearest plane, continued to its own place."""
    h, w = planes.shape[:2]
    x, y = (np.arange(width) + 0.5) * w / width - 0.5, (np.arange(height) + 0.5) * h / height - 0.5
    i, j = np.clip(np.rint(x).astype(int), 0, w - 1), np.clip(np.rint(y).astype(int), 0, h - 1)
    fine = planes[j][:, i]
    fine[..., 0] += fine[..., 1] * (x - i)[None] + fine[..., 2] * (y - j)[:, None]
    fine[..., 1] *= w / width
    fine[..., 2] *= h / height
    return np.ascontiguousarray(fine, np.float32)


def refine(
    scale: Scale,
    planes: Map,
    prior: Map,
    span: tuple[float, float],
    step: float,
    rounds: int,
    config: DepthConfig,
    reach: float,
    depths: list[Map] = NO_DEPTHS,
    adjacent: bool = True,
) -> Map:
    """Planes (h, w, 4), the cost last, after ``rounds`` of the slanted refinement."""
    return _core.refine(
        scale.greys[0],
        scale.greys[1:],
        scale.there,
        depths,
        scale.back if depths else NO_BACKS,
        planes,
        prior,
        iterations=rounds,
        low=span[0],
        high=span[1],
        step=step,
        max_slope=scale.max_slope,
        prior_weight=config.prior_weight,
        prior_reach=reach,
        geometry_weight=config.geometry_weight,
        adjacent=adjacent,
    )


@dataclass(frozen=True)
class Hypotheses:
    """Inverse-depth planes (h, w, 4) on one scale, with the semi-global solution and its margin on the coarsest."""

    planes: Map
    prior: Map
    margin: Map
    span: tuple[float, float]
    step: float


@dataclass(frozen=True)
class Expected:
    """Inverse depth that the network found, (h, w) float32, and how sure it is of it, 0 .. 1."""

    inverse: Map
    confidence: Map


def aggregate(scale: Scale, low: float, high: float, planes: int, config: DepthConfig, expected: Expected | None = None) -> tuple[Map, Map]:
    """Inverse depth and margin of the semi-global solution among ``planes`` planes."""
    inverse = np.linspace(low, high, planes, dtype=np.float32)
    costs = _core.sweep(scale.greys[0], scale.greys[1:], scale.there, inverse)
    if expected is not None:
        place = (expected.inverse - np.float32(low)) / (inverse[1] - inverse[0])
        _core.expect(costs, place, expected.confidence, config.network_weight, config.network_reach)
    index, margin = _core.aggregate(costs, scale.greys[0], config.p1, config.p2, config.p2_falloff)
    if scale.guide is not None and config.edge_radius:
        index = sharpened(index, np.zeros(index.shape, np.uint8), scale.guide, config.edge_radius, 1)
    return (low + index * float(inverse[1] - inverse[0])).astype(np.float32), margin


MEDIAN_RADIUS, MEDIAN_ROUNDS = 10, 2
"""Of the weighted median at full size; the second round of disparities gains half as much as the first, a third hardly anything."""


def sharpened(values: Map, doubtful: NDArray[Any], guide: NDArray[np.uint8], radius: int, rounds: int) -> Map:
    """Disparities, or places among planes, with their edges on the picture's: windows that straddle an edge fatten what is in front.

    What is doubtful is replaced anyhow, the rest where it errs by more than one.
    """
    guide, doubtful = np.ascontiguousarray(guide), np.asarray(doubtful, np.uint8)
    for _ in range(rounds):
        values = _core.weighted_median(
            values, guide, doubtful, radius=radius, step=min(2, radius), colour=10.0, distance=0.6 * radius, slack=1.0
        )
    return values


def sweep_scale(scale: Scale, low: float, high: float, planes: int, config: DepthConfig, expected: Expected | None = None) -> Hypotheses:
    """Sweep, aggregate, refine at one scale."""
    prior, margin = aggregate(scale, low, high, planes, config, expected)
    return hypotheses_from(scale, slanted(prior), prior, margin, (low, high), (high - low) / (planes - 1), config)


def slanted(inverse: Map) -> Map:
    """Slanted planes (h, w, 4) through a map of inverse depths."""
    a, b = _slopes(inverse)
    return np.stack([inverse, a, b, np.zeros_like(a)], -1)


def hypotheses_from(
    scale: Scale, start: Map, prior: Map, margin: Map, span: tuple[float, float], step: float, config: DepthConfig
) -> Hypotheses:
    """A start, refined on the scale of its sweep."""
    refined = refine(scale, start, prior, span, step, config.sweep_rounds, config, config.prior_reach)
    return Hypotheses(refined, prior, margin, span, step)


def carried_to(
    coarse: Hypotheses, scale: Scale, rounds: int, config: DepthConfig, depths: list[Map] = NO_DEPTHS, adjacent: bool = True
) -> Hypotheses:
    """The hypotheses on a finer (or the same) scale, refined there."""
    h, w = scale.greys[0].shape
    planes = coarse.planes if coarse.planes.shape[:2] == (h, w) else _upsample(coarse.planes, w, h)
    prior = cv2.resize(coarse.prior, (w, h), interpolation=cv2.INTER_LINEAR)
    if scale.unwanted is not None:
        planes, prior = planes.copy(), np.where(scale.unwanted, np.float32(0), prior)
        planes[scale.unwanted] = 0
    # One pixel of parallax is half as much inverse depth on an image twice as large.
    ratio = coarse.prior.shape[1] / w
    planes = refine(scale, planes, prior, coarse.span, coarse.step * ratio, rounds, config, config.prior_reach / ratio, depths, adjacent)
    return replace(coarse, planes=planes)
