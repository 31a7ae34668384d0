"""Random solids and sheets as triangle meshes, in families: some for training, others only for validation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.cameras import euler_to_rotation

Array = NDArray[np.float64]
Random = np.random.Generator


@dataclass(frozen=True)
class Shape:
    """A triangle mesh: vertices (n, 3), faces (m, 3), unit normals (n, 3), texture coordinates (n, 2) in tiles."""

    vertices: Array
    faces: NDArray[np.uint32]
    normals: Array
    uv: Array

    def placed(self, scale: Array | float, rotation: Array, position: Array) -> Shape:
        """Scaled along its axes, turned, moved."""
        scale = np.broadcast_to(np.asarray(scale, float), 3)
        normals = (self.normals / scale) @ rotation.T
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return Shape((self.vertices * scale) @ rotation.T + position, self.faces, normals, self.uv)


def _from_grid(points: Array, tiles: tuple[float, float] = (2.0, 1.0)) -> Shape:
    """A surface from an (n, m, 3) grid of points."""
    n, m = points.shape[:2]
    du, dv = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normals = np.cross(du, dv).reshape(-1, 3)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    normals[~np.isfinite(normals).all(1) | (np.abs(normals).sum(1) < 0.5)] = (0, 0, 1)
    number = np.arange(n * m, dtype=np.uint32).reshape(n, m)
    a, b, c, d = number[:-1, :-1].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel(), number[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    u, v = np.meshgrid(np.linspace(0, tiles[0], n), np.linspace(0, tiles[1], m), indexing="ij")
    return Shape(points.reshape(-1, 3), faces, normals, np.stack([u, v], -1).reshape(-1, 2))


def _angles(n: int, m: int) -> tuple[Array, Array]:
    return np.meshgrid(np.linspace(-np.pi, np.pi, n), np.linspace(-np.pi / 2, np.pi / 2, m), indexing="ij")


def _power(x: Array, exponent: float) -> Array:
    return np.sign(x) * np.abs(x) ** exponent


def _superquadric(random: Random) -> Shape:
    e, n = random.choice([0.1, 0.3, 0.6, 1.0, 1.6], 2)
    u, v = _angles(36, 18)
    x = _power(np.cos(v), n) * _power(np.cos(u), e)
    y = _power(np.cos(v), n) * _power(np.sin(u), e)
    return _from_grid(np.stack([x, y, _power(np.sin(v), n)], -1))


def _noisy_sphere(random: Random) -> Shape:
    u, v = _angles(48, 24)
    d = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], -1)
    radius = np.ones(u.shape)
    for octave in range(4):
        wave, phase = random.normal(size=(3, 3)) * 1.5 * 2**octave, random.uniform(0, 2 * np.pi, 3)
        radius += 0.25 * 0.55**octave * np.sin(d @ wave + phase).prod(-1)
    return _from_grid(d * np.maximum(radius, 0.2)[..., None])


def _rod(random: Random) -> Shape:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 13), np.linspace(-1, 1, 16), indexing="ij")
    r = random.uniform(0.02, 0.15) * (1 + random.uniform(0, 0.4) * v)
    bend = random.uniform(-0.4, 0.4) * v**2
    return _from_grid(np.stack([r * np.cos(u) + bend, r * np.sin(u), v], -1), (0.3, 2.0))


def _box(random: Random) -> Shape:
    """Six flat sides, each with its own texture coordinates."""
    sides = []
    s, t = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5), indexing="ij")
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = np.empty((5, 5, 3))
            points[..., axis], points[..., (axis + 1) % 3], points[..., (axis + 2) % 3] = sign, sign * s, t
            sides.append(_from_grid(points, (1.0, 1.0)))
    return _joined(sides)


def _cone(random: Random) -> Shape:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, 1, 10), indexing="ij")
    top = random.uniform(0, 0.7)
    r = 1 - (1 - top) * v
    return _from_grid(np.stack([r * np.cos(u), r * np.sin(u), 2 * v - 1], -1))


def _sheet(random: Random) -> Shape:
    s, t = np.meshgrid(np.linspace(-1, 1, 24), np.linspace(-1, 1, 24), indexing="ij")
    z = sum(
        random.uniform(0, 0.25) * np.sin(random.uniform(0.5, 4) * s + random.uniform(0.5, 4) * t + random.uniform(0, 6)) for _ in range(3)
    )
    return _from_grid(np.stack([s, t, np.asarray(z)], -1), (1.0, 1.0))


def _card(random: Random) -> Shape:
    """A flat cut-out with a ragged outline."""
    u, r = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0, 1, 5), indexing="ij")
    edge = 1 + sum(random.uniform(0, 0.3) * np.cos(k * u + random.uniform(0, 6)) for k in range(2, 7))
    points = np.stack([r * edge * np.cos(u), r * edge * np.sin(u), np.zeros_like(u)], -1)
    shape = _from_grid(points)
    return Shape(shape.vertices, shape.faces, shape.normals, shape.vertices[:, :2] * 0.5)


def _torus(random: Random) -> Shape:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 37), np.linspace(0, 2 * np.pi, 17), indexing="ij")
    r = random.uniform(0.15, 0.45)
    ring = 1 - r + r * np.cos(v)
    return _from_grid(np.stack([ring * np.cos(u), ring * np.sin(u), r * np.sin(v)], -1), (3.0, 1.0))


def _spring(random: Random) -> Shape:
    turns, r = random.integers(2, 5), random.uniform(0.05, 0.2)
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi * turns, 90), np.linspace(0, 2 * np.pi, 9), indexing="ij")
    ring = 0.8 + r * np.cos(v)
    return _from_grid(np.stack([ring * np.cos(u), ring * np.sin(u), u / (np.pi * turns) - 1 + r * np.sin(v)], -1), (6.0, 0.5))


def _star_prism(random: Random) -> Shape:
    points = int(random.integers(4, 9))
    angles = np.linspace(0, 2 * np.pi, 8 * points + 1)
    radius = 1 - random.uniform(0.2, 0.6) * np.abs((angles * points / np.pi) % 2 - 1)
    outline = np.stack([radius * np.cos(angles), radius * np.sin(angles)], -1)
    layers = [(0.0, -0.6), (1.0, -0.6), (1.0, -0.2), (1.0, 0.2), (1.0, 0.6), (0.0, 0.6)]
    grid = np.stack([np.concatenate([outline * r, np.full((len(outline), 1), z)], 1) for r, z in layers], 1)
    return _from_grid(grid, (3.0, 1.5))


def _joined(parts: list[Shape]) -> Shape:
    first = np.cumsum([0, *(len(p.vertices) for p in parts)])
    return Shape(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + np.uint32(n) for p, n in zip(parts, first[:-1], strict=True)]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.uv for p in parts]),
    )


def wall(width: float, height: float, tiles: tuple[float, float]) -> Shape:
    """A flat rectangle in the plane z = 0, in small cells so that one behind the camera costs no more than itself."""
    s, t = np.meshgrid(np.linspace(-width / 2, width / 2, 25), np.linspace(-height / 2, height / 2, 25), indexing="ij")
    return _from_grid(np.stack([s, t, np.zeros_like(s)], -1), tiles)


def ground(side: float, tiles: float) -> Shape:
    """A flat square in the plane z = 0 whose cells are small around its middle, where cameras stand close to it."""
    line = np.linspace(-1, 1, 61) ** 3
    s, t = np.meshgrid(line * side / 2, line * side / 2, indexing="ij")
    shape = _from_grid(np.stack([s, t, np.zeros_like(s)], -1))
    return Shape(shape.vertices, shape.faces, shape.normals, shape.vertices[:, :2] * (tiles / side))


TRAINING: tuple[Callable[[Random], Shape], ...] = (_superquadric, _noisy_sphere, _rod, _box, _cone, _sheet, _card)
HELD_OUT: tuple[Callable[[Random], Shape], ...] = (_torus, _spring, _star_prism)


def random_shape(random: Random, held_out: bool) -> Shape:
    """A shape of about unit radius from the training or the held-out families."""
    families = HELD_OUT if held_out else TRAINING
    return families[random.integers(len(families))](random)


def turned(x: float, y: float, z: float) -> Array:
    """The matrix that turns points by right-handed angles about z, then y, then x (the paper's matrices turn the axes)."""
    return euler_to_rotation(-x, -y, -z)


def random_rotation(random: Random) -> Array:
    """A turn about random Euler angles."""
    return turned(*random.uniform(-np.pi, np.pi, 3))
