"""A view's depth, pass by pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import DepthConfig
from ..errors import require
from ..geometry.cameras import Camera
from ..types import DepthMap
from .planes import (
    MEDIAN_RADIUS,
    Expected,
    Hypotheses,
    aggregate,
    carried_to,
    hypotheses_from,
    refine,
    sharpened,
    slanted,
    sweep_scale,
)
from .views import Map, Scale, View, blank, guide_of, pyramid, resized_nearest, resized_smoothly


def _check(sources: Sequence[View], near: float, far: float) -> None:
    require(len(sources) >= 1, "sources", "at least one view", "none")
    require(0 < near < far < np.inf, "near, far", "0 < near < far", f"{near:g}, {far:g}")


@dataclass(frozen=True)
class RoughDepth:
    """A view's depth from photographs alone, at half the size: what `refine_depth` starts from."""

    hypotheses: Hypotheses

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """All of it by name, to be stored."""
        h = self.hypotheses
        return {"planes": h.planes, "prior": h.prior, "margin": h.margin, "search": np.array([*h.span, h.step], np.float64)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.float32]]) -> RoughDepth:
        """What `arrays` gave."""
        low, high, step = map(float, arrays["search"])
        return cls(Hypotheses(arrays["planes"], arrays["prior"], arrays["margin"], (low, high), step))

    @property
    def depth(self) -> Map:
        """z-depth, (h, w) float32, 0 = none."""
        inverse = self.hypotheses.planes[..., 0]
        return np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-30), 0).astype(np.float32)


def sweep_depth(reference: View, sources: Sequence[View], near: float, far: float, config: DepthConfig | None = None) -> RoughDepth:
    """First pass: sweep, aggregation and refinement up to half the size.

    Parameters
    ----------
    reference, sources : undistorted views; one source or more.
    near, far : z-depths in world units between which the surface lies.

    Raises
    ------
    InvalidInputError
        No sources, or a range that is empty.
    """
    config = config or DepthConfig()
    _check(sources, near, far)
    coarsest, *finer = pyramid(reference, sources, config)
    return _carried_up(sweep_scale(coarsest, 1 / far, 1 / near, config.planes, config), finer, config)


def _carried_up(found: Hypotheses, finer: Sequence[Scale], config: DepthConfig) -> RoughDepth:
    """A first pass brought from the coarsest scale up to half the size."""
    for scale in finer[:-1]:
        found = carried_to(found, scale, config.rounds, config)
    return RoughDepth(found)


