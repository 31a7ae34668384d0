"""The stages in order, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import depth as depth_stage
from ..config import Config
from ..errors import require
from ..geometry.cameras import Calibration, Camera
from ..io import load
from ..io.images import find_masks, load_frame, load_mask, reduce, undistort
from ..types import Bounds, DepthMap, Frame, Image, Report, Track, no_track
from .report import _Clock, _peak_memory, _say_completed, _say_kept
from .result import Reconstruction
from .stages import (
    Draft,
    Masks,
    Plan,
    Views,
    _isosurface,
    _standing,
    filter_views,
    finish,
    first_pass,
    make_draft,
    make_plan,
    second_pass,
    third_pass,
)


def _calibration(calib: Calibration | Sequence[Camera] | str | Path) -> Calibration:
    if isinstance(calib, str | Path):
        return load(calib, images=False).calib
    return calib if isinstance(calib, Calibration) else Calibration(tuple(calib))


def check_bounds(bounds: ArrayLike | None) -> Bounds | None:
    """A caller's box as (2, 3), checked."""
    if bounds is None:
        return None
    box = np.asarray(bounds, np.float64)
    require(box.size == 6, "bounds", "((x0, y0, z0), (x1, y1, z1))", f"{box.size} values")
    box = box.reshape(2, 3)
    require(np.isfinite(box).all() and (box[0] < box[1]).all(), "bounds", "x0 < x1, y0 < y1, z0 < z1", box.tolist())
    return box


def _inputs(
    frames: Sequence[Frame], calib: Calibration, masks: Sequence[Frame] | None, limit: int, track: Track
) -> tuple[list[Image], Masks | None, list[Camera]]:
    """Undistorted images and masks, reduced alike, with their cameras."""
    images, kept, cameras = [], [], []
    for n, (frame, camera) in enumerate(zip(track(frames, "images", len(frames)), calib, strict=True)):
        image, reduced = reduce(undistort(load_frame(frame, camera, n), camera), camera.pinhole(), limit)
        images.append(image)
        cameras.append(reduced)
        if masks is not None:
            mask = undistort(load_mask(masks[n], camera, n), camera, nearest=True)
            kept.append(reduce(mask, camera.pinhole(), limit, nearest=True)[0])
    return images, kept if masks is not None else None, cameras


def reconstruct(
    frames: Sequence[Frame],
    calib: Calibration | Sequence[Camera] | str | Path,
    *,
    masks: Sequence[Frame] | str | Path | None = None,
    bounds: ArrayLike | None = None,
    config: Config | Mapping[str, Any] | None = None,
    track: Track | None = None,
) -> Reconstruction:
    """Calibrated photographs in, a textured mesh out.

    Parameters
    ----------
    frames : (h, w, 3) uint8 RGB arrays or image paths, one a camera.
    calib : cameras in the frames' order, or a path that `mvcore.load` reads.
    masks : (h, w) uint8 or bool, or paths, or a folder; non-zero on the target. Carves the mesh to the visual hull.
    bounds : ((x0, y0, z0), (x1, y1, z1)) of the target in the world; wins over what the images suggest.
    config : settings, or a mapping of them.
    track : wraps the iterables of long stages, to show progress.

    Returns
    -------
    Reconstruction
        In the caller's frame and units. ``report`` says what ran, what it took, which views were left out, and why.

    Raises
    ------
    InvalidInputError
        Frames, cameras, masks or settings do not fit their contracts.
    ReconstructionError
        The calibration does not fit the images, or no surface is found.
    """
    config = config if isinstance(config, Config) else Config.from_dict(config or {})
    track = track or no_track
    calib = _calibration(calib)
    require(len(frames) == len(calib), "frames", f"{len(calib)}, one a camera", len(frames))
    calib.check_baselines()
    given = check_bounds(bounds)
    if isinstance(masks, str | Path):
        masks = find_masks(masks, frames)
    require(masks is None or len(masks) == len(frames), "masks", f"{len(frames)}, one a frame", len(masks or ()))
    report = Report()
    report.values |= {"views": len(frames), "matcher": config.matcher, "config": asdict(config)}
    clock = _Clock(report)
    with clock.stage("io"):
        images, cut, cameras = _inputs(frames, calib, masks, config.depth.max_image_size, track)
    views = Views(images, cut, cameras)
    with clock.stage("sparse"):
        plan = make_plan(views, given, config, report, track)
    with clock.stage("depth"):
        rough, depths = _depths(views, plan, config, track)
    draft = None
    if config.depth.surface_rounds and rough:
        draft = make_draft(views, plan, depths, config, report, track, clock)
        with clock.stage("depth"):
            for n in track(rough, "depth, third pass", len(rough)):
                depths[n] = third_pass(views, plan, n, depths[n], rough[n], draft.surface, config)
    result = build(views, plan, depths, config, report, track, clock, draft)
    result.cameras = Calibration(tuple(cameras), calib.source)
    result.report["peak_memory_mib"] = round(_peak_memory() / 2**20)
    return result


def build(
    views: Views,
    plan: Plan,
    depths: list[DepthMap | None],
    config: Config,
    report: Report,
    track: Track = no_track,
    clock: _Clock | None = None,
    draft: Draft | None = None,
) -> Reconstruction:
    """From depth maps (None where a view has none) to the textured mesh; a draft's silhouettes serve again, else they are sought."""
    clock = clock or _Clock(Report())
    with clock.stage("consistency"):
        filtered = filter_views(views, plan, depths, config.depth, track)
        loose = filter_views(views, plan, depths, config.depth.loosened(), track)
        _say_kept(filtered, plan.sources, views.masks is not None, report)
    found = draft.found if draft else _standing(views, plan, loose, config, report, clock)
    with clock.stage("volume"):
        surface = _isosurface(views, plan, loose, found, config, report)
    if found is not None:
        _say_completed(report)
    return finish(views, plan, filtered, surface, config, report, track, clock, completed=found is not None)


def _depths(views: Views, plan: Plan, config: Config, track: Track) -> tuple[dict[int, depth_stage.RoughDepth], list[DepthMap | None]]:
    """The first and the second pass of the views that have sources."""
    used = [n for n, s in enumerate(plan.sources) if s]
    rough = {n: first_pass(views, plan, n, config) for n in track(used, "depth, first pass", len(used))}
    depths: list[DepthMap | None] = [None] * len(views.images)
    for n in track(used, "depth, second pass", len(used)):
        depths[n] = second_pass(views, plan, n, rough, config, last=not config.depth.surface_rounds)
    return rough, depths
