"""An instant of a clip: the pieces of work from frames to a textured mesh, and the keys under which their results are kept.

Each piece is a pure function of stored inputs: `learn`, `prepare`, `expect`, `first`, `second`, `fuse`, `mesh`. It writes one entry of the
`Store` under a key made of its inputs and settings, so that any executor may run it, twice if need be, and a run that was killed finds
what it had finished.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import Config
from ..depth import RoughDepth, seeded_depth
from ..errors import ReconstructionError, require
from ..geometry.cameras import Camera
from ..io.clips import Clips
from ..io.images import reduce, undistort
from ..mesh.surface import isosurface
from ..mesh.texture import Given
from ..pipeline.result import Reconstruction
from ..pipeline.stages import Plan, Views, filter_views, finish, first_pass, fuse_views, second_pass
from ..pipeline.store import Entry, Store, digest, file_digest
from ..silhouettes.background_subtraction import Background, foreground, learn_backgrounds
from ..silhouettes.visual_hull import Occupancy, shadow, target_hull
from ..sparse import view_selection
from ..sparse.points import find_points
from ..types import Bounds, DepthMap, Image, Report, SparsePoints
from ..volume.tsdf import Volume
from .tracking import Hulls, find_targets, motions, moved, on_targets

VERSION = 9
"""Of the entries' content: results of other versions are not taken for one's own."""
NO_POINTS = SparsePoints(np.zeros((0, 3)), np.zeros((0, 0), bool), np.zeros(0, np.float32))


@dataclass(frozen=True)
class Job:
    """All that the pieces of work share. ``plates`` and ``roads`` are None where a camera has none."""

    clips: Clips
    masks: Clips | None
    plates: tuple[Image | None, ...]
    roads: tuple[NDArray[np.uint8] | None, ...]
    whole: bool
    bounds: Bounds | None
    config: Config
    folder: Path

    @property
    def store(self) -> Store:
        """Where results lie."""
        return Store(self.folder)

    @property
    def cameras(self) -> list[Camera]:
        """Of undistorted frames."""
        return [c.pinhole() for c in self.clips.calib]


@lru_cache(maxsize=256)
def _file_key(path: Path, _size: int, _changed: int) -> str:
    return file_digest(path)


def _content(source: Any, number: int) -> Any:
    """What a frame depends on: the bytes of its file and its number, or its pixels."""
    if isinstance(source, np.ndarray):
        return digest(source[number])
    path = source if isinstance(source, Path) else source[number]
    status = path.stat()
    return [_file_key(path, status.st_size, status.st_mtime_ns), number if isinstance(source, Path) else 0]


def frames_key(clips: Clips, numbers: NDArray[np.int64]) -> str:
    """Of one frame a camera, by their content."""
    return digest([_content(c.source, int(n)) for c, n in zip(clips.clips, numbers, strict=True)])


def base_key(job: Job) -> str:
    """Of all that every result of a job depends on, but for its frames."""
    cameras = [[c.K, c.R, c.t, c.width, c.height, c.distortion, c.fisheye] for c in job.clips.calib]
    config = asdict(job.config)
    config["video"].pop("chains")  # how many at a time changes no result
    return digest("mvcore", VERSION, cameras, config, job.plates, job.roads, job.whole, job.bounds)


def learning_samples(job: Job) -> NDArray[np.int64]:
    """Frame numbers (samples, cameras) that a background is learnt from: of the whole clips, whatever part is reconstructed."""
    line = job.clips.timeline
    count = min(len(line), job.config.target.samples)
    return line[sorted({int(n) for n in np.linspace(0, len(line) - 1, count).round()})]


def once(work: Callable[..., tuple[dict[str, NDArray[Any]], dict[str, Any]]]) -> Callable[..., str]:
    """Runs a piece of work unless the store has its result; returns the key."""

    def run(job: Job, key: str, *arguments: Any) -> str:
        store = job.store
        if key not in store:
            store.save(key, *work(job, *arguments))
        return key

    run.__name__, run.__qualname__, run.__module__ = work.__name__, work.__name__, work.__module__
    run.__doc__ = work.__doc__
    return run


def stored(job: Job, key: str) -> Entry:
    """A result that was written before."""
    entry = job.store.load(key)
    if entry is None:
        raise FileNotFoundError(f"{job.store.path(key)}: this result has vanished from the workdir")
    return entry


@once
def learn(job: Job) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Once a clip: the calibration's health, the volume to look at, and the backgrounds that are not given."""
    report = Report()
    cameras = job.cameras
    images = [job.clips.undistorted(n, 0) for n in range(len(cameras))]
    limit = job.config.depth.max_image_size
    small = [reduce(i, c, limit) for i, c in zip(images, cameras, strict=True)]
    points = find_points([s[0] for s in small], [s[1] for s in small], None, job.config.sparse, report)
    box = job.bounds if job.bounds is not None else view_selection.target_box(cameras, points)
    arrays: dict[str, NDArray[Any]] = {"box": box}
    if job.masks is None and not job.whole:
        missing = [n for n, p in enumerate(job.plates) if p is None]
        learnt: dict[int, Background] = {}
        if missing:
            chosen = learning_samples(job)
            require(len(chosen) >= 3, "background", "a clean plate of every camera, or at least 3 instants to learn it from", len(chosen))
            frames, reduced = [], []
            for n in missing:  # reduced at once: whole clips of large frames would not fit into memory
                pairs = [reduce(job.clips.undistorted_frame(n, int(t)), cameras[n], job.config.target.max_size) for t in chosen[:, n]]
                frames.append([p[0] for p in pairs])
                reduced.append(pairs[0][1])
            found = learn_backgrounds(frames, reduced, box, job.config.target, job.config.carve)
            learnt = dict(zip(missing, found, strict=True))
        for n, plate in enumerate(job.plates):
            own = learnt[n] if plate is None else Background.from_plate(plate)
            road = job.roads[n]
            region = own.region if road is None else own.region & (_resized(road, own.region.shape) > 0)
            arrays |= {f"plate{n}": own.plate, f"known{n}": own.known, f"region{n}": region}
    meta = {"report": report.values, "warnings": report.warnings}
    return arrays, meta


