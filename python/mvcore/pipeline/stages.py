"""The stages of a reconstruction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from .. import depth as depth_stage
from ..config import CarveConfig, Config, DepthConfig, SurfaceConfig
from ..depth import View
from ..geometry.cameras import Calibration, Camera
from ..mesh.surface import Surface, cleaned, drop_cavities, drop_unseen, isosurface
from ..mesh.texture import Given, texture
from ..silhouettes.object_segmentation import Standing, find_standing
from ..silhouettes.visual_hull import target_hull
from ..sparse import view_selection
from ..sparse.points import find_points
from ..types import Bounds, DepthMap, Image, Report, SparsePoints, Track, no_track
from ..volume.photo_hull import hull_alone, photo_hull, visual_hull
from ..volume.tsdf import Volume, Window, fuse_tiles
from .report import _Clock, _say_left_out
from .result import Reconstruction

Masks = list[NDArray[np.uint8]]


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
    points = find_points(views.images, cameras, masks, config.sparse, report, track)
    box = given if given is not None else _target(cameras, points, masks, config.carve)
    # Masks show the target alone: its box bounds the search as given bounds do.
    bounded = given is not None or masks is not None
    ranges = view_selection.depth_ranges(cameras, points, box, config.sparse.range_stretch, bounded)
    scores = view_selection.view_scores(cameras, points, box, config.depth)
    sources = view_selection.choose_sources(scores, config.depth.sources)
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
    box = view_selection.target_box(cameras, points)
    if masks is None:
        return box
    hull = target_hull(masks, cameras, box, config)
    return hull.box() if hull.occupied.any() else box


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
