"""The stages in order, and nothing else."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import depth as depth_stage
from . import sparse as sparse_stage
from .cameras import Calibration, Camera
from .config import Config, DepthConfig
from .depth import View
from .errors import ReconstructionError, require
from .io import load
from .io.images import find_masks, load_frame, load_mask, reduce, undistort
from .result import Reconstruction
from .surface import extract_surface
from .texture import texture
from .types import Bounds, DepthMap, Frame, Image, Report, SparsePoints, Track, no_track
from .volume import fuse

Masks = list[NDArray[np.uint8]]


class _Clock:
    """CPU and wall seconds a stage, into the report."""

    def __init__(self, report: Report) -> None:
        self.stages: dict[str, dict[str, float]] = {}
        report.values["seconds"] = self.stages

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.stages[name] = {
                "wall": round(time.perf_counter() - wall, 3),
                "cpu": round(time.process_time() - cpu, 3),
            }


def _calibration(calib: Calibration | Sequence[Camera] | str | Path) -> Calibration:
    if isinstance(calib, str | Path):
        return load(calib, images=False).calib
    return calib if isinstance(calib, Calibration) else Calibration(tuple(calib))


def _bounds(bounds: ArrayLike | None) -> Bounds | None:
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
    given = _bounds(bounds)
    if isinstance(masks, str | Path):
        masks = find_masks(masks, frames)
    require(masks is None or len(masks) == len(frames), "masks", f"{len(frames)}, one a frame", len(masks or ()))
    report = Report()
    report.values |= {"views": len(frames), "matcher": config.matcher, "config": asdict(config)}
    clock = _Clock(report)

    with clock.stage("io"):
        images, cut, cameras = _inputs(frames, calib, masks, config.depth.max_image_size, track)
    with clock.stage("sparse"):
        points = sparse_stage.find_points(images, cameras, cut, config.sparse, report, track)
        box = given if given is not None else _target(cameras, points, cut)
        # Masks show the target alone: its box bounds the search as given bounds do.
        bounded = given is not None or cut is not None
        ranges = sparse_stage.depth_ranges(cameras, points, box, config.sparse.range_stretch, bounded)
        scores = sparse_stage.view_scores(cameras, points, box, config.depth)
        sources = sparse_stage.choose_sources(scores, config.depth.sources)
    _say_left_out(sources, cameras, report)
    with clock.stage("depth"):
        depths = _depths(images, cameras, sources, ranges, config, track)
    with clock.stage("consistency"):
        filtered = _filtered(depths, cameras, sources, cut, config.depth, track)
        fused = _filtered(depths, cameras, sources, cut, config.depth.loosened(), track)
        _say_kept(filtered, sources, cut is not None, report)
    with clock.stage("volume"):
        views = [d if d is not None else _nothing(c) for d, c in zip(fused, cameras, strict=True)]
        volume = fuse(views, cameras, box, cut, config.volume, report)
    with clock.stage("surface"):
        surface = extract_surface(volume, config.surface, solid=cut is not None)
    with clock.stage("texture"):
        textured = texture(surface, images, cameras, cut, volume.voxel, config.texture, report, track)
    report.values["mesh"] = {"vertices": len(textured.vertices), "faces": len(textured.faces)}
    report.values["peak_memory_mib"] = round(_peak_memory() / 2**20)
    report.values["bounds"] = box.tolist()
    return Reconstruction(
        vertices=textured.vertices,
        faces=textured.faces,
        uv=textured.uv,
        texture=textured.atlas,
        depths=filtered,
        cameras=Calibration(tuple(cameras), calib.source),
        sparse=points,
        bounds=box,
        report=report.values | {"warnings": report.warnings},
    )


def _target(cameras: Sequence[Camera], points: SparsePoints, masks: Masks | None) -> Bounds:
    """The target's box; with masks that of the visual hull."""
    box = sparse_stage.target_box(cameras, points)
    return box if masks is None else sparse_stage.hull_box(cameras, masks, box)


def _say_left_out(sources: list[list[int]], cameras: Sequence[Camera], report: Report) -> None:
    alone = [n for n, s in enumerate(sources) if not s]
    report.values["left_out"] = alone
    if len(alone) == len(sources):
        raise ReconstructionError(
            "no two views see the same surface from less than 65 degrees apart: check the poses, or add views in between"
        )
    for n in alone:
        report.warn(f"view {n} ({cameras[n].name or 'unnamed'}) is left out: no other view sees its surface from a near enough angle")


def _depths(
    images: Sequence[Image],
    cameras: Sequence[Camera],
    sources: list[list[int]],
    ranges: list[tuple[float, float]],
    config: Config,
    track: Track,
) -> list[DepthMap | None]:
    views = [View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c, i) for i, c in zip(images, cameras, strict=True)]
    used = [n for n, s in enumerate(sources) if s]
    rough: dict[int, depth_stage.RoughDepth] = {}
    for n in track(used, "depth, first pass", len(used)):
        others = [views[j] for j in sources[n]]
        if config.matcher == "dcnn":
            rough[n] = depth_stage.network_depth(views[n], others, *ranges[n], config.depth, config.device)
        else:
            rough[n] = depth_stage.sweep_depth(views[n], others, *ranges[n], config.depth)
    depths: list[DepthMap | None] = [None] * len(views)
    for n in track(used, "depth, second pass", len(used)):
        near = [j for j in sources[n] if j in rough]
        depths[n] = depth_stage.refine_depth(views[n], [views[j] for j in near], rough[n], [rough[j] for j in near], config.depth)
    return depths


def _nothing(camera: Camera) -> DepthMap:
    empty = np.zeros((camera.height, camera.width), np.float32)
    return DepthMap(empty, empty)


def _filtered(
    depths: list[DepthMap | None],
    cameras: Sequence[Camera],
    sources: list[list[int]],
    masks: Masks | None,
    config: DepthConfig,
    track: Track,
) -> list[DepthMap | None]:
    """What other views agree with, inside the masks."""
    known = [d if d is not None else _nothing(c) for d, c in zip(depths, cameras, strict=True)]
    out: list[DepthMap | None] = []
    for n in track(range(len(known)), "consistency", len(known)):
        if depths[n] is None:
            out.append(None)
            continue
        kept, _ = depth_stage.filter_depth(n, known, cameras, sources[n], config)
        if masks is not None:
            kept = DepthMap(np.where(masks[n] > 0, kept.depth, 0).astype(np.float32), kept.confidence)
        out.append(kept)
    return out


def _say_kept(filtered: list[DepthMap | None], sources: list[list[int]], masked: bool, report: Report) -> None:
    shares = [None if d is None else round(float((d.depth > 0).mean()), 4) for d in filtered]
    report.values["depth"] = {"kept_share": shares, "sources": sources}
    poor = [n for n, s in enumerate(shares) if s is not None and s < 0.01]
    if poor and not masked:
        report.warn(f"views {poor} contribute almost nothing: less than 1 % of their depth agrees with other views")


def _peak_memory() -> int:
    """Bytes of the largest resident set of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
