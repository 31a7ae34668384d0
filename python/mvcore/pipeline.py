"""The stages in order, and nothing else."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from . import depth as depth_stage
from . import sparse as sparse_stage
from .cameras import Calibration, Camera
from .carve import hull_alone, photo_hull, target_hull, visual_hull
from .config import CarveConfig, Config, DepthConfig, SurfaceConfig
from .depth import View
from .errors import ReconstructionError, require
from .io import load
from .io.images import find_masks, load_frame, load_mask, reduce, undistort
from .result import Reconstruction
from .standing import Standing, find_standing
from .surface import Surface, cleaned, drop_cavities, drop_unseen, isosurface
from .texture import Given, texture
from .types import Bounds, DepthMap, Frame, Image, Report, SparsePoints, Track, no_track
from .volume import Volume, Window, fuse_tiles

Masks = list[NDArray[np.uint8]]


class _Clock:
    """CPU and wall seconds a stage, into the report; what is done twice adds up."""

    def __init__(self, report: Report) -> None:
        self.stages: dict[str, dict[str, float]] = {}
        report.values["seconds"] = self.stages

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            spent = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
            before = self.stages.get(name, {})
            self.stages[name] = {kind: round(before.get(kind, 0.0) + seconds, 3) for kind, seconds in spent.items()}


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


@dataclass(frozen=True)
class Views:
    """Undistorted images of one instant, their masks (or None) and their cameras; ``windows`` where they are cut from larger ones."""

    images: list[Image]
    masks: Masks | None
    cameras: list[Camera]
    windows: list[Window] | None = None

    def view(self, n: int) -> View:
        """View ``n`` as the depth stage takes it."""
        mask = None if self.masks is None else self.masks[n]
        return View(cv2.cvtColor(self.images[n], cv2.COLOR_RGB2GRAY), self.cameras[n], self.images[n], mask)


@dataclass(frozen=True)
class Plan:
    """Where to search: sparse points, the target's box, the views' depth ranges and their source views, best first."""

    points: SparsePoints
    box: Bounds
    ranges: list[tuple[float, float]]
    sources: list[list[int]]


def make_plan(views: Views, given: Bounds | None, config: Config, report: Report, track: Track = no_track) -> Plan:
    """Sparse points, and the search that they and the bounds allow.

    Raises
    ------
    ReconstructionError
        The calibration does not fit the images, or no two views see the same surface.
    """
    cameras, masks = views.cameras, views.masks
    points = sparse_stage.find_points(views.images, cameras, masks, config.sparse, report, track)
    box = given if given is not None else _target(cameras, points, masks, config.carve)
    # Masks show the target alone: its box bounds the search as given bounds do.
    bounded = given is not None or masks is not None
    ranges = sparse_stage.depth_ranges(cameras, points, box, config.sparse.range_stretch, bounded)
    scores = sparse_stage.view_scores(cameras, points, box, config.depth)
    sources = sparse_stage.choose_sources(scores, config.depth.sources)
    _say_left_out(sources, cameras, report)
    return Plan(points, box, ranges, sources)


@dataclass(frozen=True)
class Draft:
    """The surface of the second pass's depth maps, and the silhouettes that complete it, if any were needed."""

    surface: Surface
    found: Standing | None


DRAFT_VOXEL = 1.4
"""Voxels of the draft against the final ones where there are no masks: half the time in a field that holds all that is in view."""


def make_draft(
    views: Views,
    plan: Plan,
    depths: list[DepthMap | None],
    config: Config,
    report: Report,
    track: Track = no_track,
    clock: _Clock | None = None,
) -> Draft:
    """What all views make together of their depth maps, for the third pass to start from."""
    clock = clock or _Clock(Report())
    with clock.stage("consistency"):
        loose = filter_views(views, plan, depths, config.depth.loosened(), track)
    found = _standing(views, plan, loose, config, report, clock)
    with clock.stage("volume"):
        volume, times = config.volume, DRAFT_VOXEL if views.masks is None else 1.0
        wide = replace(volume, footprints=times * volume.footprints, voxel=volume.voxel and times * volume.voxel)
        surface = _isosurface(views, plan, loose, found, replace(config, volume=wide), Report())
        # Nobody sees it: it is neither closed nor smoothed nor decimated.
        plain = SurfaceConfig(min_component=config.surface.min_component, close_holes=0)
        return Draft(cleaned(surface, plain, solid=views.masks is not None), found)


