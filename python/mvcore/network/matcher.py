"""The trained network at work: depth of a posed view, disparity of a rectified pair; one set of weights for both."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from threading import Lock

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import require
from ..geometry.cameras import Camera, relative_map
from .folding import folded
from .model import DisparityNet, Looks
from .weights import load_disparity

Image = NDArray[np.uint8]
Map = NDArray[np.float32]

SHIPPED = Path(__file__).with_name("disparity.safetensors")
"""Weights in the package; MODEL_CARD.md beside them says how they came to be."""
MULTIPLE = 16
"""The network's sides are a multiple of this."""
PLANES = 48
"""Planes of the first stage for a posed view, uniform in inverse depth."""
PIXELS_A_PLANE = 1.9
"""Disparity between planes of the first stage for a rectified pair."""
RECTIFIED = np.array([1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0], np.float32)
"""The relative map of a rectified pair: inverse depth is disparity."""


class Matcher:
    """A disparity network ready for inference.

    Parameters
    ----------
    weights : a safetensors file; by default the one in the package.
    device : ``cpu``, or ``cuda`` where torch has one.
    """

    def __init__(self, weights: Path | None = None, device: str = "cpu") -> None:
        require(device == "cpu" or torch.cuda.is_available(), "device", "cpu, for torch finds no CUDA device", device)
        self.device = torch.device(device)
        self.net: DisparityNet = folded(load_disparity(weights or SHIPPED)).to(self.device)
        self.seen: OrderedDict[bytes, Looks] = OrderedDict()
        """Features of the images looked at last: a view is the source of many others."""
        self._lock = Lock()

    def depth(
        self,
        image: Image,
        camera: Camera,
        sources: Sequence[Image],
        source_cameras: Sequence[Camera],
        near: float,
        far: float,
        planes: int = PLANES,
    ) -> tuple[Map, Map]:
        """Inverse depth and confidence, each (h, w) float32, of a view between z-depths ``near`` and ``far``.

        image, sources : (h, w, 3) uint8 RGB, undistorted. Confidence is the probability of the four planes nearest to the depth, 0 .. 1.
        """
        require(len(sources) == len(source_cameras) >= 1, "sources", "one or more, with a camera each", len(sources))
        require(0 < near < far < np.inf, "near, far", "0 < near < far", f"{near:g}, {far:g}")
        maps = [relative_map(camera, other) for other in source_cameras]
        return self._run([image, *sources], maps, 1 / far, 1 / near, planes)

    def disparity(self, left: Image, right: Image, max_disparity: int, min_disparity: int = 0) -> tuple[Map, Map]:
        """Disparity in pixels and confidence, each (h, w) float32, of the left image of a rectified pair of (h, w, 3) uint8 RGB."""
        require(left.shape == right.shape, "right", f"the shape of left {left.shape}", right.shape)
        require(max_disparity > min_disparity, "max_disparity", f"more than min_disparity ({min_disparity})", max_disparity)
        planes = planes_for(max_disparity - min_disparity)
        return self._run([left, right], [RECTIFIED], float(min_disparity), float(max_disparity), planes)

    @torch.no_grad()
    def _run(self, images: Sequence[Image], maps: Sequence[Map], low: float, high: float, planes: int) -> tuple[Map, Map]:
        h, w = images[0].shape[:2]
        looks = [self._look(i) for i in images]
        ways = [torch.from_numpy(np.ascontiguousarray(m, np.float32))[None].to(self.device) for m in maps]
        ends = [torch.tensor([x], dtype=torch.float32, device=self.device) for x in (low, high)]
        found = self.net.compare(looks, ways, ends[0], ends[1], planes)
        inverse, confidence = (t[0, :h, :w].float().cpu().numpy() for t in (found.inverse, found.confidence))
        return np.ascontiguousarray(inverse.clip(low, high)), np.ascontiguousarray(confidence)

    def _look(self, image: Image) -> Looks:
        """An image's features, alone so that they are the same bits in whatever company."""
        tensor = padded(image)
        key = hashlib.blake2b(tensor.numpy().tobytes(), digest_size=16).digest() + str(tuple(tensor.shape)).encode()
        with self._lock:
            known = self.seen.get(key)
            if known is not None:
                self.seen.move_to_end(key)
                return known
        found = self.net.look(tensor.to(self.device))
        with self._lock:
            self.seen[key] = found
            while len(self.seen) > MOST_SEEN:
                self.seen.popitem(last=False)
        return found


MOST_SEEN = 24
"""Images whose features are kept: those of a rig's neighbourhood, some 5 MB each."""


def planes_for(disparities: float) -> int:
    """Planes of the first stage for a range of disparities in pixels."""
    return int(np.clip(np.ceil(disparities / PIXELS_A_PLANE) + 1, 16, 128))


def padded(image: Image) -> Tensor:
    """(1, 3, H, W) uint8 with the last row and column repeated up to a multiple of `MULTIPLE`: pixels keep their coordinates."""
    require(image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8, "image", "(h, w, 3) uint8", f"{image.shape} {image.dtype}")
    h, w = image.shape[:2]
    filled = np.pad(image, ((0, -h % MULTIPLE), (0, -w % MULTIPLE), (0, 0)), mode="edge")
    return torch.from_numpy(np.ascontiguousarray(filled.transpose(2, 0, 1)))[None]


@lru_cache(maxsize=2)
def shipped_matcher(device: str = "cpu") -> Matcher:
    """The network with the package's weights, loaded once."""
    return Matcher(None, device)
