"""Depth maps: plane sweep, semi-global aggregation, slanted refinement, and consistency across views.

Two matchers find a view's rough depth: ``sgm`` is the classical one; in ``dcnn`` what the network finds is one more term of
its costs. Either goes coarse to fine: the sweep and the aggregation run on a small image, where they see the most context;
planes are then refined on it and on each finer scale up to the full size. A rectified pair is the same code with horizontal
homographies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from . import _core
from .cameras import Camera, relative_map
from .config import MATCHERS, DepthConfig
from .errors import require
from .types import DepthMap

Grey = NDArray[np.uint8]
Map = NDArray[np.float32]


@dataclass(frozen=True)
class View:
    """An undistorted grey image, (h, w) uint8, with its camera; the network wants the colours, (h, w, 3) uint8, as well.

    ``mask``, (h, w) uint8, is non-zero where depth is wanted; elsewhere, but for a margin, it is not looked for on the fine scales.
    """

    grey: Grey
    camera: Camera
    colour: NDArray[np.uint8] | None = None
    mask: NDArray[np.uint8] | None = None

    def at(self, width: int, height: int) -> View:
        """The view reduced to another size."""
        if self.grey.shape == (height, width):
            return self
        grey = cv2.resize(self.grey, (width, height), interpolation=cv2.INTER_AREA)
        return View(grey, self.camera.resized(width, height))


def _scales(width: int, height: int, coarsest: int) -> list[tuple[int, int]]:
    """Sizes from the coarsest to the full one, each half of the next."""
    sizes = [(width, height)]
    while max(sizes[0]) >= 1.5 * coarsest:
        w, h = sizes[0]
        sizes.insert(0, ((w + 1) // 2, (h + 1) // 2))
    return sizes


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


@dataclass(frozen=True)
class _Scale:
    """One size of the problem: images (reference first), relative maps there (S, 12) and back, the slope limit, where depth is unwanted.

    ``guide`` are the reference's colours (h, w, 3) uint8, where the sweep runs.
    """

    greys: list[Grey]
    there: Map
    back: Map
    max_slope: float
    unwanted: NDArray[np.bool_] | None = None
    guide: NDArray[np.uint8] | None = None


LEAST_CONFIDENCE = 0.1
"""Even surfaces correlate with nothing, but other views that agree with their depth make it worth something."""
NO_DEPTHS: list[Map] = []
NO_BACKS = np.zeros((0, 12), np.float32)


def _refine(
    scale: _Scale,
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
class _Hypotheses:
    """Inverse-depth planes (h, w, 4) on one scale, with the semi-global solution and its margin on the coarsest."""

    planes: Map
    prior: Map
    margin: Map
    span: tuple[float, float]
    step: float


@dataclass(frozen=True)
class _Expected:
    """Inverse depth that the network found, (h, w) float32, and how sure it is of it, 0 .. 1."""

    inverse: Map
    confidence: Map


def _aggregated(
    scale: _Scale, low: float, high: float, planes: int, config: DepthConfig, expected: _Expected | None = None
) -> tuple[Map, Map]:
    """Inverse depth and margin of the semi-global solution among ``planes`` planes."""
    inverse = np.linspace(low, high, planes, dtype=np.float32)
    costs = _core.sweep(scale.greys[0], scale.greys[1:], scale.there, inverse)
    if expected is not None:
        place = (expected.inverse - np.float32(low)) / (inverse[1] - inverse[0])
        _core.expect(costs, place, expected.confidence, config.network_weight, config.network_reach)
    index, margin = _core.aggregate(costs, scale.greys[0], config.p1, config.p2, config.p2_falloff)
    if scale.guide is not None and config.edge_radius:
        index = _sharpened(index, np.zeros(index.shape, np.uint8), scale.guide, config.edge_radius, 1)
    return (low + index * float(inverse[1] - inverse[0])).astype(np.float32), margin


def _sharpened(values: Map, doubtful: NDArray[Any], guide: NDArray[np.uint8], radius: int, rounds: int) -> Map:
    """Disparities, or places among planes, with their edges on the picture's: windows that straddle an edge fatten what is in front.

    What is doubtful is replaced anyhow, the rest where it errs by more than one.
    """
    guide, doubtful = np.ascontiguousarray(guide), np.asarray(doubtful, np.uint8)
    for _ in range(rounds):
        values = _core.weighted_median(
            values, guide, doubtful, radius=radius, step=min(2, radius), colour=10.0, distance=0.6 * radius, slack=1.0
        )
    return values


def _sweep(scale: _Scale, low: float, high: float, planes: int, config: DepthConfig, expected: _Expected | None = None) -> _Hypotheses:
    """Sweep, aggregate, refine at one scale."""
    prior, margin = _aggregated(scale, low, high, planes, config, expected)
    return _refined(scale, _start(prior), prior, margin, (low, high), (high - low) / (planes - 1), config)


def _start(inverse: Map) -> Map:
    """Slanted planes (h, w, 4) through a map of inverse depths."""
    a, b = _slopes(inverse)
    return np.stack([inverse, a, b, np.zeros_like(a)], -1)


def _refined(
    scale: _Scale, start: Map, prior: Map, margin: Map, span: tuple[float, float], step: float, config: DepthConfig
) -> _Hypotheses:
    refined = _refine(scale, start, prior, span, step, config.sweep_rounds, config, config.prior_reach)
    return _Hypotheses(refined, prior, margin, span, step)


def _finer(
    coarse: _Hypotheses, scale: _Scale, rounds: int, config: DepthConfig, depths: list[Map] = NO_DEPTHS, adjacent: bool = True
) -> _Hypotheses:
    """The hypotheses on a finer (or the same) scale, refined there."""
    h, w = scale.greys[0].shape
    planes = coarse.planes if coarse.planes.shape[:2] == (h, w) else _upsample(coarse.planes, w, h)
    prior = cv2.resize(coarse.prior, (w, h), interpolation=cv2.INTER_LINEAR)
    if scale.unwanted is not None:
        planes, prior = planes.copy(), np.where(scale.unwanted, np.float32(0), prior)
        planes[scale.unwanted] = 0
    # One pixel of parallax is half as much inverse depth on an image twice as large.
    ratio = coarse.prior.shape[1] / w
    planes = _refine(scale, planes, prior, coarse.span, coarse.step * ratio, rounds, config, config.prior_reach / ratio, depths, adjacent)
    return replace(coarse, planes=planes)


def _pyramid(reference: View, sources: Sequence[View], config: DepthConfig) -> list[_Scale]:
    scales = []
    for w, h in _scales(reference.camera.width, reference.camera.height, config.coarsest):
        share = w / reference.camera.width
        mine = reference.at(w, h)
        theirs = [s.at(max(2, round(s.camera.width * share)), max(2, round(s.camera.height * share))) for s in sources]
        there = np.stack([relative_map(mine.camera, s.camera) for s in theirs])
        back = np.stack([relative_map(s.camera, mine.camera) for s in theirs])
        slope = float(np.tan(np.radians(config.max_slant)) / mine.camera.K[0, 0])
        guide = None if scales else _guide(reference, w, h)
        scales.append(_Scale([mine.grey, *(s.grey for s in theirs)], there, back, slope, _unwanted(reference.mask, w, h), guide))
    return scales


def _guide(view: View, width: int, height: int) -> NDArray[np.uint8]:
    """A view's colours, reduced; its grey levels where it has none."""
    colours = view.colour if view.colour is not None else np.repeat(view.grey[..., None], 3, 2)
    return colours if colours.shape[:2] == (height, width) else cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)


