"""Procedural scenes with exact depth: rectified pairs and posed views of floating shapes, a room and a ground."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ... import _core
from ...geometry.cameras import Camera, relative_map
from .photometry import through_a_camera
from .shapes import Shape, ground, random_rotation, random_shape, turned, wall
from .textures import SIDE, random_tile

Array = NDArray[np.float64]
Random = np.random.Generator


@dataclass(frozen=True)
class Sample:
    """Views of one scene, the first of them the reference, and the truth in it.

    images : (views, h, w, 3) uint8.
    cameras : one a view.
    inverse : (h, w) float32 inverse depth of the reference, in world units; disparity over baseline and focal length.
    seen : (views - 1, h, w) bool, whether each source sees the reference's surface.
    span : least and greatest inverse depth to search.
    """

    images: NDArray[np.uint8]
    cameras: tuple[Camera, ...]
    inverse: NDArray[np.float32]
    seen: NDArray[np.bool_]
    span: tuple[float, float]


SHINING = 0.25
"""Share of the surfaces that mirror what surrounds the scene: they look different from everywhere."""
STANDING = 0.5
"""Share of the posed scenes in which one body stands on the ground amid the cameras."""


class Tiles:
    """A stock of texture tiles: a tile costs more to make than to look at."""

    def __init__(self, random: Random, held_out: bool, size: int = 160) -> None:
        self.held_out = held_out
        self.stock = [random_tile(random, held_out) for _ in range(size)]

    def draw(self, random: Random, count: int) -> NDArray[np.uint8]:
        """(count, SIDE, SIDE, 3), some with channels shuffled or contrast reduced."""
        tiles = np.empty((count, SIDE, SIDE, 3), np.uint8)
        for out, n in zip(tiles, random.integers(0, len(self.stock), count), strict=True):
            tile = self.stock[n][..., random.permutation(3)]
            out[:] = tile
            if random.random() < 0.3:
                low, high = np.sort(random.uniform(0, 255, 2))
                out[:] = low + tile.astype(np.float32) * np.float32((high - low) / 255)
        return tiles


def _camera(width: int, height: int, focal: float, rotation: Array, center: Array, shift: Array) -> Camera:
    K = np.array([[focal, 0, (width - 1) / 2 + shift[0]], [0, focal, (height - 1) / 2 + shift[1]], [0, 0, 1]])
    return Camera(K, rotation, -rotation @ center, width, height)


def _towards(center: Array, target: Array, roll: float) -> Array:
    """World-to-camera rotation of a camera at ``center`` that looks at ``target``; y is about down."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= max(np.linalg.norm(x), 1e-9)
    return turned(0, 0, roll) @ np.stack([x, np.cross(z, x), z])


def _stage(random: Random, focal: float, size: tuple[int, int], near: float, far: float, held_out: bool, floating: bool) -> list[Shape]:
    """Shapes floating in front of a camera at the origin that looks along z, with what stands behind them."""
    half = np.array(size) / (2 * focal)
    shapes = []
    for _ in range(int(random.integers(6, 24)) if floating else 0):
        depth = near * (far / near) ** random.beta(1.0, 1.3)
        middle = random.uniform(-1.1, 1.1, 2) * half * depth
        radius = depth * half.max() * np.exp(random.uniform(np.log(0.06), np.log(0.6)))
        stretch = np.exp(random.normal(0, 0.35, 3))
        radius = min(radius, 0.45 * depth / stretch.max())
        shapes.append(random_shape(random, held_out).placed(radius * stretch, random_rotation(random), np.array([*middle, depth])))
    if random.random() < 0.6:
        flat = wall(12 * far, 12 * far, (random.uniform(20, 200),) * 2)
        turn = turned(np.pi / 2 + random.normal(0, 0.06), 0, random.normal(0, 0.06))
        shapes.append(flat.placed(1.0, turn, np.array([0, random.uniform(0.3, 1.2) * half[1] * far, far])))
    back = far * random.uniform(1.05, 2.0)
    tilt = turned(random.normal(0, 0.25), random.normal(0, 0.4), 0)
    shapes.append(wall(14 * far, 14 * far, (random.uniform(14, 160),) * 2).placed(1.0, tilt, np.array([0, 0, back])))
    if random.random() < 0.5:
        side = turned(0, np.pi / 2 + random.normal(0, 0.15), 0)
        x = random.choice([-1, 1]) * half[0] * far * random.uniform(0.4, 1.1)
        shapes.append(wall(10 * far, 10 * far, (random.uniform(10, 100),) * 2).placed(1.0, side, np.array([x, 0, far])))
    return shapes


