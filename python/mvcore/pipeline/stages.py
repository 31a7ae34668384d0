"""The stages of a reconstruction: pure functions of typed values. Each takes what it needs and returns what it found.

`graph` says which stage takes what from which.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import BackgroundConfig, CarveConfig, DepthConfig, SparseConfig, StandingConfig, SurfaceConfig, TextureConfig, VolumeConfig
from ..depth import RoughDepth, View, filter_depth, guided_depth, network_depth, refine_depth, seeded_depth, sweep_depth
from ..errors import ReconstructionError
from ..geometry.cameras import Camera
from ..io.images import mask_warnings, reduce, undistort
from ..mesh.hull_parts import Hulls, find_targets, motions, moved, on_targets
from ..mesh.surface import Surface, cleaned, drop_cavities, drop_unseen, isosurface
from ..mesh.texture import TexturePrior, texture
from ..silhouettes.background_subtraction import Background, foreground, learn_backgrounds
from ..silhouettes.object_segmentation import Standing, find_standing
from ..silhouettes.visual_hull import bounded_hull, shadow
from ..sparse import view_selection
from ..sparse.calibration_check import calibration_error, check_calibration
from ..sparse.features import Features, candidate_pairs, detect
from ..sparse.points import match_and_triangulate
from ..types import Bounds, DepthMap, Image, Report, SparsePoints
from ..volume.photo_hull import hull_alone, photo_hull, visual_hull
from ..volume.tsdf import Volume, Window, fuse_tiles
from .sources import MaskSource, Source

Mask = NDArray[np.uint8]


@dataclass(frozen=True)
class Findings:
    """What a stage has to say: figures for the report, by name, and warnings, which are logged when its task is done."""

    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, report: Report) -> Findings:
        """What lower functions wrote into a report of their own."""
        return cls(dict(report.values), list(report.warnings))


@dataclass(frozen=True)
class Pixels:
    """A view as matching takes it.

    image : (h, w, 3) uint8 RGB, undistorted. mask : (h, w) uint8 of 0 and 255 or None. camera : a pinhole of this size.
    """

    image: Image
    mask: Mask | None
    camera: Camera


def decode(source: Source, mask: MaskSource | None, camera: Camera, limit: int) -> Pixels:
    """A view's image and mask, undistorted and reduced to at most ``limit`` pixels a side."""
    image, reduced = reduce(undistort(source.image(), camera), camera.pinhole(), limit)
    silhouette = None
    if mask is not None:
        silhouette = reduce(undistort(mask.mask(), camera, nearest=True), camera.pinhole(), limit, nearest=True)[0]
    return Pixels(image, silhouette, reduced)


# ---- sparse -----------------------------------------------------------------------------------------------------------


def features(view: Pixels, config: SparseConfig) -> Features:
    """SIFT features of a view, inside its mask."""
    return detect(view.image, view.mask, config.max_features)


@dataclass(frozen=True)
class Survey:
    """Sparse points, the box to search in, and the calibration's health."""

    points: SparsePoints
    box: Bounds
    findings: Findings


def survey(found: Sequence[Features], cameras: Sequence[Camera], bounds: Bounds | None, config: SparseConfig) -> Survey:
    """Matches along the epipolar lines, triangulated; the box of what they show.

    Raises
    ------
    ReconstructionError
        The calibration misses the images by more than ``config.fail_error`` pixels, and few points fit it.
    """
    report, every = Report(quiet=True), list(found)
    pairs = candidate_pairs(cameras, config.neighbours)
    misfit = calibration_error(cameras, every, pairs)
    # An error of a few pixels is worth a wider band; a larger one means that the matches or the calibration are wrong.
    error = misfit.overall or 0.0
    band = max(config.band, 2.0 * error) if error <= config.fail_error else config.band
    points = match_and_triangulate(cameras, every, pairs, band, config)
    check_calibration(misfit, points, cameras, config, report)
    report.values["sparse"] = {
        "features": sum(len(f.positions) for f in every),
        "pairs": len(pairs),
        "points": len(points),
        "mean_error_px": float(points.errors.mean()) if len(points) else None,
    }
    box = bounds if bounds is not None else view_selection.search_box(cameras, points)
    return Survey(points, np.asarray(box, np.float64), Findings.of(report))


