"""A rigid target's frames as one: its poses, and all frames' views as if it had stood still and the cameras had moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.cameras import Camera
from ..geometry.registration import Cloud, cloud_of, cloud_of_mesh, find_poses
from ..types import Bounds, DepthMap
from .stages import Findings, Textured

LEAST_OVERLAP = 0.3
"""ICP overlap with the frame before below which a pose is called doubtful."""


@dataclass(frozen=True)
class Trajectory:
    """poses : (T, 4, 4) float64, bring the first frame's target to where it is at each frame."""

    poses: NDArray[np.float64]
    findings: Findings


def cloud(depths: Sequence[DepthMap | None], mesh: Textured, cameras: list[Camera], points: int, seed: int) -> Cloud:
    """A frame's surface as points with normals: of its depth maps, or of its mesh where there is only the visual hull."""
    known = [depths[n] for n in range(len(depths))]
    if any(d is not None for d in known):
        return cloud_of(known, cameras, points, seed)
    return cloud_of_mesh(mesh.vertices, mesh.faces, points, seed)


def registered(clouds: Sequence[Cloud], box: Bounds, rounds: int) -> Trajectory:
    """Poses of a rigid target, by ICP of each frame onto the others."""
    poses, overlap = find_poses(list(clouds), float(np.linalg.norm(box[1] - box[0])), rounds)
    warnings = [f"ICP overlap at frame {n} is {s:.0%}: its pose is doubtful" for n, s in enumerate(overlap) if s < LEAST_OVERLAP]
    figures = {"rigid": {"instants": len(clouds), "overlap": overlap.round(3).tolist()}}
    return Trajectory(poses, Findings(figures, warnings))