def _photograph(random: Random, shapes: list[Shape], cameras: list[Camera], tiles: Tiles) -> tuple[NDArray[np.uint8], list[Array]]:
    """Each camera's image and depth; the last texture is what surrounds the scene."""
    first = np.cumsum([0, *(len(s.vertices) for s in shapes)])
    vertices = np.concatenate([s.vertices for s in shapes])
    faces = np.concatenate([s.faces + np.uint32(n) for s, n in zip(shapes, first[:-1], strict=True)])
    materials = np.concatenate([np.full(len(s.faces), n, np.uint16) for n, s in enumerate(shapes)])
    stretch = np.exp(random.uniform(np.log(0.4), np.log(2.5), len(shapes)))
    uv = np.concatenate([s.uv * k for s, k in zip(shapes, stretch, strict=True)]).astype(np.float32)
    normals = np.concatenate([s.normals for s in shapes]).astype(np.float32)
    gloss = np.zeros((len(shapes), 5), np.float32)
    gloss[:, 0] = random.uniform(0.25, 0.7)
    gloss[:, 1] = 1.15 - gloss[:, 0]
    gloss[:, 2] = np.where(random.random(len(shapes)) < 0.35, random.uniform(0, 0.6, len(shapes)), 0)
    gloss[:, 3] = np.exp(random.uniform(np.log(5), np.log(400), len(shapes)))
    gloss[:, 4] = np.where(random.random(len(shapes)) < SHINING, random.uniform(0.03, 0.4, len(shapes)), 0)
    textures = tiles.draw(random, len(shapes) + 1)
    lamp = random.normal(0, 1, 3) * np.array([3, 2, 1]) - np.array([0, 3, 3])
    p = np.stack([c.projection for c in cameras])
    width, height = cameras[0].width, cameras[0].height
    images = _core.shade(vertices, faces, uv, normals, materials, textures, gloss, p, lamp.tolist(), width, height, 2)
    return images, [_core.rasterize(vertices, faces, q, width, height)[0] for q in p]


def _visible(depth: Array, reference: Camera, other: Array, source: Camera) -> NDArray[np.bool_]:
    """Whether the source's z-buffer shows the surface that the reference sees."""
    h, w = depth.shape
    y, x = np.arange(h, dtype=np.float32)[:, None], np.arange(w, dtype=np.float32)
    m = relative_map(reference, source)
    near = depth.astype(np.float32)
    q = [(m[3 * k] * x + (m[3 * k + 1] * y + m[3 * k + 2])) * near + m[9 + k] for k in range(3)]
    z = np.maximum(q[2], np.float32(1e-9))
    u, v = (np.clip(np.rint(a / z), -1, side).astype(np.int32) for a, side in ((q[0], source.width), (q[1], source.height)))
    inside = (q[2] > 0) & (u >= 0) & (v >= 0) & (u < source.width) & (v < source.height) & (near > 0)
    seen = other[np.clip(v, 0, source.height - 1), np.clip(u, 0, source.width - 1)]
    return inside & (np.abs(seen - z) < 0.03 * z)