def _standing(views: Views, plan: Plan, loose: list[DepthMap | None], config: Config, report: Report, clock: _Clock) -> Standing | None:
    """Silhouettes where there are no masks and little depth."""
    if views.masks is not None or not config.standing.enabled:
        return None
    with clock.stage("silhouettes"):
        return find_standing(views.images, views.cameras, loose, plan.box, config.standing, config.carve, report)


def _isosurface(views: Views, plan: Plan, loose: list[DepthMap | None], found: Standing | None, config: Config, report: Report) -> Surface:
    """Surface of the field of depth maps that were filtered for fusion."""
    if found is None:
        return isosurface(fuse_views(views, plan, loose, config, report))
    agreeing = found.agreeing(loose, views.cameras)
    return drop_cavities(isosurface(fuse_views(views, plan, agreeing, config, report, found.silhouettes)))


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


def fuse_views(
    views: Views, plan: Plan, depths: list[DepthMap | None], config: Config, report: Report, found: Masks | None = None
) -> Iterator[Volume]:
    """The signed distance field of filtered depth maps, in parts; of the visual hull where no view has sources but masks are given.

    ``found`` are silhouettes that complete it where there are no masks.
    """
    if any(plan.sources) or views.masks is None:
        maps, settings = [d if d is not None else _nothing(c) for d, c in zip(depths, views.cameras, strict=True)], config.volume
    elif config.carve.photo_consistency:
        hull = visual_hull(views.masks, views.cameras, plan.box, config.volume, report, views.windows)
        yield photo_hull(hull, views.images, views.cameras, config.carve, report)
        return
    else:
        maps, settings = hull_alone(views.cameras, config.volume)
    yield from fuse_tiles(maps, views.cameras, plan.box, views.masks, settings, report, views.windows, found)


def _shown(views: Views, surface: Surface, config: Config, report: Report) -> Surface:
    """A surface that silhouettes bound, without the sides that no photograph shows; the report knows the field's voxel."""
    reach = config.surface.unseen_reach
    if reach is None:
        return surface
    kept = drop_unseen(surface, views.cameras, report.values["volume"]["voxel"], reach)
    report.values["unseen_left_open"] = len(surface.faces) - len(kept.faces)
    return kept


def finish(
    views: Views,
    plan: Plan,
    filtered: list[DepthMap | None],
    found: Surface,
    config: Config,
    report: Report,
    track: Track = no_track,
    clock: _Clock | None = None,
    given: Given | None = None,
    completed: bool = False,
) -> Reconstruction:
    """From the isosurface found in the field to the textured mesh; the report knows the field's voxel.

    ``completed`` says that silhouettes found without masks bound the surface as well.
    """
    clock = clock or _Clock(Report())
    with clock.stage("surface"):
        # A hull alone has nothing measured beside which its other sides would be guesses.
        if completed or (views.masks is not None and any(plan.sources)):
            found = _shown(views, found, config, report)
        surface = cleaned(found, config.surface, solid=views.masks is not None)
    with clock.stage("texture"):
        voxel = report.values["volume"]["voxel"]
        textured = texture(surface, views.images, views.cameras, views.masks, voxel, config.texture, report, track, given or Given())
    report.values["mesh"] = {"vertices": len(textured.vertices), "faces": len(textured.faces)}
    report.values["texture"]["gains"] = textured.gains.tolist()
    report.values["bounds"] = plan.box.tolist()
    return Reconstruction(
        vertices=textured.vertices,
        faces=textured.faces,
        uv=textured.uv,
        texture=textured.atlas,
        depths=filtered,
        cameras=Calibration(tuple(views.cameras)),
        sparse=plan.points,
        bounds=plan.box,
        face_views=textured.view,
        report=report.values | {"warnings": report.warnings},
    )


def _target(cameras: Sequence[Camera], points: SparsePoints, masks: Masks | None, config: CarveConfig) -> Bounds:
    """The target's box; with masks that of the visual hull."""
    box = sparse_stage.target_box(cameras, points)
    if masks is None:
        return box
    hull = target_hull(masks, cameras, box, config)
    return hull.box() if hull.occupied.any() else box