def seeded_depth(
    reference: View,
    sources: Sequence[View],
    near: float,
    far: float,
    seed: Map,
    config: DepthConfig | None = None,
) -> RoughDepth:
    """First pass that starts from a depth map expected here, an earlier instant's surface say.

    The sweep has half as many planes then: each pixel starts from what is expected unless the photographs speak for what the sweep found.
    Parameters and errors as of `sweep_depth`.

    Parameters
    ----------
    seed : (h, w) float32 z-depth, 0 where nothing is expected.
    """
    config = config or DepthConfig()
    _check(sources, near, far)
    require(seed.shape == reference.grey.shape, "seed", f"shape {reference.grey.shape}", seed.shape)
    coarsest, *finer = pyramid(reference, sources, config)
    h, w = coarsest.greys[0].shape
    start = cv2.resize(seed, (w, h), interpolation=cv2.INTER_NEAREST)
    expected = start > 0
    if not expected.any():
        return sweep_depth(reference, sources, near, far, config)
    inverse = np.clip(1 / _filled(start), 1 / far, 1 / near).astype(np.float32)
    span, step = (1 / far, 1 / near), (1 / near - 1 / far) / (config.planes - 1)
    margin = np.full((h, w), 0.25, np.float32)
    planes = max(2, config.planes // 2)
    swept, sweep_margin = aggregate(coarsest, *span, planes, config)
    one, two = (slanted(p) for p in (inverse, swept))
    costs = [refine(coarsest, s, p, span, step, 0, config, config.prior_reach)[..., 3] for s, p in ((one, inverse), (two, swept))]
    better = ~expected | (costs[1] < costs[0])
    prior = np.where(better, swept, inverse)
    found = hypotheses_from(
        coarsest, np.where(better[..., None], two, one), prior, np.where(better, sweep_margin, margin), span, step, config
    )
    return _carried_up(found, finer, config)


def _filled(depth: Map) -> Map:
    """The nearest known depth where none is; some must be known."""
    _, nearest = _core.distance_transform((depth > 0).astype(np.uint8))
    return depth.ravel()[nearest]


NETWORK_SIDE = 576
"""Pixels of the longer side at which the network runs: about what it was trained on; the second pass carries that to full size."""


def network_depth(
    reference: View, sources: Sequence[View], near: float, far: float, config: DepthConfig | None = None, device: str = "cpu"
) -> RoughDepth:
    """First pass with the network: what it finds is a term of the sweep's costs, so that both must err for a pixel to be wrong.

    Parameters and errors as of `sweep_depth`; views need colours; ``device`` is ``cpu`` or ``cuda``.
    """
    from ..network.matcher import shipped_matcher

    config = config or DepthConfig()
    _check(sources, near, far)
    share = min(1.0, NETWORK_SIDE / max(reference.grey.shape))
    images, cameras = zip(*(_coloured(v, n, share) for n, v in enumerate([reference, *sources[:NETWORK_SOURCES]])), strict=True)
    inverse, confidence = shipped_matcher(device).depth(images[0], cameras[0], images[1:], cameras[1:], near, far)
    coarsest, *finer = pyramid(reference, sources, config)
    h, w = coarsest.greys[0].shape
    expected = Expected(
        cv2.resize(inverse, (w, h), interpolation=cv2.INTER_NEAREST), cv2.resize(confidence, (w, h), interpolation=cv2.INTER_LINEAR)
    )
    return _carried_up(sweep_scale(coarsest, 1 / far, 1 / near, config.planes, config, expected), finer, config)


NETWORK_SOURCES = 4
"""Source views that the network looks at."""


def _coloured(view: View, number: int, share: float) -> tuple[NDArray[np.uint8], Camera]:
    """Colours and camera of a view, reduced."""
    require(view.colour is not None, "views", "colours for the network", f"view {number} without")
    assert view.colour is not None
    w, h = (max(MULTIPLE, round(n * share)) for n in (view.camera.width, view.camera.height))
    if (h, w) == view.colour.shape[:2]:
        return view.colour, view.camera
    return cv2.resize(view.colour, (w, h), interpolation=cv2.INTER_AREA), view.camera.resized(w, h)


MULTIPLE = 16
"""Fewest pixels of a side that the network takes."""


def refine_depth(
    reference: View,
    sources: Sequence[View],
    rough: RoughDepth,
    rough_sources: Sequence[RoughDepth],
    config: DepthConfig | None = None,
    last: bool = True,
) -> DepthMap:
    """Second pass: refined at half size with the sources' own depth as a witness, then at full size.

    ``rough_sources`` are the first passes of the sources, one each, or empty; ``last`` says that no third pass follows. Where the
    picture is black or burnt out there is no depth.
    """
    config = config or DepthConfig()
    found = rough.hypotheses
    half, full = ([None, *pyramid(reference, sources, config)])[-2:]
    if half is not None and len(rough_sources):
        depths = [resized_nearest(r.depth, grey.shape) for r, grey in zip(rough_sources, half.greys[1:], strict=True)]
        found = carried_to(found, half, config.geometry_rounds, config, depths)
    # At full size each view is on its own again: errors that views hand to each other would pass the filter together.
    # It would cost a quarter more to try adjacent planes here, and they are the same as often as not.
    found = carried_to(found, full, config.rounds, config, adjacent=False)
    step = found.step * found.prior.shape[1] / reference.grey.shape[1] if last else None
    return _exposed_depth(reference, found.planes, found.margin, step)


SURFACE_MARGIN = 0.25
"""Margin of the aggregation that agreement with the other views' surface is worth."""


WINDOW = 5
"""Pixels a side over which the costs of a depth map and a surface are compared."""


def guided_depth(
    reference: View, sources: Sequence[View], found: DepthMap, rough: RoughDepth, surface: Map, config: DepthConfig | None = None
) -> DepthMap:
    """Third pass, at full size: starts from the surface that all views made together, where the photographs do not speak against it.

    The surface averages many views' errors and knows what this view took for something else; matching again from there keeps what both
    agree on. Where there is no surface the view's own depth stays, and either is refined.

    Parameters
    ----------
    found, rough : what `refine_depth` and the first pass gave for the reference view.
    surface : (h, w) float32 z-depth of the surface in the reference view, world units, 0 = none.

    Returns
    -------
    DepthMap
        (h, w), unfiltered; the rules of `refine_depth` hold.

    Raises
    ------
    InvalidInputError
        ``found`` or ``surface`` is not of the view's size.
    """
    config = config or DepthConfig()
    for name, values in (("found", found.depth), ("surface", surface)):
        require(values.shape == reference.grey.shape, name, f"shape {reference.grey.shape}", values.shape)
    scales = pyramid(reference, sources, config)
    full, ratio = scales[-1], scales[0].greys[0].shape[1] / reference.grey.shape[1]
    low, high = span = rough.hypotheses.span
    step, reach = (high - low) / (config.planes - 1) * ratio, config.prior_reach / ratio
    mine, theirs = (np.where(d > 0, np.clip(1 / np.maximum(d, 1e-30), low, high), 0).astype(np.float32) for d in (found.depth, surface))
    shown = theirs > 0
    joined = np.where(shown, theirs, mine)
    one, two = slanted(mine), slanted(joined)
    # Where they differ by no more than the refinement moves, there is nothing to ask.
    differ = shown & (mine > 0) & (np.abs(mine - theirs) > 2 * step)
    asked = np.where(differ, joined, 0)
    costs = [refine(full, np.where(differ[..., None], p, 0), asked, span, step, 0, config, reach)[..., 3] for p in (one, two)]
    gain = np.where(differ, costs[0] - costs[1], 0)
    lead = config.surface_lead * cv2.blur(differ.astype(np.float32), (WINDOW, WINDOW))
    taken = shown & (~differ | (cv2.blur(gain, (WINDOW, WINDOW)) > -lead))
    prior = np.where(taken, theirs, mine)
    planes = refine(full, np.where(taken[..., None], two, one), prior, span, step, config.surface_rounds, config, reach, adjacent=False)
    margin = resized_smoothly(rough.hypotheses.margin, mine.shape)
    return _exposed_depth(reference, planes, np.where(taken, np.maximum(margin, SURFACE_MARGIN), margin), step)


EDGE_STEPS = 2.0
"""Steps (of about a pixel of parallax) by which a depth may differ from what its colours say: less would take fine relief."""


def _exposed_depth(reference: View, planes: Map, margin: Map, step: float | None) -> DepthMap:
    """The depth of planes at full size, but where the picture shows nothing; given the step between planes, with edges on the picture's."""
    h, w = planes.shape[:2]
    planes = np.where(blank(reference)[..., None], np.float32(0), planes)
    if step is not None:
        known = planes[..., 0] > 0
        places = np.where(known, planes[..., 0] / np.float32(EDGE_STEPS * step), np.float32(np.nan))
        sharp = sharpened(places, ~known, guide_of(reference, w, h), MEDIAN_RADIUS, 1)
        planes[..., 0] = np.where(known, sharp * np.float32(EDGE_STEPS * step), 0)
    return _depth_map(planes, resized_smoothly(margin, (h, w)))


def estimate_depth(reference: View, sources: Sequence[View], near: float, far: float, config: DepthConfig | None = None) -> DepthMap:
    """Depth of one view alone, before any filter: both passes, without the sources' own depth.

    Parameters and errors as of `sweep_depth`.
    """
    return refine_depth(reference, sources, sweep_depth(reference, sources, near, far, config), (), config)


LEAST_CONFIDENCE = 0.1
"""Even surfaces correlate with nothing, but other views that agree with their depth make it worth something."""


def _depth_map(planes: Map, margin: Map) -> DepthMap:
    inverse, cost = planes[..., 0], planes[..., 3]
    depth = np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-30), 0).astype(np.float32)
    # ZNCC as likelihood, lifted where the aggregation found a clear winner.
    confidence = np.clip((1.0 - cost) * (0.5 + 0.5 * np.clip(4 * margin, 0, 1)), LEAST_CONFIDENCE, 1.0)
    confidence[depth <= 0] = 0
    return DepthMap(depth, confidence.astype(np.float32))
