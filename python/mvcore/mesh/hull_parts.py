"""The parts of a visual hull: which are targets, and how they move from one frame to the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..geometry.cameras import Camera
from ..geometry.registration import align, cloud_of_mesh
from ..silhouettes.visual_hull import Mask, Occupancy, splat
from .surface import Surface, compact, marching_cubes

Float = NDArray[np.float64]


Target = Mapping[str, Any]
"""A part of the hull: ``middle`` (3,), ``box`` (2, 3), world; ``volume``, cubic world units; ``id``, once it is tracked."""
HULL_POINTS = 3000
"""Points of a hull by which its motion is found."""
HULL_ROUNDS = 15
"""Rounds of that alignment: hulls are rough, more would not tell more."""
LEAST_SHARE = 0.3
"""Share of a hull's points with a partner below which only the way of its middle is taken as its motion."""
LEAST_PART = 0.003
"""Share of the largest part's volume below which a part of the hull is noise."""
JOINED = 0.12
"""Share of a target's length within which another part of the hull belongs to it."""
SEEN_ALONE = 0.1
"""Share of a part's shadow that a camera must see beside those of larger parts: some camera, or of a part on its own most cameras."""


@dataclass(frozen=True)
class Hulls:
    """The surfaces of all parts of the hull.

    vertices : (V, 3) float64, world. faces : (F, 3) uint32. owner : (F,) int32, the target of each face, -1 of phantoms and noise.
    """

    vertices: Float
    faces: NDArray[np.uint32]
    owner: NDArray[np.int32]


def find_targets(hull: Occupancy, masks: Sequence[Mask], cameras: Sequence[Camera], least: float) -> tuple[list[dict[str, Any]], Hulls]:
    """The targets that a hull shows, the one with the largest part first.

    Each is a connected part with at least the share ``least`` of the largest part's volume, and the parts close to it: a mask with a gap
    cuts a leg off. Few silhouettes also leave phantoms: parts that show nothing of any mask but what larger ones show already, or, where a
    limb that one camera lost is in no hull, what only half of the cameras or fewer have beside them. They are none.
    """
    padded = np.pad(np.where(hull.occupied, -1.0, 1.0).astype(np.float32), 1, constant_values=1.0)
    points, faces = marching_cubes(padded)
    vertices = hull.origin + hull.voxel * (points.astype(np.float64) - 1)
    owner = np.full(len(faces), -1, np.int32)
    bodies: list[Float] = []
    volumes: list[float] = []
    part = _core.components(faces) if len(faces) else np.zeros(0, np.uint32)
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    every = np.bincount(part, (a * np.cross(b, c)).sum(1) / 6)
    shown = [np.zeros(m.shape, bool) for m in masks]
    for number in np.argsort(-every, kind="stable"):
        if every[number] < max(LEAST_PART * every.max(), 1.0):
            break
        own = np.ascontiguousarray(vertices[np.unique(faces[part == number])])
        shadows = [(splat(own, hull.voxel, camera) > 0) & (m > 0) for camera, m in zip(cameras, masks, strict=True)]
        alone = [np.count_nonzero(s & ~o) > SEEN_ALONE * np.count_nonzero(s) for s, o in zip(shadows, shown, strict=True) if s.any()]
        if not any(alone):
            continue
        close = [n for n, body in enumerate(bodies) if (_core.nearest(own, body, JOINED * _length(body))[1] >= 0).any()]
        if close:
            target = close[0]
            bodies[target] = np.concatenate([bodies[target], own])
            volumes[target] += float(every[number])
        elif every[number] >= least * every.max() and 2 * sum(alone) > len(alone):
            target = len(bodies)
            bodies.append(own)
            volumes.append(float(every[number]))
        else:
            continue
        shown = [s | o for s, o in zip(shadows, shown, strict=True)]
        owner[part == number] = target
    found = []
    for body, volume in zip(bodies, volumes, strict=True):
        box = [(body.min(0) - hull.voxel).tolist(), (body.max(0) + hull.voxel).tolist()]
        found.append({"middle": body.mean(0).tolist(), "box": box, "volume": volume * hull.voxel**3})
    return found, Hulls(vertices, faces, owner)


def _length(points: Float) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def on_targets(surface: Surface, hulls: Hulls) -> Surface:
    """The surface without its connected parts that lie in phantoms rather than in targets."""
    if (hulls.owner >= 0).all():
        return surface
    part = _core.components(surface.faces)
    near = hulls.owner[_nearest_face(surface.vertices[surface.faces].mean(1), hulls, np.ones(len(hulls.owner), bool))]
    share = np.bincount(part, near >= 0) / np.bincount(part)
    return compact(surface.vertices, surface.faces[(share > 0.5)[part]])


def _nearest_face(points: Float, hulls: Hulls, chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Which of the chosen faces of the hulls is nearest to each point."""
    middles = np.ascontiguousarray(hulls.vertices[hulls.faces[chosen]].mean(1))
    return np.flatnonzero(chosen)[_core.nearest(np.ascontiguousarray(points), middles)[1]]


def size_of_target(target: Target) -> float:
    """Diagonal of a target's box, world units."""
    return float(np.linalg.norm(np.subtract(target["box"][1], target["box"][0])))


def matched(expected: Sequence[Target], found: Sequence[Target]) -> dict[int, int]:
    """Which found target (value) is which expected one (key): the nearest pairs first, none farther apart than the target is long."""
    costs = []
    for e, before in enumerate(expected):
        for f, now in enumerate(found):
            way = float(np.linalg.norm(np.subtract(now["middle"], before["middle"]))) / max(size_of_target(before), size_of_target(now))
            if way < 1:
                costs.append((way + 0.3 * abs(float(np.log(now["volume"] / before["volume"]))), e, f))
    pairs: dict[int, int] = {}
    for _, e, f in sorted(costs):
        if e not in pairs and f not in pairs.values():
            pairs[e] = f
    return pairs


def motions(before: Sequence[Target], now: Sequence[Target], hulls_before: Hulls, hulls_now: Hulls) -> Float:
    """Poses (n, 4, 4) that bring each target of the instant before to where it is now, by its hulls; the identity where it is gone."""
    poses = np.tile(np.eye(4), (len(before), 1, 1))
    for b, n in matched(before, now).items():
        poses[b, :3, 3] = np.subtract(now[n]["middle"], before[b]["middle"])
        moving, fixed = (cloud_of_mesh(h.vertices, h.faces[h.owner == k], HULL_POINTS) for h, k in ((hulls_before, b), (hulls_now, n)))
        found, share = align(moving, fixed, poses[b], size_of_target(before[b]), HULL_ROUNDS)
        if share >= LEAST_SHARE:
            poses[b] = found
    return poses


def moved(points: Float, poses: Float, hulls: Hulls) -> Float:
    """Points (n, 3) on or near the hulls, each moved with the target that it belongs to."""
    if not len(poses) or not len(points):
        return points
    owner = np.zeros(len(points), np.int32)
    if len(poses) > 1:
        owner = hulls.owner[_nearest_face(points, hulls, hulls.owner >= 0)]
    out = points.copy()
    for k, pose in enumerate(poses):
        out[owner == k] = points[owner == k] @ pose[:3, :3].T + pose[:3, 3]
    return out
