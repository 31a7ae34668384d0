"""One model of a rigid target: its poses, and all instants' views as if it had stood still and the cameras had moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.cameras import Camera
from ..geometry.registration import cloud_of, cloud_of_mesh, find_poses
from ..mesh.surface import isosurface
from ..pipeline.stages import Plan, Views, finish, first_pass
from ..sparse import view_selection
from ..types import Bounds, Image, Report
from ..volume.tsdf import Window
from .stages import (
    Job,
    depth_maps,
    filtered_of,
    fused,
    instant_plan,
    no_points,
    once,
    prepared,
    result_arrays,
    second_depth,
    stored,
)


@once
def poses(job: Job, keys: Sequence[tuple[str, str, str]]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Where a rigid target is at each instant; ``keys`` name each one's preparation, field and mesh."""
    config, report, clouds = job.config.video, Report(), []
    box: Bounds | None = None
    for number, (prepare, fuse, mesh) in enumerate(keys):
        views, plan, _ = prepared(job, prepare)
        filtered = filtered_of(stored(job, fuse).arrays, len(views.images))
        box = plan.box if box is None else box
        if any(d is not None for d in filtered):
            clouds.append(cloud_of(filtered, views.cameras, config.registration_points, number))
        else:
            a = stored(job, mesh).arrays
            clouds.append(cloud_of_mesh(a["vertices"], a["faces"], config.registration_points, number))
    assert box is not None
    found, shares = find_poses(clouds, float(np.linalg.norm(box[1] - box[0])), config.registration_rounds)
    for n, share in enumerate(shares):
        if share < 0.3:
            report.warn(f"only {share:.0%} of the target's surface at its instant {n} lies on the one before: its pose is doubtful")
    meta = {"report": {"instants": len(keys), "overlap": shares.round(3).tolist()}, "warnings": report.warnings}
    return {"poses": found, "box": box}, meta


@lru_cache(maxsize=1)
def _gathered(job_folder: Path, prepare_keys: tuple[str, ...], poses_key: str, job: _Same) -> tuple[Views, Plan]:
    """All instants' views in the target's frame, as if it had stood still and the cameras had moved."""
    entry = stored(job.job, poses_key)
    box = entry.arrays["box"]
    images: list[Image] = []
    masks: list[NDArray[np.uint8]] = []
    cameras: list[Camera] = []
    windows: list[Window] = []
    for key, pose in zip(prepare_keys, entry.arrays["poses"], strict=True):
        views, _, _ = prepared(job.job, key)
        images += views.images
        masks += views.masks or []
        cameras += [c.moved(pose) for c in views.cameras]
        windows += views.windows or []
    plan = instant_plan(Views(images, masks, cameras, windows), no_points(len(cameras)), box, True, job.job.config, Report())
    return Views(images, masks, cameras, windows), plan


@dataclass(frozen=True, eq=False)
class _Same:
    """A job as an argument of a cached function: the other arguments tell its results apart."""

    job: Job

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same)


def _all_views(job: Job, prepare_keys: Sequence[str], poses_key: str) -> tuple[Views, Plan]:
    return _gathered(job.folder, tuple(prepare_keys), poses_key, _Same(job))


@once
def model_plan(job: Job, prepare_keys: Sequence[str], poses_key: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Which views of which instants show the same surface."""
    _, plan = _all_views(job, prepare_keys, poses_key)
    return {}, {"sources": plan.sources}


@once
def model_first(job: Job, prepare_keys: Sequence[str], poses_key: str, n: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s first pass against views of all instants."""
    views, plan = _all_views(job, prepare_keys, poses_key)
    return first_pass(views, plan, n, job.config).arrays(), {}  # type: ignore[return-value]


@once
def model_second(
    job: Job, prepare_keys: Sequence[str], poses_key: str, n: int, first_keys: dict[int, str]
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s depth map among those of all instants."""
    views, plan = _all_views(job, prepare_keys, poses_key)
    return second_depth(job, views, plan, n, first_keys)


@once
def model(
    job: Job, prepare_keys: Sequence[str], poses_key: str, depth_keys: dict[int, str]
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """One mesh of all instants in the first one's frame."""
    views, plan = _all_views(job, prepare_keys, poses_key)
    told = stored(job, poses_key).meta
    report = Report({"rigid": told["report"]}, list(told["warnings"]))
    # With so many views less noise is left to be smoothed away than at one instant.
    config = replace(job.config, volume=replace(job.config.volume, solid_smoothing=job.config.volume.smoothing))
    near = view_selection.choose_sources(view_selection.view_scores(views.cameras, plan.points, plan.box, config.depth), MODEL_SOURCES)
    if any(plan.sources):
        plan = replace(plan, sources=near)
    _, parts = fused(views, plan, depth_maps(job, depth_keys, len(views.images)), config, report)
    result = finish(views, plan, [], isosurface(parts), config, report)
    return result_arrays(result) | {"box": plan.box}, {"report": result.report}


MODEL_SOURCES = 12
"""Views that a depth of the model is checked against: those of other instants stand near."""