MARGIN = 12
"""Pixels around a mask in which depth is looked for as well: what is found there spreads inwards."""


def _unwanted(mask: NDArray[np.uint8] | None, width: int, height: int) -> NDArray[np.bool_] | None:
    if mask is None:
        return None
    inside = cv2.resize((mask > 0).astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return cv2.dilate(inside, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)) == 0


def _check(sources: Sequence[View], near: float, far: float) -> None:
    require(len(sources) >= 1, "sources", "at least one view", "none")
    require(0 < near < far < np.inf, "near, far", "0 < near < far", f"{near:g}, {far:g}")


@dataclass(frozen=True)
class RoughDepth:
    """A view's depth from photographs alone, at half the size: what `refine_depth` starts from."""

    hypotheses: _Hypotheses

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """All of it by name, to be stored."""
        h = self.hypotheses
        return {"planes": h.planes, "prior": h.prior, "margin": h.margin, "search": np.array([*h.span, h.step], np.float64)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.float32]]) -> RoughDepth:
        """What `arrays` gave."""
        low, high, step = map(float, arrays["search"])
        return cls(_Hypotheses(arrays["planes"], arrays["prior"], arrays["margin"], (low, high), step))

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
    coarsest, *finer = _pyramid(reference, sources, config)
    return _carried(_sweep(coarsest, 1 / far, 1 / near, config.planes, config), finer, config)