# ---- silhouettes ------------------------------------------------------------------------------------------------------


def backgrounds(
    samples: Sequence[Pixels], counts: Sequence[int], cameras: Sequence[Camera], box: Bounds, config: BackgroundConfig, carving: CarveConfig
) -> list[Background]:
    """What stands behind the target, learnt from ``counts[n]`` samples of each camera, one camera after the other."""
    ends = np.cumsum(counts)
    frames = [[samples[k].image for k in range(end - count, end)] for end, count in zip(ends, counts, strict=True)]
    return learn_backgrounds(frames, cameras, box, config, carving)


def all_backgrounds(
    learnt: Sequence[Background] | None, plates: Sequence[Image | None], regions: Sequence[Mask | None]
) -> list[Background]:
    """Of every camera: from its clean plate, else the learnt one, in their order; inside the region where targets may be."""
    rest, out = iter(learnt or ()), []
    for plate, region in zip(plates, regions, strict=True):
        one = next(rest) if plate is None else Background.from_plate(plate)
        if region is not None:
            h, w = one.region.shape
            inside = cv2.resize(region, (w, h), interpolation=cv2.INTER_NEAREST) > 0
            one = replace(one, region=one.region & inside)
        out.append(one)
    return out


def silhouettes(
    views: Sequence[Pixels],
    learnt: Sequence[Background],
    cameras: Sequence[Camera],
    box: Bounds,
    config: BackgroundConfig,
    carving: CarveConfig,
) -> list[Mask]:
    """The target's masks at one frame, by background subtraction."""
    return foreground([v.image for v in views], cameras, list(learnt), box, config, carving)


@dataclass(frozen=True)
class Target:
    """What masks show together.

    parts : middle, box and volume of each target, none where no target is seen. hulls : their surfaces. box : (2, 3) around them.
    crops : x, y, width, height of each view's part that shows them, in pixels of the undistorted view. findings : what is
    suspicious about masks that the caller gave.
    """

    parts: list[dict[str, Any]]
    hulls: Hulls
    box: Bounds
    crops: list[Part]
    findings: Findings = field(default_factory=Findings)


def locate(
    views: Sequence[Pixels],
    masks: Sequence[Mask] | None,
    cameras: Sequence[Camera],
    box: Bounds,
    bounds: Bounds | None,
    carving: CarveConfig,
    least: float,
    margin: float,
) -> Target:
    """The targets that masks show: parts of their visual hull, and where each view shows them; ``masks`` are the views' own if None.

    ``least`` and ``margin`` are those of `VideoConfig`.
    """
    every = list(_Masks(views)) if masks is None else list(masks)
    findings = Findings(warnings=mask_warnings(every) if masks is None else [])
    hull = bounded_hull(every, cameras, box, carving)
    parts, hulls = find_targets(hull, every, cameras, least)
    if not parts:
        return Target([], hulls, box, [], findings)
    tight = np.stack([np.min([t["box"][0] for t in parts], 0), np.max([t["box"][1] for t in parts], 0)])
    if bounds is not None:
        tight = np.stack([np.maximum(tight[0], bounds[0]), np.minimum(tight[1], bounds[1])])
    crops = []
    for mask, camera in zip(every, cameras, strict=True):
        y, x = np.nonzero((mask > 0) | (shadow(hull, camera) > 0))
        low, high = (np.array([x.min(), y.min()]), np.array([x.max(), y.max()]) + 1) if len(x) else (np.zeros(2, int), np.array([32, 32]))
        pad = 16 + (margin * (high - low)).astype(int)
        low, high = np.maximum(low - pad, 0), np.minimum(high + pad, (camera.width, camera.height))
        crops.append((int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])))
    return Target(parts, hulls, tight, crops, findings)


Part = tuple[int, int, int, int]
"""x, y, width, height in pixels."""


