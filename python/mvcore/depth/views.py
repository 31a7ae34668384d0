"""Views and their reductions: what the matching sees of the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..config import DepthConfig
from ..geometry.cameras import Camera, relative_map

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


@dataclass(frozen=True)
class Scale:
    """One size of the problem: images (reference first), relative maps there (S, 12) and back, the slope limit, where depth is unwanted.

    ``guide`` are the reference's colours (h, w, 3) uint8, where the sweep runs.
    """

    greys: list[Grey]
    there: Map
    back: Map
    max_slope: float
    unwanted: NDArray[np.bool_] | None = None
    guide: NDArray[np.uint8] | None = None


def pyramid(reference: View, sources: Sequence[View], config: DepthConfig) -> list[Scale]:
    """The scales of a view from the coarsest to the full one."""
    scales = []
    for w, h in _scales(reference.camera.width, reference.camera.height, config.coarsest):
        share = w / reference.camera.width
        mine = reference.at(w, h)
        theirs = [s.at(max(2, round(s.camera.width * share)), max(2, round(s.camera.height * share))) for s in sources]
        there = np.stack([relative_map(mine.camera, s.camera) for s in theirs])
        back = np.stack([relative_map(s.camera, mine.camera) for s in theirs])
        slope = float(np.tan(np.radians(config.max_slant)) / mine.camera.K[0, 0])
        guide = None if scales else guide_of(reference, w, h)
        scales.append(Scale([mine.grey, *(s.grey for s in theirs)], there, back, slope, _unwanted(reference.mask, w, h), guide))
    return scales


def guide_of(view: View, width: int, height: int) -> NDArray[np.uint8]:
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


UNEXPOSED, BURNT = 10, 250
"""Grey levels below and above which a pixel and all around it show the camera's noise and nothing else."""
BURNT_WINDOW = 31
"""Pixels a side of the window that is burnt out throughout: into a glint on a helmet the depth around it continues well enough."""


def blank(view: View) -> NDArray[np.bool_]:
    """Where nothing can be matched, (h, w) bool: black (night, a black cloth, the border that undistortion leaves) or burnt out."""
    channels = [view.grey] if view.colour is None else cv2.split(view.colour)
    brightest, darkest = np.maximum.reduce(channels), np.minimum.reduce(channels)
    black = cv2.dilate(brightest, np.ones((3, 3), np.uint8)) < UNEXPOSED
    burnt = cv2.erode(darkest, np.ones((BURNT_WINDOW, BURNT_WINDOW), np.uint8)) > BURNT
    return np.asarray(black | burnt)


def resized_nearest(depth: Map, shape: tuple[int, ...]) -> Map:
    """A map at another size, without new values."""
    h, w = shape
    return depth if depth.shape == (h, w) else cv2.resize(depth, (w, h), interpolation=cv2.INTER_NEAREST)


def resized_smoothly(values: Map, shape: tuple[int, ...]) -> Map:
    """A map at another size, interpolated."""
    h, w = shape
    return values if values.shape == (h, w) else cv2.resize(values, (w, h), interpolation=cv2.INTER_LINEAR)