def _carried(found: _Hypotheses, finer: Sequence[_Scale], config: DepthConfig) -> RoughDepth:
    """A first pass brought from the coarsest scale up to half the size."""
    for scale in finer[:-1]:
        found = _finer(found, scale, config.rounds, config)
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
    coarsest, *finer = _pyramid(reference, sources, config)
    h, w = coarsest.greys[0].shape
    start = cv2.resize(seed, (w, h), interpolation=cv2.INTER_NEAREST)
    expected = start > 0
    if not expected.any():
        return sweep_depth(reference, sources, near, far, config)
    inverse = np.clip(1 / _filled(start), 1 / far, 1 / near).astype(np.float32)
    span, step = (1 / far, 1 / near), (1 / near - 1 / far) / (config.planes - 1)
    margin = np.full((h, w), 0.25, np.float32)
    planes = max(2, config.planes // 2)
    swept, sweep_margin = _aggregated(coarsest, *span, planes, config)
    one, two = (_start(p) for p in (inverse, swept))
    costs = [_refine(coarsest, s, p, span, step, 0, config, config.prior_reach)[..., 3] for s, p in ((one, inverse), (two, swept))]
    better = ~expected | (costs[1] < costs[0])
    prior = np.where(better, swept, inverse)
    found = _refined(coarsest, np.where(better[..., None], two, one), prior, np.where(better, sweep_margin, margin), span, step, config)
    return _carried(found, finer, config)


def _filled(depth: Map) -> Map:
    """The nearest known depth where none is."""
    _, label = cv2.distanceTransformWithLabels((depth <= 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    known = np.zeros(int(label.max()) + 1, np.float32)
    known[label[depth > 0]] = depth[depth > 0]
    return known[label]


NETWORK_SIDE = 576
"""Pixels of the longer side at which the network runs: about what it was trained on; the second pass carries that to full size."""


def network_depth(
    reference: View, sources: Sequence[View], near: float, far: float, config: DepthConfig | None = None, device: str = "cpu"
) -> RoughDepth:
    """First pass with the network: what it finds is a term of the sweep's costs, so that both must err for a pixel to be wrong.

    Parameters and errors as of `sweep_depth`; views need colours; ``device`` is ``cpu`` or ``cuda``.
    """
    from .network.match import shipped_matcher

    config = config or DepthConfig()
    _check(sources, near, far)
    share = min(1.0, NETWORK_SIDE / max(reference.grey.shape))
    images, cameras = zip(*(_coloured(v, n, share) for n, v in enumerate([reference, *sources[:NETWORK_SOURCES]])), strict=True)
    inverse, confidence = shipped_matcher(device).depth(images[0], cameras[0], images[1:], cameras[1:], near, far)
    coarsest, *finer = _pyramid(reference, sources, config)
    h, w = coarsest.greys[0].shape
    expected = _Expected(
        cv2.resize(inverse, (w, h), interpolation=cv2.INTER_NEAREST), cv2.resize(confidence, (w, h), interpolation=cv2.INTER_LINEAR)
    )
    return _carried(_sweep(coarsest, 1 / far, 1 / near, config.planes, config, expected), finer, config)


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
    half, full = ([None, *_pyramid(reference, sources, config)])[-2:]
    if half is not None and len(rough_sources):
        depths = [_resized(r.depth, grey.shape) for r, grey in zip(rough_sources, half.greys[1:], strict=True)]
        found = _finer(found, half, config.geometry_rounds, config, depths)
    # At full size each view is on its own again: errors that views hand to each other would pass the filter together.
    # It would cost a quarter more to try adjacent planes here, and they are the same as often as not.
    found = _finer(found, full, config.rounds, config, adjacent=False)
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
    scales = _pyramid(reference, sources, config)
    full, ratio = scales[-1], scales[0].greys[0].shape[1] / reference.grey.shape[1]
    low, high = span = rough.hypotheses.span
    step, reach = (high - low) / (config.planes - 1) * ratio, config.prior_reach / ratio
    mine, theirs = (np.where(d > 0, np.clip(1 / np.maximum(d, 1e-30), low, high), 0).astype(np.float32) for d in (found.depth, surface))
    shown = theirs > 0
    joined = np.where(shown, theirs, mine)
    one, two = _start(mine), _start(joined)
    # Where they differ by no more than the refinement moves, there is nothing to ask.
    differ = shown & (mine > 0) & (np.abs(mine - theirs) > 2 * step)
    asked = np.where(differ, joined, 0)
    costs = [_refine(full, np.where(differ[..., None], p, 0), asked, span, step, 0, config, reach)[..., 3] for p in (one, two)]
    gain = np.where(differ, costs[0] - costs[1], 0)
    lead = config.surface_lead * cv2.blur(differ.astype(np.float32), (WINDOW, WINDOW))
    taken = shown & (~differ | (cv2.blur(gain, (WINDOW, WINDOW)) > -lead))
    prior = np.where(taken, theirs, mine)
    planes = _refine(full, np.where(taken[..., None], two, one), prior, span, step, config.surface_rounds, config, reach, adjacent=False)
    margin = _resized_smoothly(rough.hypotheses.margin, mine.shape)
    return _exposed_depth(reference, planes, np.where(taken, np.maximum(margin, SURFACE_MARGIN), margin), step)


EDGE_STEPS = 2.0
"""Steps (of about a pixel of parallax) by which a depth may differ from what its colours say: less would take fine relief."""


def _exposed_depth(reference: View, planes: Map, margin: Map, step: float | None) -> DepthMap:
    """The depth of planes at full size, but where the picture shows nothing; given the step between planes, with edges on the picture's."""
    h, w = planes.shape[:2]
    planes = np.where(_blank(reference)[..., None], np.float32(0), planes)
    if step is not None:
        known = planes[..., 0] > 0
        places = np.where(known, planes[..., 0] / np.float32(EDGE_STEPS * step), np.float32(np.nan))
        sharp = _sharpened(places, ~known, _guide(reference, w, h), MEDIAN_RADIUS, 1)
        planes[..., 0] = np.where(known, sharp * np.float32(EDGE_STEPS * step), 0)
    return _depth_map(planes, _resized_smoothly(margin, (h, w)))


UNEXPOSED, BURNT = 10, 250
"""Grey levels below and above which a pixel and all around it show the camera's noise and nothing else."""
BURNT_WINDOW = 9
"""Pixels a side of the window that is burnt out throughout: a glint is smaller, and its rim can be matched."""


def _blank(view: View) -> NDArray[np.bool_]:
    """Where nothing can be matched: black (night, a black cloth, the border that undistortion leaves) or burnt out (a lamp, the sky)."""
    channels = [view.grey] if view.colour is None else cv2.split(view.colour)
    brightest, darkest = np.maximum.reduce(channels), np.minimum.reduce(channels)
    black = cv2.dilate(brightest, np.ones((3, 3), np.uint8)) < UNEXPOSED
    burnt = cv2.erode(darkest, np.ones((BURNT_WINDOW, BURNT_WINDOW), np.uint8)) > BURNT
    return np.asarray(black | burnt)


def estimate_depth(reference: View, sources: Sequence[View], near: float, far: float, config: DepthConfig | None = None) -> DepthMap:
    """Depth of one view alone, before any filter: both passes, without the sources' own depth.

    Parameters and errors as of `sweep_depth`.
    """
    return refine_depth(reference, sources, sweep_depth(reference, sources, near, far, config), (), config)


def _resized(depth: Map, shape: tuple[int, ...]) -> Map:
    h, w = shape
    return depth if depth.shape == (h, w) else cv2.resize(depth, (w, h), interpolation=cv2.INTER_NEAREST)


def _resized_smoothly(values: Map, shape: tuple[int, ...]) -> Map:
    h, w = shape
    return values if values.shape == (h, w) else cv2.resize(values, (w, h), interpolation=cv2.INTER_LINEAR)


def _depth_map(planes: Map, margin: Map) -> DepthMap:
    inverse, cost = planes[..., 0], planes[..., 3]
    depth = np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-30), 0).astype(np.float32)
    # ZNCC as likelihood, lifted where the aggregation found a clear winner.
    confidence = np.clip((1.0 - cost) * (0.5 + 0.5 * np.clip(4 * margin, 0, 1)), LEAST_CONFIDENCE, 1.0)
    confidence[depth <= 0] = 0
    return DepthMap(depth, confidence.astype(np.float32))


def filter_depth(
    index: int, depths: Sequence[DepthMap], cameras: Sequence[Camera], others: Sequence[int], config: DepthConfig | None = None
) -> tuple[DepthMap, NDArray[np.uint8]]:
    """Depth of view ``index`` that other views agree with, and by how many: the dynamic rule of D2HC-RMVSNet."""
    config = config or DepthConfig()
    mine, camera = depths[index], cameras[index]
    others = list(others)[:32]
    there = np.array([relative_map(camera, cameras[j]) for j in others], np.float32).reshape(-1, 12)
    back = np.array([relative_map(cameras[j], camera) for j in others], np.float32).reshape(-1, 12)
    kept, support = _core.consistency(
        mine.depth,
        [depths[j].depth for j in others],
        there,
        back,
        min(config.min_views, max(1, len(others))),
        config.pixel_unit,
        config.depth_unit,
    )
    return DepthMap(kept, np.where(kept > 0, mine.confidence, 0).astype(np.float32)), support


def disparity(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    *,
    max_disparity: int,
    min_disparity: int = 0,
    config: DepthConfig | None = None,
    fill: bool = True,
    matcher: str = "sgm",
    device: str = "cpu",
) -> tuple[Map, Map]:
    """Disparity of the left image of a rectified pair.

    Parameters
    ----------
    left, right : (h, w) or (h, w, 3) uint8, the same size.
    max_disparity, min_disparity : pixels; a point at column x of the left image stands at x - d of the right one.
    fill : replace what the right image does not confirm by the surrounding background; otherwise it is 0.
    matcher : ``sgm``, or ``dcnn`` for the network beside it.
    device : ``cpu`` or ``cuda``, of the network.

    Returns
    -------
    disparity, confidence : (h, w) float32, pixels and 0 .. 1.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> right = rng.integers(0, 255, (60, 120), np.uint8)
    >>> left = np.roll(right, 7, axis=1)
    >>> d, _ = disparity(left, right, max_disparity=16)
    >>> bool(abs(np.median(d[:, 30:]) - 7) < 0.1)
    True
    """
    config = config or DepthConfig()
    images = [_grey("left", left), _grey("right", right)]
    require(images[0].shape == images[1].shape, "right", f"the size of left {images[0].shape}", images[1].shape)
    require(max_disparity > min_disparity, "max_disparity", f"more than min_disparity ({min_disparity})", max_disparity)
    require(matcher in MATCHERS, "matcher", f"one of {', '.join(MATCHERS)}", repr(matcher))
    expected = _expected((left, right), min_disparity, max_disparity, device) if matcher == "dcnn" else None
    mine = _rectified(images[0], images[1], min_disparity, max_disparity, config, expected)
    flipped = [np.ascontiguousarray(i[:, ::-1]) for i in (images[1], images[0])]
    theirs = _rectified(*flipped, min_disparity, max_disparity, config)
    d = mine[..., 0]
    seen = _confirmed(d, theirs[:, ::-1, 0]) & ~_speckles(d)
    cost = mine[..., 3]
    confidence = np.where(seen, np.clip(1 - cost, 0.02, 1), 0.01).astype(np.float32)
    found = _sharpened(_fill_occlusions(d, seen, images[0]), ~seen, _three_channels(left), MEDIAN_RADIUS, MEDIAN_ROUNDS)
    return found if fill else np.where(seen, found, 0).astype(np.float32), confidence


MEDIAN_RADIUS, MEDIAN_ROUNDS = 10, 2
"""Of the weighted median at full size; the second round of disparities gains half as much as the first, a third hardly anything."""


def _confirmed(d: Map, other: Map) -> NDArray[np.bool_]:
    """Where the right image's disparity agrees within a pixel with the left one's that points at it."""
    x = np.arange(d.shape[1])[None] - d
    near = np.clip(np.rint(x).astype(int), 0, d.shape[1] - 1)
    return np.asarray((np.abs(np.take_along_axis(other, near, 1) - d) <= 1.0) & (x >= -0.5))


SPECKLE = 32
"""Pixels of the largest patch that is taken for chance when its disparity stands off from all around it by more than one."""


def _speckles(d: Map) -> NDArray[np.bool_]:
    """Small patches on their own: both images may agree on them by chance."""
    unit = min(16.0, 30000 / max(1.0, float(np.abs(d).max())))
    fixed = np.rint(d * unit).astype(np.int16)
    most = min(SPECKLE, d.size // 8)
    marked, _ = cv2.filterSpeckles(fixed, -(1 << 15), most, round(unit))
    return np.asarray(marked == -(1 << 15))


PAIR_SIDE = 1024
"""Pixels of the longer side at which the network sees a rectified pair: memory and time stay bounded, the sweep sees all of it."""


def _expected(pair: Sequence[NDArray[np.uint8]], low: int, high: int, device: str) -> _Expected:
    """What the network finds in a pair."""
    from .network.match import shipped_matcher

    views = [_three_channels(i) for i in pair]
    h, w = views[0].shape[:2]
    share = min(1.0, PAIR_SIDE / max(h, w))
    size = (max(2, round(w * share)), max(2, round(h * share)))
    if share < 1:
        views = [cv2.resize(v, size, interpolation=cv2.INTER_AREA) for v in views]
    ratio = size[0] / w
    ends = int(np.ceil(high * ratio)), int(np.floor(low * ratio))
    found, confidence = shipped_matcher(device).disparity(views[0], views[1], *ends)
    inverse = _resized(found, (h, w)) / np.float32(ratio)
    return _Expected(inverse, cv2.resize(confidence, (w, h), interpolation=cv2.INTER_LINEAR))


def _three_channels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = np.asarray(image)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)


def _grey(name: str, image: NDArray[np.uint8]) -> Grey:
    image = np.asarray(image)
    require(image.dtype == np.uint8, name, "uint8 values", image.dtype)
    require(image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3), name, "shape (h, w) or (h, w, 3)", image.shape)
    require(min(image.shape[:2]) >= 2, name, "at least 2 x 2 pixels", image.shape)
    return np.ascontiguousarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


