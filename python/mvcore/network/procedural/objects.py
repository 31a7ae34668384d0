"""Procedural targets seen from any side: what the recognition head learns to tell apart."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ... import _core
from ...geometry.cameras import Camera
from .photometry import through_a_camera
from .shapes import Shape, random_rotation, random_shape
from .textures import octaves, random_tile

SIZE = 64
"""Pixels of a side of the images that recognition works on."""
DISTANCE = 4.0
FOCAL = 1.5
"""In image widths."""


class TrainingObject:
    """A body of three to six textured shapes; equal for equal ``seed`` and ``held_out`` (the families it is made of)."""

    def __init__(self, seed: int, held_out: bool) -> None:
        random = np.random.default_rng((seed, 11, int(held_out)))
        self.shapes: list[Shape] = []
        for n in range(int(random.integers(3, 7))):
            size = (0.75 if n == 0 else random.uniform(0.25, 0.55)) * np.exp(random.normal(0, 0.25, 3))
            place = np.zeros(3) if n == 0 else random.normal(0, 0.45, 3)
            self.shapes.append(random_shape(random, held_out).placed(np.minimum(size, 1.0), random_rotation(random), place))
        tiles = [random_tile(random, held_out) for _ in self.shapes]
        self.tiles = np.stack([*tiles, tiles[0]])
        self.gloss = np.tile(np.array([0.45, 0.7, 0.15, 30.0, 0.0], np.float32), (len(self.shapes), 1))

    def photograph(self, azimuth: float, elevation: float, random: np.random.Generator, size: int = SIZE) -> NDArray[np.uint8]:
        """(size, size, 3) uint8 from a side given in radians, on a background, with light and camera drawn from ``random``."""
        direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rotation = np.stack([right, np.cross(-direction, right), -direction])
        center = direction * DISTANCE * random.uniform(0.9, 1.15)
        middle = (2 * size - 1) / 2 + random.normal(0, 0.04, 2) * 2 * size
        K = np.array([[FOCAL * 2 * size, 0, middle[0]], [0, FOCAL * 2 * size, middle[1]], [0, 0, 1]])
        camera = Camera(K, rotation, -rotation @ center, 2 * size, 2 * size)
        first = np.cumsum([0, *(len(s.vertices) for s in self.shapes)])
        vertices = np.concatenate([s.vertices for s in self.shapes])
        faces = np.concatenate([s.faces + np.uint32(n) for s, n in zip(self.shapes, first[:-1], strict=True)])
        materials = np.concatenate([np.full(len(s.faces), n, np.uint16) for n, s in enumerate(self.shapes)])
        uv = np.concatenate([s.uv for s in self.shapes]).astype(np.float32)
        normals = np.concatenate([s.normals for s in self.shapes]).astype(np.float32)
        p = np.ascontiguousarray(camera.projection)
        lamp = (random.normal(0, 2, 3) + np.array([0, 0, 5])).tolist()
        image = _core.shade(vertices, faces, uv, normals, materials, self.tiles, self.gloss, p[None], lamp, 2 * size, 2 * size, 1)[0]
        inside = _core.rasterize(vertices, faces, p, 2 * size, 2 * size)[0] > 0
        behind = cv2.resize(octaves(random), (2 * size, 2 * size))
        colours = random.uniform(0, 255, (2, 3))
        share = np.clip((behind - behind.min()) / max(float(np.ptp(behind)), 1e-6), 0, 1)[..., None]
        image = np.where(inside[..., None], image, (colours[0] * share + colours[1] * (1 - share)).astype(np.uint8))
        small = cv2.resize(image.astype(np.uint8), (size, size), interpolation=cv2.INTER_AREA)
        return through_a_camera(small, random)