def cropped_camera(camera: Camera, reduced: Camera, part: Part, limit: int) -> tuple[Camera, Window, Part]:
    """The camera of a part of a view, at most ``limit`` pixels a side.

    Parameters
    ----------
    camera : of the full view. reduced : of the view in whose pixels ``part`` is.

    Returns
    -------
    The part's camera, what the whole view is in its pixels, and the part in pixels of the full view.
    """
    scale = camera.width / reduced.width
    x, y, w, h = part
    if scale != 1.0:
        x, y = int(x * scale), int(y * scale)
        right, bottom = int(np.ceil((part[0] + w) * scale)), int(np.ceil((part[1] + h) * scale))
        w, h = min(camera.width, right) - x, min(camera.height, bottom) - y
    within = camera.pinhole().cropped(x, y, w, h)
    longer = max(w, h)
    small = within if longer <= limit else within.resized(max(2, round(w * limit / longer)), max(2, round(h * limit / longer)))
    scale = small.width / w
    left, top = -x * scale, -y * scale
    return small, (left, top, left + (camera.width - 1) * scale, top + (camera.height - 1) * scale), (x, y, w, h)


def crop(view: Pixels, masks: Sequence[Mask] | None, n: int, source: Source, camera: Camera, part: Part, limit: int) -> Pixels:
    """The part of view ``n`` that shows the targets, from the full image where the view was reduced.

    ``masks`` : of all views, as large as they; None where the view has its own. ``part`` : in the view's pixels.
    """
    image, mask = view.image, view.mask if masks is None else masks[n]
    assert mask is not None
    if view.camera.width != camera.width:
        image = undistort(source.image(), camera)
        mask = cv2.resize(mask, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
    small, _, (x, y, w, h) = cropped_camera(camera, view.camera, part, limit)
    window = np.s_[y : y + h, x : x + w]
    within = camera.pinhole().cropped(x, y, w, h)
    picture, _ = reduce(np.ascontiguousarray(image[window]), within, limit)
    return Pixels(picture, reduce(np.ascontiguousarray(mask[window]), within, limit, nearest=True)[0], small)


# ---- plan -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """Where to search: the box, the views' depth ranges, their source views, best first; none of these where there is only the hull."""

    box: Bounds
    ranges: list[tuple[float, float]]
    sources: list[list[int]]
    findings: Findings


@dataclass(frozen=True)
class PlanSettings:
    """What of the settings a plan depends on."""

    depth: DepthConfig
    range_stretch: float
    stereo_angle: float


def plan(cameras: Sequence[Camera], points: SparsePoints, box: Bounds, bounded: bool, masked: bool, settings: PlanSettings) -> Plan:
    """Depth ranges and source views. With masks and cameras too far apart for stereo there are no sources: the hull is the surface.

    Raises
    ------
    ReconstructionError
        No two views see the same surface, and there are no masks to carve with.
    """
    ranges = view_selection.depth_ranges(cameras, points, box, settings.range_stretch, bounded)
    sources = view_selection.choose_sources(view_selection.view_scores(cameras, points, box, settings.depth), settings.depth.sources)
    nearest = view_selection.nearest_angles(cameras, view_selection.view_middles(cameras, points, box))
    surface = "depth maps in the visual hull" if masked else "depth maps"
    warnings = []
    if masked and np.median(nearest) > settings.stereo_angle:
        surface, sources = "visual hull", [[] for _ in cameras]
        warnings.append(
            f"the cameras stand {np.median(nearest):.0f} degrees apart as seen from the target, too far for stereo: "
            "the surface is the visual hull of the silhouettes"
        )
    elif not any(sources):
        raise ReconstructionError(
            "no two views see the same surface from less than 65 degrees apart: check the poses, or add views in between"
        )
    alone = [n for n, s in enumerate(sources) if not s]
    if surface != "visual hull":
        for n in alone:
            name = cameras[n].name or "unnamed"
            warnings.append(f"view {n} ({name}) is left out: no other view sees its surface from a near enough angle")
    figures = {"left_out": alone, "surface": surface, "nearest_view_degrees": [round(a, 1) for a in nearest]}
    return Plan(box, ranges, sources, Findings(figures, warnings))


# ---- depth ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DepthJob:
    """One reference view among its sources: cameras (the reference's first) and the z-depths between which to search."""

    cameras: list[Camera]
    near: float
    far: float


def _matched_views(pixels: Sequence[Pixels], job: DepthJob) -> tuple[View, list[View]]:
    views = []
    for one, camera in zip(pixels, job.cameras, strict=True):
        views.append(View(cv2.cvtColor(one.image, cv2.COLOR_RGB2GRAY), camera, one.image, one.mask))
    return views[0], views[1:]


def match(pixels: Sequence[Pixels], job: DepthJob, prior: Prediction | None, config: DepthConfig, matcher: str, device: str) -> RoughDepth:
    """First pass: a view's depth from images alone, started from a surface expected there if there is one (not with the network)."""
    reference, sources = _matched_views(pixels, job)
    if matcher == "dcnn":
        return network_depth(reference, sources, job.near, job.far, config, device)
    if prior is None:
        return sweep_depth(reference, sources, job.near, job.far, config)
    seed = rendered_depth(prior.surface, job.cameras[0])
    if reference.mask is not None:
        seed = np.where(reference.mask > 0, seed, 0).astype(np.float32)
    return seeded_depth(reference, sources, job.near, job.far, seed, config)


def rendered_depth(surface: Surface, camera: Camera) -> NDArray[np.float32]:
    """z-depth of a surface in a view, (h, w) float32, 0 = none."""
    vertices = np.ascontiguousarray(surface.vertices)
    return _core.rasterize(vertices, surface.faces, camera.projection, camera.width, camera.height)[0]


def refine(pixels: Sequence[Pixels], job: DepthJob, rough: Sequence[RoughDepth], config: DepthConfig, last: bool) -> DepthMap:
    """Second pass, with the sources' first passes as witnesses; ``rough[0]`` is the reference's. ``last``: no third pass follows."""
    reference, sources = _matched_views(pixels, job)
    return refine_depth(reference, sources, rough[0], list(rough[1:]), config, last)


@dataclass(frozen=True)
class Draft:
    """The surface of the second pass's depth maps, and the silhouettes that complete it, if any were needed."""

    surface: Surface
    completion: Standing | None
    findings: Findings


def rematch(pixels: Sequence[Pixels], job: DepthJob, depth: DepthMap, rough: RoughDepth, draft: Draft, config: DepthConfig) -> DepthMap:
    """Third pass: a view's depth, started from the surface that all views made."""
    reference, sources = _matched_views(pixels, job)
    return guided_depth(reference, sources, depth, rough, rendered_depth(draft.surface, job.cameras[0]), config)


def filtered(depths: Sequence[DepthMap], view: Pixels, cameras: Sequence[Camera], config: DepthConfig) -> DepthMap:
    """What of ``depths[0]`` the other maps agree with, inside the view's mask."""
    kept, _ = filter_depth(0, depths, cameras, range(1, len(cameras)), config)
    if view.mask is None:
        return kept
    return DepthMap(np.where(view.mask > 0, kept.depth, 0).astype(np.float32), kept.confidence)


def kept_share(depths: Sequence[DepthMap | None], sources: list[list[int]], masked: bool) -> Findings:
    """The share of each view's pixels whose depth other views agree with, and a warning where there is almost none."""
    shares: list[float | None] = []
    for n in range(len(depths)):
        view = depths[n]
        shares.append(None if view is None else round(float((view.depth > 0).mean()), 4))
    poor = [n for n, s in enumerate(shares) if s is not None and s < 0.01]
    warnings = []
    if poor and not masked:
        warnings.append(f"views {poor} contribute almost nothing: less than 1 % of their depth agrees with other views")
    return Findings({"depth": {"kept_share": shares, "sources": sources}}, warnings)


def witnesses(cameras: Sequence[Camera], plan: Plan, count: int, config: DepthConfig) -> list[list[int]]:
    """More views than a view is matched with, by which its depth is checked."""
    scores = view_selection.view_scores(cameras, no_points(len(cameras)), plan.box, config)
    return view_selection.choose_sources(scores, count)


def no_points(views: int) -> SparsePoints:
    """Where masks bound the search no points are needed."""
    return SparsePoints(np.zeros((0, 3)), np.zeros((views, 0), bool), np.zeros(0, np.float32))


# ---- volume -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rig:
    """The views of a frame: their cameras, what each camera saw in the pixels of a cropped view, whether there are masks, the box."""

    cameras: list[Camera]
    windows: list[Window] | None
    masked: bool
    box: Bounds
    stereo: bool


class _Masks(Sequence[Mask]):
    """The masks of views, read one by one."""

    def __init__(self, pixels: Sequence[Pixels]) -> None:
        self._pixels = pixels

    def __len__(self) -> int:
        return len(self._pixels)

    def __getitem__(self, n: Any) -> Any:
        mask = self._pixels[n].mask
        assert mask is not None
        return mask


class _Images(Sequence[Image]):
    """The images of views, read one by one."""

    def __init__(self, pixels: Sequence[Pixels]) -> None:
        self._pixels = pixels

    def __len__(self) -> int:
        return len(self._pixels)

    def __getitem__(self, n: Any) -> Any:
        return self._pixels[n].image


@dataclass(frozen=True)
class FieldSettings:
    """What of the settings the field and its isosurface depend on."""

    volume: VolumeConfig
    carve: CarveConfig
    standing: StandingConfig
    min_component: float
    unseen_reach: float | None
    decimation: float


def _field(
    depths: Sequence[DepthMap | None],
    pixels: Sequence[Pixels],
    rig: Rig,
    completion: Standing | None,
    settings: FieldSettings,
    report: Report,
) -> Iterator[Volume]:
    """The signed distance field of filtered depth maps, in parts; of the visual hull where there is no stereo."""
    masks = _Masks(pixels) if rig.masked else None
    if rig.stereo:
        outlines = None if completion is None else completion.silhouettes
        yield from fuse_tiles(depths, rig.cameras, rig.box, masks, settings.volume, report, rig.windows, outlines, settings.unseen_reach)
    elif settings.carve.photo_consistency:
        assert masks is not None
        hull = visual_hull(list(masks), rig.cameras, rig.box, settings.volume, report, rig.windows)
        yield photo_hull(hull, list(_Images(pixels)), rig.cameras, settings.carve, report)
    else:
        nothing, coarse = hull_alone(rig.cameras, settings.volume)
        yield from fuse_tiles(nothing, rig.cameras, rig.box, masks, coarse, report, rig.windows, None)


def _isosurface(
    depths: Sequence[DepthMap | None],
    pixels: Sequence[Pixels],
    rig: Rig,
    completion: Standing | None,
    settings: FieldSettings,
    report: Report,
) -> Surface:
    if completion is None:
        # With masks what no camera sees is dropped afterwards, face by face: they stay small until then.
        decimation = 0.0 if rig.masked else settings.decimation
        return isosurface(_field(depths, pixels, rig, None, settings, report), decimation)
    agreeing = completion.agreeing(depths, rig.cameras)
    return drop_cavities(isosurface(_field(agreeing, pixels, rig, completion, settings, report)))


DRAFT_VOXEL = 1.4
"""Voxels of the draft against the final ones where there are no masks: half the time in a field that holds all that is in view."""


def draft(depths: Sequence[DepthMap | None], pixels: Sequence[Pixels], rig: Rig, settings: FieldSettings) -> Draft:
    """What all views make together of their depth maps, for the third pass to start from."""
    completion, findings = complete(depths, pixels, rig, settings)
    volume, times = settings.volume, 1.0 if rig.masked else DRAFT_VOXEL
    wide = replace(volume, footprints=times * volume.footprints, voxel=volume.voxel and times * volume.voxel)
    # What no camera sees, no view's depth starts from.
    wanted = replace(settings, volume=wide, unseen_reach=settings.unseen_reach or 0.0)
    surface = _isosurface(depths, pixels, rig, completion, wanted, Report(quiet=True))
    # Nobody sees it: it is neither closed nor smoothed nor decimated.
    plain = SurfaceConfig(min_component=settings.min_component, close_holes=0, decimation=0)
    return Draft(cleaned(surface, 0.0, plain, solid=rig.masked), completion, findings)


def complete(
    depths: Sequence[DepthMap | None], pixels: Sequence[Pixels], rig: Rig, settings: FieldSettings
) -> tuple[Standing | None, Findings]:
    """Silhouettes of an object that depth maps show little of, where there are no masks."""
    report = Report(quiet=True)
    if rig.masked or not settings.standing.enabled:
        return None, Findings()
    found = find_standing(_Images(pixels), rig.cameras, depths, rig.box, settings.standing, settings.carve, report)
    if found is not None:
        share = report.values["standing"]["measured"]
        report.warn(
            f"the depth maps show only {share:.0%} of what stands in the middle: its outlines in the images complete it, "
            "and hollows that no outline shows are filled"
        )
    return found, Findings.of(report)


# ---- mesh -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Extracted:
    """The isosurface of the field. voxel : of the field, world units. completed : silhouettes found without masks bound it as well."""

    surface: Surface
    voxel: float
    completed: bool
    findings: Findings


def extract(
    depths: Sequence[DepthMap | None],
    pixels: Sequence[Pixels],
    rig: Rig,
    draft: Draft | None,
    target: Target | None,
    settings: FieldSettings,
) -> Extracted:
    """Depth maps to the field and its isosurface; a draft's silhouettes serve again, else they are sought.

    Raises
    ------
    ReconstructionError
        Nothing lies inside the box.
    """
    report = Report(quiet=True)
    completion, findings = (draft.completion, draft.findings) if draft else complete(depths, pixels, rig, settings)
    surface = _isosurface(depths, pixels, rig, completion, settings, report)
    if target is not None and len(surface.faces):
        surface = on_targets(surface, target.hulls)
    found = Findings(findings.figures | report.values, findings.warnings + report.warnings)
    return Extracted(surface, float(report.values["volume"]["voxel"]), completion is not None, found)


@dataclass(frozen=True)
class Cleaned:
    """The mesh before it is textured."""

    surface: Surface
    findings: Findings


def clean(extracted: Extracted, rig: Rig, config: SurfaceConfig) -> Cleaned:
    """Unseen sides left open, small parts dropped, holes closed, decimated as configured."""
    surface, figures = extracted.surface, {}
    # A hull alone has nothing measured beside which its other sides would be guesses.
    if config.unseen_reach is not None and (extracted.completed or (rig.masked and rig.stereo)):
        kept = drop_unseen(surface, rig.cameras, extracted.voxel, config.unseen_reach)
        figures["unseen_left_open"] = len(surface.faces) - len(kept.faces)
        surface = kept
    return Cleaned(cleaned(surface, extracted.voxel, config, solid=rig.masked), Findings(figures))


@dataclass(frozen=True)
class Textured:
    """A finished mesh: the fields of `mvcore.Reconstruction`. gains : (V, 3) float32, each image's colour factors."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float32]
    texture: Image
    face_views: NDArray[np.int32]
    gains: NDArray[np.float32]
    findings: Findings


def paint(
    mesh: Cleaned,
    extracted: Extracted,
    pixels: Sequence[Pixels],
    rig: Rig,
    settled: Textured | None,
    prior: Prediction | None,
    config: TextureConfig,
) -> Textured:
    """The mesh with its texture. ``settled`` settles the colours, ``prior`` where its surface is the image of each face if it can."""
    known = TexturePrior()
    if settled is not None:
        known = replace(known, gains=settled.gains)
    if prior is not None:
        known = replace(known, centers=prior.centers, views=prior.face_views)
    masks = _Masks(pixels) if rig.masked else None
    done = texture(mesh.surface, _Images(pixels), rig.cameras, masks, extracted.voxel, config, prior=known)
    figures = {"texture": done.figures, "mesh": {"vertices": len(done.vertices), "faces": len(done.faces)}}
    findings = Findings(figures, list(done.warnings))
    return Textured(done.vertices, done.faces, done.uv, done.atlas, done.view, done.gains, findings)


# ---- clips ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Prediction:
    """The surface of the frame before where its targets should be now.

    surface : in the world. centers : (F, 3) float64 of its faces. face_views : (F,) int32, their images. poses : (n, 4, 4), the targets'
    motions since.
    """

    surface: Surface
    centers: NDArray[np.float64]
    face_views: NDArray[np.int32]
    poses: NDArray[np.float64]


def predict(mesh: Textured, before: Target | None, now: Target | None) -> Prediction:
    """Moves the surface of the frame before as the targets' hulls moved."""
    poses, vertices = np.zeros((0, 4, 4)), mesh.vertices
    if before is not None and now is not None and before.parts and now.parts:
        poses = motions(before.parts, now.parts, before.hulls, now.hulls)
        vertices = moved(vertices, poses, before.hulls)
    centers = np.ascontiguousarray(vertices[mesh.faces].mean(1))
    return Prediction(Surface(np.ascontiguousarray(vertices), mesh.faces), centers, mesh.face_views, poses)
