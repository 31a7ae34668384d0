"""Several targets in a clip: the parts of the visual hull, how they move from one instant to the next, and which is which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..mesh.hull_parts import Float, Target, matched, size_of_target
from ..pipeline.result import Reconstruction

MEMORY = 5
"""Instants for which a target that is not seen is remembered."""


@dataclass
class _Track:
    target: Target
    velocity: Float
    instant: int


@dataclass
class Tracker:
    """Tells targets apart over a clip: each keeps its number, also through a short absence."""

    tracks: dict[int, _Track] = field(default_factory=dict)
    count: int = 0

    def follow(self, instant: int, found: Sequence[Target]) -> list[dict[str, Any]]:
        """The targets of the next instant with their ``id``, by where each one should be after moving on as it did."""
        alive = {n: t for n, t in self.tracks.items() if instant - t.instant <= MEMORY}
        numbers, expected = list(alive), []
        for track in alive.values():
            way = track.velocity * (instant - track.instant)
            expected.append({**track.target, "middle": (np.asarray(track.target["middle"]) + way).tolist()})
        pairs = {f: numbers[e] for e, f in matched(expected, found).items()}
        named = []
        for f, target in enumerate(found):
            number = pairs.get(f, self.count)
            middle, before = np.asarray(target["middle"], np.float64), alive.get(number)
            if before is None:
                self.count += 1
                velocity = np.zeros(3)
            else:
                velocity = (middle - np.asarray(before.target["middle"])) / (instant - before.instant)
            self.tracks[number] = _Track(target, velocity, instant)
            named.append({**target, "id": number})
        return named


def split_targets(result: Reconstruction) -> list[Reconstruction]:
    """One reconstruction a tracked target, by the target whose middle a connected part of the mesh is nearest to."""
    targets = result.report.get("targets", [])
    if not targets or not len(result.faces):
        return [result]
    if len(targets) == 1:
        return [replace(result, report=result.report | {"target": targets[0]["id"]})]
    part = _core.components(result.faces)
    middles = np.stack([np.bincount(part, result.vertices[result.faces].mean(1)[:, k]) for k in range(3)], 1) / np.bincount(part)[:, None]
    # In units of each target's size: a part beside a large one is rather its own than a small neighbour's.
    away = np.stack([np.linalg.norm(middles - np.asarray(t["middle"]), axis=1) / size_of_target(t) for t in targets], 1)
    owner = away.argmin(1)[part]
    return [_subset(result, owner == n, int(t["id"])) for n, t in enumerate(targets) if (owner == n).any()]


def _subset(result: Reconstruction, faces: NDArray[np.bool_], number: int) -> Reconstruction:
    used, index = np.unique(result.faces[faces], return_inverse=True)
    return replace(
        result,
        vertices=result.vertices[used],
        faces=index.reshape(-1, 3).astype(np.uint32),
        uv=result.uv[used],
        face_views=result.face_views[faces],
        report=result.report | {"target": number},
    )
