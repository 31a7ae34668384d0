"""Random tiles of colour in families: some for training, others only for validation."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ... import _core

Random = np.random.Generator
Tile = NDArray[np.uint8]
SIDE = 256
"""Texels a side."""


def _colour(random: Random) -> tuple[int, int, int]:
    r, g, b = (int(c) for c in random.integers(10, 246, 3))
    return r, g, b


def octaves(random: Random, roughness: float | None = None) -> NDArray[np.float32]:
    """Noise of several octaves, (SIDE, SIDE) float32 in 0 .. 1, that repeats seamlessly."""
    roughness = random.uniform(0.4, 1.0) if roughness is None else roughness
    total = np.zeros((SIDE, SIDE), np.float32)
    for k in range(int(random.integers(0, 4)), 8):
        n = 2 ** (k + 1)
        coarse = random.random((min(n, SIDE), min(n, SIDE)), np.float32)
        wide = cv2.copyMakeBorder(coarse, 2, 2, 2, 2, cv2.BORDER_WRAP)
        scale = SIDE // coarse.shape[0]
        fine = cv2.resize(wide, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        total += roughness**k * fine[2 * scale : 2 * scale + SIDE, 2 * scale : 2 * scale + SIDE]
    low, high = total.min(), total.max()
    return (total - low) / max(high - low, 1e-6)


def _between(value: NDArray[np.float32], random: Random, stops: int = 3) -> Tile:
    """Values 0 .. 1 through a random ramp of colours."""
    ramp = np.array([_colour(random) for _ in range(stops)], np.float32)
    at = np.clip(value, 0, 1) * (stops - 1)
    low = np.minimum(at.astype(int), stops - 2)
    f = (at - low)[..., None]
    return (ramp[low] * (1 - f) + ramp[low + 1] * f).astype(np.uint8)


def _noise(random: Random) -> Tile:
    return _between(octaves(random), random, int(random.integers(2, 6)))


def _dead_leaves(random: Random) -> Tile:
    tile = np.empty((SIDE, SIDE, 3), np.uint8)
    tile[:] = _colour(random)
    palette = [_colour(random) for _ in range(int(random.integers(2, 12)))]
    for _ in range(int(random.integers(80, 500))):
        r = 2.5 * (1 - random.random()) ** -0.7
        x, y = random.integers(0, SIDE, 2).tolist()
        colour = palette[random.integers(len(palette))]
        if random.random() < 0.5:
            axes = (max(1, int(min(r, 90))), max(1, int(min(r * random.uniform(0.3, 1), 90))))
            cv2.ellipse(tile, (x, y), axes, random.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA)
        else:
            angles = np.sort(random.uniform(0, 2 * np.pi, random.integers(3, 7)))
            points = np.stack([x + r * np.cos(angles), y + r * np.sin(angles)], -1)
            cv2.fillPoly(tile, [np.clip(points, -300, 600).astype(np.int32)], colour, cv2.LINE_AA)
    shade = octaves(random, 0.6)[..., None] * random.uniform(0, 0.5)
    return (tile * (1 - shade)).astype(np.uint8)


def _stripes(random: Random) -> Tile:
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32) / SIDE
    across = random.integers(1, 24) * x + random.integers(0, 24) * y + random.uniform(0, 2) * octaves(random, 0.5)
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * across)
    if random.random() < 0.5:
        wave = (wave > 0.5).astype(np.float32)
    return _between((wave + random.uniform(0, 0.3) * octaves(random)).astype(np.float32), random, 2)


def _text(random: Random) -> Tile:
    tile = np.empty((SIDE, SIDE, 3), np.uint8)
    tile[:] = _colour(random)
    letters = "ABCDEFGHKLMNPRSTUVWXYZabcdefghkmnprstuvwxyz0123456789&%#?"
    size = random.uniform(0.3, 1.4)
    for row in range(int(30 * size), SIDE + 20, max(8, int(30 * size))):
        word = "".join(letters[random.integers(len(letters))] for _ in range(40))
        font = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX)[random.integers(3)]
        cv2.putText(tile, word, (-5, row), font, size, _colour(random), int(random.integers(1, 4)), cv2.LINE_AA)
    return tile


def _checks(random: Random) -> Tile:
    n = int(2 ** random.integers(1, 6))
    values = random.random((n, n), np.float32) if random.random() < 0.6 else (np.indices((n, n)).sum(0) % 2).astype(np.float32)
    return _between(cv2.resize(values, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST), random, 3)


def _voronoi(random: Random) -> Tile:
    seeds = random.integers(0, SIDE, (int(random.integers(20, 200)), 2))
    marks = np.zeros((SIDE, SIDE), np.uint8)
    marks[seeds[:, 0], seeds[:, 1]] = 1
    squared, nearest = _core.distance_transform(marks)
    distance, label = np.sqrt(squared), np.searchsorted(np.flatnonzero(marks), nearest)
    palette = random.integers(10, 246, (int(marks.sum()), 3))
    return (palette[label] * (1 - 0.5 * (distance / distance.max())[..., None])).astype(np.uint8)


def _rings(random: Random) -> Tile:
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32) / SIDE
    r = np.hypot(x - random.random(), 4 * (y - random.random())) + 0.2 * octaves(random, 0.5)
    return _between((0.5 + 0.5 * np.sin(random.uniform(20, 90) * r)).astype(np.float32), random, 3)


TRAINING: tuple[Callable[[Random], Tile], ...] = (_dead_leaves, _dead_leaves, _noise, _noise, _stripes, _text, _checks)
HELD_OUT: tuple[Callable[[Random], Tile], ...] = (_voronoi, _rings)
WEAK = 0.2
"""Share of surfaces with hardly any texture."""


def random_tile(random: Random, held_out: bool) -> Tile:
    """A (SIDE, SIDE, 3) uint8 tile from the training or the held-out families."""
    if random.random() < WEAK:
        faint = random.uniform(0, 12) * (octaves(random)[..., None] - 0.5)
        return np.clip(np.array(_colour(random), np.float32) + faint, 0, 255).astype(np.uint8)
    families = HELD_OUT if held_out else TRAINING
    return families[random.integers(len(families))](random)