RECTIFIED = np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0]], np.float32)
"""The relative map of a rectified pair: inverse depth is disparity."""


def _rectified(left: Grey, right: Grey, low: int, high: int, config: DepthConfig, expected: _Expected | None = None) -> Map:
    # A pair's sweep runs at full size: its ranges are short and its details fine.
    scale = _Scale([left, right], RECTIFIED, NO_BACKS, 1.0)
    return _sweep(scale, float(low), float(high), high - low + 1, config, expected).planes


def _fill_occlusions(d: Map, seen: NDArray[np.bool_], guide: Grey) -> Map:
    """What one image alone shows lies behind: take the lower of the nearest confirmed disparities left and right."""
    h, w = d.shape
    columns = np.broadcast_to(np.arange(w), (h, w))
    left = np.maximum.accumulate(np.where(seen, columns, -1), 1)
    right = np.minimum.accumulate(np.where(seen, columns, w)[:, ::-1], 1)[:, ::-1]
    at_left = np.where(left >= 0, np.take_along_axis(d, left.clip(0), 1), np.inf)
    at_right = np.where(right < w, np.take_along_axis(d, right.clip(None, w - 1), 1), np.inf)
    lower = np.minimum(at_left, at_right)
    filled = np.where(seen | ~np.isfinite(lower), d, lower).astype(np.float32)
    smooth = cv2.medianBlur(filled, 5)
    return np.where(seen, filled, smooth).astype(np.float32)