def _resized(mask: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    return mask if mask.shape == shape else cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)


@lru_cache(maxsize=2)
def _learnt(folder: Path, key: str) -> Entry:
    entry = Store(folder).load(key)
    if entry is None:
        raise FileNotFoundError(f"{folder}: result {key} has vanished")
    return entry


@once
def prepare(job: Job, learn_key: str, instant: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """One instant's images and masks, cropped to the target, and where to search for it."""
    learnt = _learnt(job.folder, learn_key)
    config, cameras, report = job.config, job.cameras, Report()
    images = [job.clips.undistorted(n, instant) for n in range(len(cameras))]
    around = learnt.arrays["box"]
    masks = None
    if job.masks is not None:
        pictures = [job.masks.frame(n, instant).max(2) for n in range(len(cameras))]
        masks = [
            undistort(np.where(p > 127, 255, 0).astype(np.uint8), c, nearest=True) for p, c in zip(pictures, job.clips.calib, strict=True)
        ]
    elif not job.whole:
        arrays = learnt.arrays
        backgrounds = [Background(arrays[f"plate{n}"], arrays[f"known{n}"], arrays[f"region{n}"]) for n in range(len(cameras))]
        masks = foreground(images, cameras, backgrounds, around, config.target, config.carve)
    targets: list[dict[str, Any]] = []
    extra: dict[str, NDArray[Any]] = {}
    box = around
    if masks is not None:
        hull = target_hull(masks, cameras, around, config.carve)
        targets, hulls = find_targets(hull, masks, cameras, config.video.least_target)
        if not targets:
            return {"box": box}, {
                "empty": True,
                "targets": [],
                "sources": [],
                "report": {},
                "warnings": ["no target is seen at this instant"],
            }
        box = np.stack([np.min([t["box"][0] for t in targets], 0), np.max([t["box"][1] for t in targets], 0)])
        if job.bounds is not None:
            box = np.stack([np.maximum(box[0], job.bounds[0]), np.minimum(box[1], job.bounds[1])])
        views, extra = _cropped(images, masks, cameras, hull, config), hulls.arrays()
    else:
        reduced = [reduce(i, c, config.depth.max_image_size) for i, c in zip(images, cameras, strict=True)]
        views = Views([r[0] for r in reduced], None, [r[1] for r in reduced])
    bounded = masks is not None or job.bounds is not None
    points = find_points(views.images, views.cameras, None, config.sparse, report) if masks is None else no_points(len(cameras))
    if masks is None and job.bounds is None:
        box = view_selection.target_box(views.cameras, points)
    plan = instant_plan(views, points, box, bounded, config, report)
    return _view_arrays(views, plan) | extra, {
        "empty": False,
        "targets": targets,
        "sources": plan.sources,
        "report": report.values,
        "warnings": report.warnings,
    }


def no_points(count: int) -> SparsePoints:
    """Where masks bound the search no points are needed."""
    return replace(NO_POINTS, visible=np.zeros((count, 0), bool))


def _cropped(
    images: Sequence[Image], masks: Sequence[NDArray[np.uint8]], cameras: Sequence[Camera], hull: Occupancy, config: Config
) -> Views:
    """Each view cut to its mask and the hull's shadow in it, with a margin."""
    pictures, cuts, kept, windows = [], [], [], []
    for image, mask, camera in zip(images, masks, cameras, strict=True):
        y, x = np.nonzero((mask > 0) | (shadow(hull, camera) > 0))
        low, high = (np.array([x.min(), y.min()]), np.array([x.max(), y.max()]) + 1) if len(x) else (np.zeros(2, int), np.array([32, 32]))
        pad = 16 + (config.video.margin * (high - low)).astype(int)
        low, high = np.maximum(low - pad, 0), np.minimum(high + pad, (camera.width, camera.height))
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        part = camera.cropped(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
        limit = config.depth.max_image_size
        picture, reduced = reduce(np.ascontiguousarray(image[window]), part, limit)
        pictures.append(picture)
        cuts.append(reduce(np.ascontiguousarray(mask[window]), part, limit, nearest=True)[0])
        kept.append(reduced)
        scale = reduced.width / part.width
        x, y = -low * scale
        windows.append((float(x), float(y), float(x + (camera.width - 1) * scale), float(y + (camera.height - 1) * scale)))
    return Views(pictures, cuts, kept, windows)


def instant_plan(views: Views, points: SparsePoints, box: Bounds, bounded: bool, config: Config, report: Report) -> Plan:
    """Where to search, and with which source views; with none where the cameras stand too far apart for stereo."""
    cameras = views.cameras
    ranges = view_selection.depth_ranges(cameras, points, box, config.sparse.range_stretch, bounded)
    sources = view_selection.choose_sources(view_selection.view_scores(cameras, points, box, config.depth), config.depth.sources)
    nearest = _nearest_angles(cameras, box.mean(0))
    report.values["nearest_view_degrees"] = [round(a, 1) for a in nearest]
    if views.masks is not None and np.median(nearest) > config.video.stereo_angle:
        report.values["surface"] = "visual hull"
        report.warn(
            f"the cameras stand {np.median(nearest):.0f} degrees apart as seen from the target, too far for stereo: "
            "the surface is the visual hull of the silhouettes"
        )
        sources = [[] for _ in cameras]
    elif not any(sources):
        raise ReconstructionError("no two views see the same surface from less than 65 degrees apart, and there are no masks to carve with")
    else:
        report.values["surface"] = "depth maps" if views.masks is None else "depth maps in the visual hull"
    return Plan(points, box, ranges, sources)


def _nearest_angles(cameras: Sequence[Camera], middle: NDArray[np.float64]) -> list[float]:
    """Degrees at the target between each view and its nearest neighbour."""
    to = np.array([middle - c.center for c in cameras])
    to /= np.linalg.norm(to, axis=1, keepdims=True).clip(1e-300)
    angles = np.degrees(np.arccos(np.clip(to @ to.T, -1, 1)))
    np.fill_diagonal(angles, np.inf)
    return [float(a) for a in angles.min(1)]


def _view_arrays(views: Views, plan: Plan) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {"box": plan.box, "ranges": np.array(plan.ranges, np.float64)}
    arrays |= {f"image{n}": i for n, i in enumerate(views.images)}
    arrays |= {f"mask{n}": m for n, m in enumerate(views.masks or [])}
    arrays["K"], arrays["R"], arrays["t"] = (np.stack([getattr(c, k) for c in views.cameras]) for k in "KRt")
    if views.windows is not None:
        arrays["windows"] = np.array(views.windows, np.float64)
    arrays |= {"points": plan.points.positions, "visible": plan.points.visible, "errors": plan.points.errors}
    return arrays


def prepared(job: Job, key: str) -> tuple[Views, Plan, Entry]:
    """What `prepare` found."""
    entry = stored(job, key)
    a = entry.arrays
    count = len(a["K"])
    images = [a[f"image{n}"] for n in range(count)]
    masks = [a[f"mask{n}"] for n in range(count)] if "mask0" in a else None
    names = [c.name for c in job.clips.clips]
    cameras = [Camera(a["K"][n], a["R"][n], a["t"][n], images[n].shape[1], images[n].shape[0], name=names[n]) for n in range(count)]
    ranges = [(float(low), float(high)) for low, high in a["ranges"]]
    plan = Plan(SparsePoints(a["points"], a["visible"], a["errors"]), a["box"], ranges, entry.meta["sources"])
    windows = [tuple(w) for w in a["windows"].tolist()] if "windows" in a else None
    return Views(images, masks, cameras, windows), plan, entry


@once
def expect(job: Job, prepare_key: str, mesh_key: str, before_key: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """What the surface of the instant before leads to expect: the targets' motion since, and the depth of each view."""
    views, plan, entry = prepared(job, prepare_key)
    mesh, before = stored(job, mesh_key), stored(job, before_key)
    poses = np.zeros((0, 4, 4))
    vertices = mesh.arrays["vertices"]
    if before.meta["targets"] and entry.meta["targets"]:
        hulls = Hulls.from_arrays(before.arrays)
        poses = motions(before.meta["targets"], entry.meta["targets"], hulls, Hulls.from_arrays(entry.arrays))
        vertices = moved(vertices, poses, hulls)
    arrays: dict[str, NDArray[Any]] = {"poses": poses}
    for n, camera in enumerate(views.cameras):
        if not plan.sources[n]:
            continue
        seed, _ = _core.rasterize(np.ascontiguousarray(vertices), mesh.arrays["faces"], camera.projection, camera.width, camera.height)
        arrays[f"seed{n}"] = seed
    centers = np.ascontiguousarray(vertices[mesh.arrays["faces"]].mean(1))
    return arrays | {"centers": centers, "face_views": mesh.arrays["face_views"]}, {}


@once
def first(job: Job, prepare_key: str, n: int, expect_key: str | None) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s first pass, started from what is expected there if anything is."""
    views, plan, _ = prepared(job, prepare_key)
    if expect_key is None or job.config.matcher == "dcnn":
        return first_pass(views, plan, n, job.config).arrays(), {}  # type: ignore[return-value]
    seed = stored(job, expect_key).arrays[f"seed{n}"]
    if views.masks is not None:
        seed = np.where(views.masks[n] > 0, seed, 0).astype(np.float32)
    others = [views.view(j) for j in plan.sources[n]]
    rough = seeded_depth(views.view(n), others, *plan.ranges[n], seed, job.config.depth)
    return rough.arrays(), {}  # type: ignore[return-value]


@once
def second(job: Job, prepare_key: str, n: int, first_keys: dict[int, str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s depth map."""
    views, plan, _ = prepared(job, prepare_key)
    return second_depth(job, views, plan, n, first_keys)


def second_depth(job: Job, views: Views, plan: Plan, n: int, first_keys: dict[int, str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A view's second pass from the stored first ones, to be stored."""
    wanted = {n, *plan.sources[n]}
    rough = {k: RoughDepth.from_arrays(stored(job, key).arrays) for k, key in first_keys.items() if k in wanted}
    found = second_pass(views, plan, n, rough, job.config)
    return {"depth": found.depth, "confidence": found.confidence}, {}


def depth_maps(job: Job, keys: dict[int, str], count: int) -> list[DepthMap | None]:
    """The depth maps that `second` stored, by view."""
    maps: list[DepthMap | None] = [None] * count
    for n, key in keys.items():
        entry = stored(job, key)
        maps[n] = DepthMap(entry.arrays["depth"], entry.arrays["confidence"])
    return maps


@once
def fuse(job: Job, prepare_key: str, depth_keys: dict[int, str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The instant's field, each part an entry of its own, and the depth that other views agree with."""
    views, plan, _ = prepared(job, prepare_key)
    report = Report()
    filtered, parts = fused(views, plan, depth_maps(job, depth_keys, len(views.images)), job.config, report)
    keys: list[str] = []
    for part in parts:
        keys.append(digest("volume", prepare_key, depth_keys, len(keys)))
        grid = np.array([part.voxel, *part.shape], np.float64)
        job.store.save(keys[-1], {"coords": part.coords, "values": part.values, "origin": part.origin, "grid": grid}, {})
    arrays: dict[str, NDArray[Any]] = {f"depth{n}": v.depth for n, v in enumerate(filtered) if v is not None}
    arrays |= {f"confidence{n}": v.confidence for n, v in enumerate(filtered) if v is not None}
    return arrays, {"report": report.values, "warnings": report.warnings, "volumes": keys}


def fused(
    views: Views, plan: Plan, maps: list[DepthMap | None], config: Config, report: Report
) -> tuple[list[DepthMap | None], Iterator[Volume]]:
    """The depth that other views agree with, and the field in parts."""
    loose = filter_views(views, plan, maps, config.depth.loosened())
    return filter_views(views, plan, maps, config.depth), fuse_views(views, plan, loose, config, report)


def _volume(job: Job, key: str) -> Volume:
    arrays = stored(job, key).arrays
    voxel, *shape = arrays["grid"].tolist()
    return Volume(arrays["origin"], voxel, (int(shape[0]), int(shape[1]), int(shape[2])), arrays["coords"], arrays["values"])


def filtered_of(arrays: Mapping[str, NDArray[Any]], count: int) -> list[DepthMap | None]:
    """The depth maps that `fuse` stored."""
    return [DepthMap(arrays[f"depth{n}"], arrays[f"confidence{n}"]) if f"depth{n}" in arrays else None for n in range(count)]


@once
def mesh(
    job: Job, prepare_key: str, fuse_key: str, expect_key: str | None, gains_key: str | None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The instant's textured mesh; views and colours as the instant before had them where they can."""
    views, plan, entry = prepared(job, prepare_key)
    field = stored(job, fuse_key)
    report = Report(entry.meta["report"] | field.meta["report"], [*entry.meta["warnings"], *field.meta["warnings"]])
    given = Given()
    if gains_key is not None:
        given = replace(given, gains=stored(job, gains_key).arrays["gains"].astype(np.float32))
    if expect_key is not None:
        before = stored(job, expect_key).arrays
        given = replace(given, centers=before["centers"], views=before["face_views"])
    found = isosurface(_volume(job, key) for key in field.meta["volumes"])
    if entry.meta["targets"] and len(found.faces):
        found = on_targets(found, Hulls.from_arrays(entry.arrays))
    result = finish(views, plan, filtered_of(field.arrays, len(views.images)), found, job.config, report, given=given)
    return result_arrays(result), {"report": result.report}


def result_arrays(result: Reconstruction) -> dict[str, NDArray[Any]]:
    """What is stored of a textured mesh."""
    arrays: dict[str, NDArray[Any]] = {k: getattr(result, k) for k in ("vertices", "faces", "uv", "texture", "face_views")}
    return arrays | {"gains": np.array(result.report["texture"]["gains"], np.float64)}
