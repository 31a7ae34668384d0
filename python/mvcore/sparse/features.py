"""SIFT features and their matches along known epipolar lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..geometry.cameras import Camera
from ..geometry.epipolar import Float
from ..types import Image


@dataclass(frozen=True)
class Features:
    """positions : (n, 2) float32 pixels. descriptors : (n, 128) uint8."""

    positions: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def detect(image: Image, mask: NDArray[np.uint8] | None, limit: int) -> Features:
    """SIFT features of an image, inside the mask (non-zero) if there is one."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    found, descriptors = cv2.SIFT_create(nfeatures=limit, contrastThreshold=0.02).detectAndCompute(grey, mask)
    if descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    positions = np.array([k.pt for k in found], np.float32).reshape(-1, 2)
    # A corner with two orientations is one place.
    _, first = np.unique(positions, axis=0, return_index=True)
    first.sort()
    return Features(np.ascontiguousarray(positions[first]), np.ascontiguousarray(descriptors[first].astype(np.uint8)))


def candidate_pairs(cameras: Sequence[Camera], neighbours: int) -> list[tuple[int, int]]:
    """Pairs worth matching: each view with those nearest in direction and position that look the same way."""
    centers = np.array([c.center for c in cameras])
    axes = np.array([c.axis for c in cameras])
    spread = np.median(np.linalg.norm(centers - centers.mean(0), axis=1))
    pairs = set()
    for i in range(len(cameras)):
        turn = np.degrees(np.arccos(np.clip(axes @ axes[i], -1, 1)))
        away = np.linalg.norm(centers - centers[i], axis=1) / max(spread, 1e-12)
        rank = turn / 30 + away
        rank[i] = np.inf
        near = [int(j) for j in np.argsort(rank, kind="stable") if j != i and turn[j] < 90 and away[j] > 1e-9]
        pairs |= {(min(i, j), max(i, j)) for j in near[:neighbours]}
    return sorted(pairs)


def match(a: Features, b: Features, f: Float, band: float, ratio: float) -> NDArray[np.uint32]:
    """Mutual matches within ``band`` pixels of the epipolar lines, (m, 2) indices."""
    return _core.match_epipolar(a.positions, a.descriptors, b.positions, b.descriptors, f, band, ratio)