def _say_left_out(sources: list[list[int]], cameras: Sequence[Camera], report: Report) -> None:
    alone = [n for n, s in enumerate(sources) if not s]
    report.values["left_out"] = alone
    if len(alone) == len(sources):
        raise ReconstructionError(
            "no two views see the same surface from less than 65 degrees apart: check the poses, or add views in between"
        )
    for n in alone:
        report.warn(f"view {n} ({cameras[n].name or 'unnamed'}) is left out: no other view sees its surface from a near enough angle")


def first_pass(views: Views, plan: Plan, n: int, config: Config) -> depth_stage.RoughDepth:
    """View ``n``'s depth from photographs alone."""
    reference, others = views.view(n), [views.view(j) for j in plan.sources[n]]
    if config.matcher == "dcnn":
        return depth_stage.network_depth(reference, others, *plan.ranges[n], config.depth, config.device)
    return depth_stage.sweep_depth(reference, others, *plan.ranges[n], config.depth)


def second_pass(
    views: Views, plan: Plan, n: int, rough: Mapping[int, depth_stage.RoughDepth], config: Config, last: bool = True
) -> DepthMap:
    """View ``n``'s depth with its sources' first passes as witnesses; ``last`` says that no third pass follows."""
    near = [j for j in plan.sources[n] if j in rough]
    return depth_stage.refine_depth(views.view(n), [views.view(j) for j in near], rough[n], [rough[j] for j in near], config.depth, last)


def third_pass(
    views: Views, plan: Plan, n: int, found: DepthMap | None, rough: depth_stage.RoughDepth, surface: Surface, config: Config
) -> DepthMap | None:
    """View ``n``'s depth, started from the surface that all views made."""
    if found is None:
        return None
    camera = views.cameras[n]
    seen, _ = _core.rasterize(surface.vertices, surface.faces, camera.projection, camera.width, camera.height)
    return depth_stage.guided_depth(views.view(n), [views.view(j) for j in plan.sources[n]], found, rough, seen, config.depth)


def _depths(views: Views, plan: Plan, config: Config, track: Track) -> tuple[dict[int, depth_stage.RoughDepth], list[DepthMap | None]]:
    """The first and the second pass of the views that have sources."""
    used = [n for n, s in enumerate(plan.sources) if s]
    rough = {n: first_pass(views, plan, n, config) for n in track(used, "depth, first pass", len(used))}
    depths: list[DepthMap | None] = [None] * len(views.images)
    for n in track(used, "depth, second pass", len(used)):
        depths[n] = second_pass(views, plan, n, rough, config, last=not config.depth.surface_rounds)
    return rough, depths


def _nothing(camera: Camera) -> DepthMap:
    empty = np.zeros((camera.height, camera.width), np.float32)
    return DepthMap(empty, empty)


def filter_views(
    views: Views, plan: Plan, depths: list[DepthMap | None], config: DepthConfig, track: Track = no_track
) -> list[DepthMap | None]:
    """What other views agree with, inside the masks."""
    known = [d if d is not None else _nothing(c) for d, c in zip(depths, views.cameras, strict=True)]
    out: list[DepthMap | None] = []
    for n in track(range(len(known)), "consistency", len(known)):
        if depths[n] is None:
            out.append(None)
            continue
        kept, _ = depth_stage.filter_depth(n, known, views.cameras, plan.sources[n], config)
        if views.masks is not None:
            kept = DepthMap(np.where(views.masks[n] > 0, kept.depth, 0).astype(np.float32), kept.confidence)
        out.append(kept)
    return out


def _say_kept(filtered: list[DepthMap | None], sources: list[list[int]], masked: bool, report: Report) -> None:
    shares = [None if d is None else round(float((d.depth > 0).mean()), 4) for d in filtered]
    report.values["depth"] = {"kept_share": shares, "sources": sources}
    poor = [n for n, s in enumerate(shares) if s is not None and s < 0.01]
    if poor and not masked:
        report.warn(f"views {poor} contribute almost nothing: less than 1 % of their depth agrees with other views")


def _say_completed(report: Report) -> None:
    share = report.values["standing"]["measured"]
    report.warn(
        f"the depth maps show only {share:.0%} of what stands in the middle: its outlines in the photographs complete it, "
        "and hollows that no outline shows are filled"
    )


def _peak_memory() -> int:
    """Bytes of the largest resident set of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
