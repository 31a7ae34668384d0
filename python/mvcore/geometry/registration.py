"""The poses of a rigid moving target: each instant's surface is brought onto all the others'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..errors import require
from ..types import DepthMap
from .cameras import Camera
from .linear import solve, weighted_sum

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Cloud:
    """points, normals : (n, 3) float64, world; normals of unit length, towards the camera that saw the point."""

    points: Float
    normals: Float

    def moved(self, pose: Float) -> Cloud:
        """In the frame that ``pose`` (4, 4) brings it to."""
        return Cloud(self.points @ pose[:3, :3].T + pose[:3, 3], self.normals @ pose[:3, :3].T)


def cloud_of(depths: Sequence[DepthMap | None], cameras: Sequence[Camera], count: int, seed: int = 0) -> Cloud:
    """About ``count`` points of filtered depth maps, with normals from their neighbours."""
    points, normals = [], []
    for view, camera in zip(depths, cameras, strict=True):
        if view is None:
            continue
        p, n = _surface(view.depth, camera)
        points.append(p)
        normals.append(n)
    every, directions = (np.concatenate(v) if v else np.zeros((0, 3)) for v in (points, normals))
    chosen = np.sort(np.random.default_rng(seed).permutation(len(every))[:count])
    return Cloud(every[chosen], directions[chosen])


def cloud_of_mesh(vertices: Float, faces: NDArray[np.uint32], count: int, seed: int = 0) -> Cloud:
    """About ``count`` of a mesh's faces as points."""
    chosen = np.sort(np.random.default_rng(seed).permutation(len(faces))[:count])
    a, b, c = (vertices[faces[chosen, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    good = length > 0
    return Cloud(((a + b + c) / 3)[good], normal[good] / length[good, None])


def _surface(depth: NDArray[np.float32], camera: Camera) -> tuple[Float, Float]:
    """Points and normals of the pixels whose 5 x 5 surroundings are known and smooth."""
    known = cv2.erode((depth > 0).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0) > 0
    smooth = cv2.GaussianBlur(depth, (5, 5), 1.2).astype(np.float64)
    x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.K).T
    space = rays * smooth[..., None]
    across, down = np.zeros_like(space), np.zeros_like(space)
    across[:, 1:-1] = space[:, 2:] - space[:, :-2]
    down[1:-1] = space[2:] - space[:-2]
    normal = np.cross(down, across)
    length = np.linalg.norm(normal, axis=-1)
    normal /= np.maximum(length, 1e-300)[..., None]
    facing = -(normal * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
    low, high = cv2.erode(depth, np.ones((5, 5))), cv2.dilate(depth, np.ones((5, 5)))
    good = known & (length > 0) & (facing > 0.2) & (high - low < 0.05 * high)
    return (space[good] - camera.t) @ camera.R, normal[good] @ camera.R


def _pose(twist: Float) -> Float:
    """(4, 4) of a rotation vector and a translation."""
    m = np.eye(4)
    m[:3, :3] = cv2.Rodrigues(np.ascontiguousarray(twist[:3]))[0]
    m[:3, 3] = twist[3:]
    return m


def _pairs(a: Cloud, b: Cloud, reach: float) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
    """Nearest points within ``reach`` whose normals agree: indices into a and b, and weights."""
    _, number = _core.nearest(np.ascontiguousarray(a.points), np.ascontiguousarray(b.points), reach)
    alike = (a.normals * b.normals[number]).sum(1)
    near = np.flatnonzero((number >= 0) & (alike > 0.7))
    residual = ((a.points[near] - b.points[number[near]]) * b.normals[number[near]]).sum(1)
    scale = max(1.48 * float(np.median(np.abs(residual))), 1e-3 * reach) if len(near) else 1.0
    weight = np.clip(1 - (residual / (4.7 * scale)) ** 2, 0, None) ** 2  # Tukey's
    return near, number[near], weight


def _rows(a: Cloud, b: Cloud, i: NDArray[np.int64], j: NDArray[np.int64]) -> tuple[Float, Float]:
    """Point-to-plane residuals (m,) and their gradient (m, 6) by a's twist about the origin."""
    p, n = a.points[i], b.normals[j]
    return ((p - b.points[j]) * n).sum(1), np.column_stack([np.cross(p, n), n])


def align(moving: Cloud, fixed: Cloud, start: Float, size: float, rounds: int = 30) -> tuple[Float, float]:
    """The pose (4, 4) that brings one cloud onto another (point to plane, robust), and the share of points that found a partner.

    ``size`` is the target's, world units: partners are looked for within a fifth of it at first, a hundredth at last.
    """
    pose, share = start.copy(), 0.0
    center = fixed.points.mean(0)
    for k in range(rounds):
        reach = size * 0.2 * (0.05 ** (k / max(1, rounds - 1)))
        at = moving.moved(pose)
        i, j, weight = _pairs(at, fixed, reach)
        share = len(i) / max(1, len(moving.points))
        if len(i) < 50:
            return pose, 0.0
        # About the middle of the target, where rotation and translation are least tangled.
        shifted = [Cloud(c.points - center, c.normals) for c in (at, fixed)]
        residual, gradient = _rows(*shifted, i, j)
        step = _solve(gradient.T @ (weight[:, None] * gradient), -weighted_sum(gradient, weight * residual))
        shift = np.eye(4)
        shift[:3, 3] = center
        pose = shift @ _pose(step) @ np.linalg.inv(shift) @ pose
    return pose, share


def _solve(matrix: Float, vector: Float) -> Float:
    """Damped: a direction that the surfaces do not fix (a wheel's axis, a plane's) stays where it is."""
    damping = 1e-6 * np.trace(matrix) / len(matrix)
    return solve(matrix + damping * np.eye(len(matrix)), vector)


def find_poses(clouds: Sequence[Cloud], size: float, rounds: int = 40) -> tuple[Float, Float]:
    """Poses (T, 4, 4) that bring the target from the first instant's frame into the world at each instant, the first the identity.

    Neighbours are aligned one after the other, the next started from the motion so far; then all instants together, each pair that
    overlaps pulling both (multi-view registration). Also the share (T,) of each instant's points with a partner at the one before.

    Raises
    ------
    InvalidInputError
        An instant without points.
    """
    for n, cloud in enumerate(clouds):
        require(len(cloud.points) >= 50, f"instant {n}", "at least 50 surface points of the target", len(cloud.points))
    poses, shares = [np.eye(4)], [1.0]
    motion = np.eye(4)
    for n in range(1, len(clouds)):
        # The step before, or at first the way of the middle.
        if n == 1:
            motion = np.eye(4)
            motion[:3, 3] = np.median(clouds[1].points, 0) - np.median(clouds[0].points, 0)
        back, share = align(clouds[n], clouds[n - 1], np.linalg.inv(motion), size)
        motion = np.linalg.inv(back)
        poses.append(motion @ poses[-1])
        shares.append(share)
    return _refined(clouds, np.stack(poses), size, rounds), np.array(shares)


def _refined(clouds: Sequence[Cloud], poses: Float, size: float, rounds: int) -> Float:
    """All poses together: Gauss-Newton over the point-to-plane residuals of every pair, in the first instant's frame."""
    count = len(clouds)
    center = clouds[0].points.mean(0)
    local = [c.moved(np.linalg.inv(p)) for c, p in zip(clouds, poses, strict=True)]
    local = [Cloud(c.points - center, c.normals) for c in local]
    steps = [np.eye(4) for _ in clouds]
    for k in range(rounds if count > 1 else 0):
        reach = size * 0.03 * (0.15 ** (k / max(1, rounds - 1)))
        at = [c.moved(s) for c, s in zip(local, steps, strict=True)]
        matrix, vector = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
        for a in range(count):
            for b in range(count):
                # Far instants share little, and in long clips all pairs would be many.
                if a == b or abs(a - b) > 6:
                    continue
                i, j, weight = _pairs(at[a], at[b], reach)
                if len(i) < 50:
                    continue
                residual, gradient = _rows(at[a], at[b], i, j)
                weighted = weight[:, None] * gradient
                sa, sb = slice(6 * a, 6 * a + 6), slice(6 * b, 6 * b + 6)
                square, pull = gradient.T @ weighted, weighted_sum(weighted, residual)
                # The plane moves with b; to first order by the same lever.
                matrix[sa, sa] += square
                matrix[sb, sb] += square
                matrix[sa, sb] -= square
                matrix[sb, sa] -= square
                vector[sa] -= pull
                vector[sb] += pull
        free = _solve(matrix[6:, 6:], vector[6:])
        for n in range(1, count):
            steps[n] = _pose(free[6 * (n - 1) : 6 * n]) @ steps[n]
        if np.abs(free).max(initial=0) < 1e-9 * size:
            break
    shift = np.eye(4)
    shift[:3, 3] = center
    return np.stack([p @ np.linalg.inv(shift @ s @ np.linalg.inv(shift)) for p, s in zip(poses, steps, strict=True)])