def random_pair(
    random: Random,
    tiles: Tiles,
    width: int = 256,
    height: int = 192,
    max_disparity: float | None = None,
    *,
    floating: bool = True,
    wide: bool = True,
) -> list[Sample]:
    """A rectified pair, left image first, and the same pair in a mirror, where right and left change places.

    The baseline is 1 over the focal length: inverse depth is disparity in pixels. ``max_disparity`` in pixels; by default log-uniform
    over a decade, or unless ``wide`` over half an octave. ``floating``: with shapes between the camera and the walls.
    """
    focal = width * random.uniform(0.8, 2.5)
    ends = (9, 90) if wide else (28, 40)
    top = max_disparity or float(np.exp(random.uniform(np.log(ends[0]), np.log(ends[1]))))
    near = 1.0
    far = near * np.exp(random.uniform(np.log(1.6), np.log(10)))
    shapes = _stage(random, focal, (width, height), near * 1.15, far, tiles.held_out, floating)
    baseline = top * near / focal
    shift = random.normal(0, 0.25, 2) * np.array([width, height]) * 0.3
    error = np.array([0, random.normal(0, 0.2)]) if random.random() < 0.5 else np.zeros(2)
    left = _camera(width, height, focal, np.eye(3), np.zeros(3), shift)
    right = _camera(width, height, focal, np.eye(3), np.array([baseline, 0, 0]), shift + error)
    images, depths = _photograph(random, shapes, [left, right], tiles)
    photographs = np.stack([through_a_camera(i, random) for i in images])
    # In a world where the baseline is 1 / focal the maps are those of a rectified pair.
    unit = tuple(_camera(width, height, focal, np.eye(3), c, shift) for c in (np.zeros(3), np.array([1 / focal, 0, 0])))
    scale, most = baseline * focal, random.uniform(1.0, 1.3)

    def look(pictures: NDArray[np.uint8], depth: Array, seen: NDArray[np.bool_]) -> Sample:
        inverse = np.where(depth > 0, scale / np.maximum(depth, 1e-9), 0).astype(np.float32)
        return Sample(pictures, unit, inverse, seen[None], (0.0, float(max(inverse.max(), top * 0.7) * most)))

    shown = _visible(depths[0], left, depths[1], right), _visible(depths[1], right, depths[0], left)
    mirrored = np.ascontiguousarray(photographs[::-1, :, ::-1])
    return [look(photographs, depths[0], shown[0]), look(mirrored, np.ascontiguousarray(depths[1][:, ::-1]), shown[1][:, ::-1])]


@dataclass(frozen=True)
class _Scenery:
    """What posed views look at: shapes, the point that they turn about, and the axis."""

    shapes: list[Shape]
    target: Array
    up: Array


def _standing(random: Random, focal: float, size: tuple[int, int], held_out: bool) -> _Scenery:
    """A body of some shapes on the ground in front of a camera at the origin that looks down on it along z; things and walls around."""
    pitch, distance = random.uniform(0.0, 0.9), 4.0
    up = np.array([0, -np.cos(pitch), -np.sin(pitch)])
    target = np.array([0, 0, distance])
    radius = distance * min(size) / (2 * focal) * random.uniform(0.35, 0.95)
    floor = target - up * radius * random.uniform(0.4, 1.0)
    shapes = []
    for n in range(int(random.integers(3, 12))):
        scale = radius * np.exp(random.uniform(np.log(0.4 if n == 0 else 0.12), np.log(0.8))) * np.exp(random.normal(0, 0.3, 3))
        place = target + random.normal(0, 0.4, 3) * radius
        shapes.append(random_shape(random, held_out).placed(np.minimum(scale, 1.2 * radius), random_rotation(random), place))
    across = np.array([[1.0, 0, 0], np.cross(up, [1.0, 0, 0])])
    for _ in range(int(random.integers(0, 9))):
        angle, away = random.uniform(-np.pi, np.pi), radius * random.uniform(1.5, 5.0)
        scale = radius * random.uniform(0.1, 0.7, 3)
        place = floor + away * (np.array([np.cos(angle), np.sin(angle)]) @ across) + up * scale.min()
        shapes.append(random_shape(random, held_out).placed(scale, random_rotation(random), place))
    upright = turned(np.pi / 2 + pitch, 0, 0)
    side = 30 * distance
    shapes.append(ground(side, random.uniform(20, 300)).placed(1.0, upright, floor))
    for _ in range(int(random.integers(1, 4))):
        turn = turned(pitch, 0, 0) @ turned(0, random.uniform(-np.pi, np.pi), 0)
        away = max(6 * radius, distance * random.uniform(1.3, 4.0))
        shapes.append(wall(side, side, (random.uniform(14, 160),) * 2).placed(1.0, turn, target + turn[:, 2] * away))
    return _Scenery(shapes, target, up)


def _around(axis: Array, angle: float) -> Array:
    """The rotation by an angle about a unit axis."""
    return np.asarray(cv2.Rodrigues(axis * angle)[0])


