"""Rectified pairs: the same code with horizontal homographies."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import MATCHERS, DepthConfig
from ..errors import require
from .occlusion import continued
from .planes import MEDIAN_RADIUS, MEDIAN_ROUNDS, NO_BACKS, Expected, sharpened, sweep_scale
from .views import Grey, Map, Scale, resized_nearest


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
    fill : replace what the right image does not confirm by the background's surface beside it; otherwise it is 0.
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
    guide = np.ascontiguousarray(_three_channels(left))
    found = sharpened(continued(d, seen, guide, min_disparity, max_disparity), ~seen, guide, MEDIAN_RADIUS, MEDIAN_ROUNDS)
    confidence = _confidence(found, seen, expected)
    return found if fill else np.where(seen, found, 0).astype(np.float32), confidence


EDGE, JUMP = 4.0, 2.0
"""Pixels from an edge of depth at which confidence has risen to 1 - 1 / e, and the least disparity between neighbours that is one."""
UNSEEN, ALONE = 0.5, 8.0
"""Confidence in what one image alone shows, and the pixels from what both show at which it has halved."""
AGREE = 3.0
"""Disparity between ours and the network's at which confidence has fallen to 1 / e."""


def _confidence(d: Map, seen: NDArray[np.bool_], expected: Expected | None) -> Map:
    """0 .. 1: low at edges of depth and beyond what both images show, where most errors are; what the photographs cost tells less.

    And low where the network is unsure, or sure of something else.
    """
    around = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(d, around) - cv2.erode(d, around) > JUMP
    from_edge, from_seen = (np.sqrt(_core.distance_transform(m.astype(np.uint8))[0], dtype=np.float32) for m in (jump, seen))
    alone = np.where(seen, 1, UNSEEN / (1 + from_seen / ALONE))
    confidence = alone * (1 - np.exp(-(from_edge + 1) / EDGE))
    if expected is not None:
        confidence = confidence * expected.confidence * np.exp(-np.abs(d - expected.inverse) / AGREE)
    return confidence.astype(np.float32)


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


def _expected(pair: Sequence[NDArray[np.uint8]], low: int, high: int, device: str) -> Expected:
    """What the network finds in a pair."""
    from ..network.matcher import shipped_matcher

    views = [_three_channels(i) for i in pair]
    h, w = views[0].shape[:2]
    share = min(1.0, PAIR_SIDE / max(h, w))
    size = (max(2, round(w * share)), max(2, round(h * share)))
    if share < 1:
        views = [cv2.resize(v, size, interpolation=cv2.INTER_AREA) for v in views]
    ratio = size[0] / w
    ends = int(np.ceil(high * ratio)), int(np.floor(low * ratio))
    found, confidence = shipped_matcher(device).disparity(views[0], views[1], *ends)
    inverse = resized_nearest(found, (h, w)) / np.float32(ratio)
    return Expected(inverse, cv2.resize(confidence, (w, h), interpolation=cv2.INTER_LINEAR))


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


def _rectified(left: Grey, right: Grey, low: int, high: int, config: DepthConfig, expected: Expected | None = None) -> Map:
    # A pair's sweep runs at full size: its ranges are short and its details fine.
    scale = Scale([left, right], RECTIFIED, NO_BACKS, 1.0)
    return sweep_scale(scale, float(low), float(high), high - low + 1, config, expected).planes