def random_views(
    random: Random,
    tiles: Tiles,
    views: int = 3,
    width: int = 256,
    height: int = 192,
    *,
    floating: bool = True,
    wide: bool = True,
    every: bool = False,
) -> list[Sample]:
    """Posed views of a scene, neighbours up to 45 degrees apart, or unless ``wide`` up to 8: two, or ``every`` one, in turn the reference.

    Half of the scenes are of floating shapes, half of a body that stands on the ground amid the cameras.
    """
    focal = width * random.uniform(0.8, 2.2)
    standing = floating and random.random() < STANDING
    if standing:
        scenery = _standing(random, focal, (width, height), tiles.held_out)
    else:
        near, far = 2.0, 2.0 * np.exp(random.uniform(np.log(1.4), np.log(4)))
        shapes = _stage(random, focal, (width, height), near, far, tiles.held_out, floating)
        scenery = _Scenery(shapes, np.array([0, 0, near * (far / near) ** random.uniform(0.2, 0.6)]), np.array([0.0, -1, 0]))
    target = scenery.target
    cameras = [_camera(width, height, focal, np.eye(3), np.zeros(3), random.normal(0, 0.03, 2) * width)]
    widest = np.exp(random.uniform(np.log(3), np.log(40 if wide else 8)))
    if wide and random.random() < 0.4:
        widest = random.uniform(18, 45)
    for _ in range(views - 1):
        angle, around = np.radians(widest * random.uniform(0.5, 1.0)), random.normal(0, 0.4) + random.choice([0, np.pi])
        if standing:
            tilt = _around(np.array([1.0, 0, 0]), angle * np.sin(around))
            turn = _around(scenery.up, angle * np.cos(around)) @ tilt @ np.array([0, 0, -1.0])
        else:
            turn = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), -np.cos(angle)])
        center = target + turn * np.linalg.norm(target) * random.uniform(0.85, 1.2)
        aim = target + random.normal(0, 0.06, 3) * target[2]
        rotation = _towards(center, aim, random.normal(0, 0.08))
        cameras.append(_camera(width, height, focal * random.uniform(0.9, 1.1), rotation, center, random.normal(0, 0.03, 2) * width))
    images, depths = _photograph(random, scenery.shapes, cameras, tiles)
    photographs = np.stack([through_a_camera(i, random) for i in images])
    less, more = random.uniform(0.5, 1.0), random.uniform(1.0, 1.4)

    def look(reference: int) -> Sample:
        order = [reference, *(k for k in range(views) if k != reference)]
        depth = depths[reference]
        inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0).astype(np.float32)
        known = inverse[inverse > 0]
        low, high = (float(np.quantile(known, q)) for q in (0.005, 0.995)) if len(known) else (0.1, 1.0)
        seen = np.stack([_visible(depth, cameras[reference], depths[k], cameras[k]) for k in order[1:]])
        return Sample(photographs[order], tuple(cameras[k] for k in order), inverse, seen, (low * less, high * more))

    return [look(k) for k in (range(views) if every else (0, int(random.integers(1, views))))]


def contact_sheet(seed: int, held_out: bool, rows: int = 8) -> tuple[NDArray[np.uint8], float]:
    """Pairs and posed views, a sample a row: the images, the inverse depth, what the first source sees; and samples a second."""
    random = np.random.default_rng(seed)
    tiles = Tiles(random, held_out)
    started = time.perf_counter()
    samples = [s for n in range(rows // 2) for s in (random_pair if n % 2 else random_views)(random, tiles)]
    speed = len(samples) / (time.perf_counter() - started)
    lines = []
    for sample in samples:
        low, high = sample.span
        shade = np.clip((sample.inverse - low) / (high - low) * 255, 0, 255).astype(np.uint8)
        colours = cv2.cvtColor(cv2.applyColorMap(shade, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
        seen = np.repeat(sample.seen[0][..., None] * np.uint8(255), 3, 2)
        images = [*sample.images, *[np.zeros_like(seen)] * (3 - len(sample.images))]
        lines.append(np.concatenate([*images, colours, seen], 1))
    return np.concatenate(lines), speed
