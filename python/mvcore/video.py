"""Multi-view video: a textured mesh an instant, or one model of a rigid target from all of them.

The work is cut into pure functions of stored inputs: `_learn`, `_prepare`, `_first`, `_second`, `_fuse`, `_mesh`, and for a rigid
target `_poses` and the `_model` family. Each writes one entry of the `Store` under a key made of its inputs and settings, so that any
executor may run it, twice if need be, and a run that was killed finds what it had finished.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core, sparse
from .cameras import Calibration, Camera
from .carve import Occupancy, shadow, target_hull
from .config import Config
from .depth import RoughDepth, seeded_depth
from .errors import MvcoreError, ReconstructionError, require
from .io.clips import Clips, Source, load_video
from .io.images import find_pictures, read_image, reduce, undistort
from .motion import cloud_of, cloud_of_mesh, find_poses
from .pipeline import Plan, Views, check_bounds, filter_views, finish, first_pass, fuse_views, second_pass
from .result import Reconstruction
from .schedule import Pool, open_pool
from .sequence import SequenceWriter
from .store import Entry, Store, digest, file_digest
from .surface import marching_cubes
from .target import Background, foreground, learn_backgrounds
from .texture import Given
from .types import Bounds, DepthMap, Image, Report, SparsePoints, Track, no_track
from .volume import Volume, Window

VERSION = 8
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


@dataclass
class VideoReconstruction:
    """The instants of a clip, reconstructed as they are asked for; iterate once over it, or call `save`.

    model : after the last instant of a rigid target, one `Reconstruction` of all instants in the first one's frame.
    trajectory : (T, 4, 4) float64, which bring the model into the world at each instant, NaN where the target is not seen.
    times : (T,) seconds; names : of the cameras.
    seconds : wall seconds of each instant; warnings : what the clips, the calibration and the run had to say.
    """

    times: NDArray[np.float64]
    names: list[str]
    warnings: list[str]
    _instants: Iterator[Reconstruction]
    model: Reconstruction | None = None
    trajectory: NDArray[np.float64] | None = None
    seconds: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Reconstruction]:
        return self._instants

    def save(self, folder: str | Path) -> None:
        """Write what is still to come into a folder; nothing of it stays in memory.

        A GLB an instant and target, pictures of depth maps, for a rigid target the model, still and animated, and at last ``index.json``.
        """
        writer = SequenceWriter(folder)
        for result in self:
            writer.add(result, split_targets(result), self.names)
        writer.finish(self.warnings, self.model, self.trajectory)


def reconstruct_video(
    clips: Clips,
    calib: Calibration | Sequence[Camera] | str | Path | None = None,
    *,
    masks: str | Path | Mapping[str, Source] | None = None,
    background: str | Path | Mapping[str, Any] | bool | None = None,
    regions: Mapping[str, Any] | None = None,
    bounds: ArrayLike | None = None,
    target: str = "free",
    config: Config | Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    workdir: str | Path | None = None,
    track: Track | None = None,
) -> VideoReconstruction:
    """Synchronised clips in, a textured mesh an instant out.

    Parameters
    ----------
    clips : of `mvcore.load_video`.
    calib : other cameras than the clips' own, in their order, or a path that `mvcore.load` reads.
    masks : clips of masks (bright on the target) by camera, or the folder of them; by default the target is found.
    background : clean plates by camera (path or array), or a folder of them; by default those beside the frames, else what a background
        model learns over the clip. False reconstructs the whole scene, without a target.
    regions : by camera an image, non-zero where targets may be (a road).
    bounds : ((x0, y0, z0), (x1, y1, z1)) in the world, in which targets are.
    target : ``free``, or ``rigid``: the target's poses are found and all instants fuse into one model.
    executor : where the work runs, any concurrent.futures executor; by default local threads.
    scheduler : address of a dask.distributed scheduler instead, ``tcp://host:port``; ``workdir`` must then be a folder that all share.
    workdir : keeps results by content; the same call goes on there after an interruption. By default a temporary folder.

    Returns
    -------
    VideoReconstruction
        Iterate over it for a `Reconstruction` an instant, in order. Without a target at an instant its mesh is empty and says so.

    Raises
    ------
    InvalidInputError
        Arguments that do not fit each other.
    ReconstructionError
        Nothing moves and no masks are given, or the calibration does not fit.
    """
    require(isinstance(clips, Clips), "clips", "what mvcore.load_video returns", type(clips).__name__)
    require(target in ("free", "rigid"), "target", "free or rigid", repr(target))
    require(executor is None or scheduler is None, "executor, scheduler", "one of them", "both")
    config = config if isinstance(config, Config) else Config.from_dict(config or {})
    if calib is not None:
        clips = with_calibration(clips, calib)
    clips.calib.check_baselines()
    names = [c.name for c in clips.clips]
    plates = (None,) * len(names) if background is False else _plates(clips, background)
    temporary = None if workdir is not None else tempfile.mkdtemp(prefix="mvcore-")
    job = Job(
        clips,
        None if masks is None else _mask_clips(masks, clips),
        plates,
        _regions(regions or {}, clips),
        background is False and masks is None,
        check_bounds(bounds),
        config,
        Path(workdir if workdir is not None else temporary or "").absolute(),
    )
    if target == "rigid":
        require(not job.whole, "background", "a target for target='rigid'", "False: the whole scene")
    run = VideoReconstruction(clips.times, names, list(clips.warnings), iter(()))
    run._instants = _Run(job, run, target == "rigid", executor, scheduler, track or no_track, temporary).instants()
    return run


def with_calibration(clips: Clips, calib: Calibration | Sequence[Camera] | str | Path) -> Clips:
    """The same clips with other cameras."""
    from .io import load

    cameras = load(calib, images=False).calib if isinstance(calib, str | Path) else list(calib)
    require(len(cameras) == len(clips.clips), "calib", f"{len(clips.clips)} cameras, one a clip", len(cameras))
    for clip, camera in zip(clips.clips, cameras, strict=True):
        same = (clip.width, clip.height) == (camera.width, camera.height)
        require(same, f"calib of {clip.name}", f"{clip.width} x {clip.height} pixels", f"{camera.width} x {camera.height}")
    return replace(clips, calib=Calibration(tuple(cameras)))


def _mask_clips(masks: str | Path | Mapping[str, Source], clips: Clips) -> Clips:
    if isinstance(masks, Mapping):
        masks = {name: _three_channels(source) for name, source in masks.items()}
    found = load_video(masks, clips.calib)
    frames = int(clips.numbers.max()) + 1
    short = [c.name for c in found.clips if c.frames < frames]
    require(not short, "masks", f"at least {frames} frames a camera, as the clips", f"fewer of {', '.join(short)}")
    return replace(found, numbers=clips.numbers, times=clips.times)


def _three_channels(source: Any) -> Any:
    if not isinstance(source, np.ndarray) or source.ndim != 3:
        return source
    bright = (source > (0 if source.dtype == np.bool_ or source.max(initial=0) <= 1 else 127)).astype(np.uint8) * np.uint8(255)
    return np.broadcast_to(bright[..., None], (*bright.shape, 3))


def _picture(value: Any, camera: Camera, label: str) -> Image:
    image = read_image(value) if isinstance(value, str | Path) else np.asarray(value)
    if image.ndim == 2:
        image = np.repeat(image.astype(np.uint8)[..., None], 3, 2)
    require(image.shape == (camera.height, camera.width, 3), label, f"{camera.width} x {camera.height} pixels", image.shape)
    return undistort(np.ascontiguousarray(image, np.uint8), camera)


def _by_camera(mapping: Mapping[str, Any], clips: Clips, label: str) -> list[Any]:
    names = [c.name for c in clips.clips]
    unknown = sorted(set(mapping) - set(names))
    require(not unknown, label, f"camera names ({', '.join(names)})", ", ".join(unknown))
    return [mapping.get(n) for n in names]


def _plates(clips: Clips, background: Any) -> tuple[Image | None, ...]:
    if isinstance(background, str | Path):
        background = find_pictures(background, [c.name for c in clips.clips])
    given = [c.plate for c in clips.clips] if not isinstance(background, Mapping) else _by_camera(background, clips, "background")
    pictures = zip(given, clips.clips, clips.calib, strict=True)
    return tuple(None if g is None else _picture(g, camera, f"background of {clip.name}") for g, clip, camera in pictures)


def _regions(regions: Mapping[str, Any], clips: Clips) -> tuple[NDArray[np.uint8] | None, ...]:
    given = zip(_by_camera(regions, clips, "regions"), clips.clips, clips.calib, strict=True)
    return tuple(None if r is None else _picture(r, camera, f"region of {clip.name}").max(2) for r, clip, camera in given)


# --- keys ---------------------------------------------------------------------------------------------------------------------------


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


def _frames_key(clips: Clips, numbers: NDArray[np.int64]) -> str:
    return digest([_content(c.source, int(n)) for c, n in zip(clips.clips, numbers, strict=True)])


def _base_key(job: Job) -> str:
    cameras = [[c.K, c.R, c.t, c.width, c.height, c.distortion, c.fisheye] for c in job.clips.calib]
    config = asdict(job.config)
    config["video"].pop("chains")  # how many at a time changes no result
    return digest("mvcore", VERSION, cameras, config, job.plates, job.roads, job.whole, job.bounds)


def _samples(job: Job) -> NDArray[np.int64]:
    """Frame numbers (samples, cameras) that a background is learnt from: of the whole clips, whatever part is reconstructed."""
    line = job.clips.timeline
    count = min(len(line), job.config.target.samples)
    return line[sorted({int(n) for n in np.linspace(0, len(line) - 1, count).round()})]


# --- pieces of work -----------------------------------------------------------------------------------------------------------------


def _once(work: Callable[..., tuple[dict[str, NDArray[Any]], dict[str, Any]]]) -> Callable[..., str]:
    """Runs a piece of work unless the store has its result; returns the key."""

    def run(job: Job, key: str, *arguments: Any) -> str:
        store = job.store
        if key not in store:
            store.save(key, *work(job, *arguments))
        return key

    run.__name__, run.__qualname__, run.__module__ = work.__name__, work.__name__, work.__module__
    run.__doc__ = work.__doc__
    return run


def _get(job: Job, key: str) -> Entry:
    entry = job.store.load(key)
    if entry is None:
        raise FileNotFoundError(f"{job.store.path(key)}: this result has vanished from the workdir")
    return entry


@_once
def _learn(job: Job) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Once a clip: the calibration's health, the volume to look at, and the backgrounds that are not given."""
    report = Report()
    cameras = job.cameras
    images = [job.clips.undistorted(n, 0) for n in range(len(cameras))]
    limit = job.config.depth.max_image_size
    small = [reduce(i, c, limit) for i, c in zip(images, cameras, strict=True)]
    points = sparse.find_points([s[0] for s in small], [s[1] for s in small], None, job.config.sparse, report)
    box = job.bounds if job.bounds is not None else sparse.target_box(cameras, points)
    arrays: dict[str, NDArray[Any]] = {"box": box}
    if job.masks is None and not job.whole:
        missing = [n for n, p in enumerate(job.plates) if p is None]
        learnt: dict[int, Background] = {}
        if missing:
            chosen = _samples(job)
            require(len(chosen) >= 3, "background", "a clean plate of every camera, or at least 3 instants to learn it from", len(chosen))
            frames = [[job.clips.undistorted_frame(n, int(t)) for t in chosen[:, n]] for n in missing]
            learnt = dict(
                zip(
                    missing, learn_backgrounds(frames, [cameras[n] for n in missing], box, job.config.target, job.config.carve), strict=True
                )
            )
        for n, plate in enumerate(job.plates):
            found = learnt[n] if plate is None else Background.from_plate(plate)
            road = job.roads[n]
            region = found.region if road is None else found.region & (_resized(road, found.region.shape) > 0)
            arrays |= {f"plate{n}": found.plate, f"known{n}": found.known, f"region{n}": region}
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


@_once
def _prepare(job: Job, learn_key: str, instant: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
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
    box = around
    if masks is not None:
        hull = target_hull(masks, cameras, around, config.carve)
        targets = _targets(hull, config.video.least_target)
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
        views = _cropped(images, masks, cameras, hull, config)
    else:
        reduced = [reduce(i, c, config.depth.max_image_size) for i, c in zip(images, cameras, strict=True)]
        views = Views([r[0] for r in reduced], None, [r[1] for r in reduced])
    bounded = masks is not None or job.bounds is not None
    points = sparse.find_points(views.images, views.cameras, None, config.sparse, report) if masks is None else _no_points(len(cameras))
    if masks is None and job.bounds is None:
        box = sparse.target_box(views.cameras, points)
    plan = _plan(views, points, box, bounded, config, report)
    return _view_arrays(views, plan), {
        "empty": False,
        "targets": targets,
        "sources": plan.sources,
        "report": report.values,
        "warnings": report.warnings,
    }


def _no_points(count: int) -> SparsePoints:
    return replace(NO_POINTS, visible=np.zeros((count, 0), bool))


def _targets(hull: Occupancy, least: float) -> list[dict[str, Any]]:
    """Connected parts of the hull, largest first: middle, box and volume of each."""
    padded = np.pad(np.where(hull.occupied, -1.0, 1.0).astype(np.float32), 1, constant_values=1.0)
    vertices, faces = marching_cubes(padded)
    if not len(faces):
        return []
    part = _core.components(faces)
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    volumes = np.bincount(part, (a * np.cross(b, c)).sum(1) / 6)
    found = []
    for number in np.argsort(-volumes, kind="stable"):
        if volumes[number] < max(least * volumes.max(), 1.0):
            break
        own = vertices[np.unique(faces[part == number])].astype(np.float64) - 1
        low, high = (hull.origin + hull.voxel * (f(own, axis=0) + s) for f, s in ((np.min, -1.0), (np.max, 1.0)))
        middle = hull.origin + hull.voxel * own.mean(0)
        found.append({"middle": middle.tolist(), "box": [low.tolist(), high.tolist()], "volume": float(volumes[number] * hull.voxel**3)})
    return found


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


def _plan(views: Views, points: SparsePoints, box: Bounds, bounded: bool, config: Config, report: Report) -> Plan:
    cameras = views.cameras
    ranges = sparse.depth_ranges(cameras, points, box, config.sparse.range_stretch, bounded)
    sources = sparse.choose_sources(sparse.view_scores(cameras, points, box, config.depth), config.depth.sources)
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


def _prepared(job: Job, key: str) -> tuple[Views, Plan, Entry]:
    entry = _get(job, key)
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


@_once
def _first(job: Job, prepare_key: str, n: int, before: tuple[str, str] | None) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s first pass; ``before`` names the mesh and the preparation of the instant that it starts from."""
    views, plan, entry = _prepared(job, prepare_key)
    if before is None or job.config.matcher == "dcnn":
        return first_pass(views, plan, n, job.config).arrays(), {}  # type: ignore[return-value]
    mesh, earlier = _get(job, before[0]), _get(job, before[1])
    camera = views.cameras[n]
    vertices = mesh.arrays["vertices"] + _step(earlier.meta["targets"], entry.meta["targets"])
    seed, _ = _core.rasterize(np.ascontiguousarray(vertices), mesh.arrays["faces"], camera.projection, camera.width, camera.height)
    others = [views.view(j) for j in plan.sources[n]]
    rough = seeded_depth(views.view(n), others, *plan.ranges[n], seed, job.config.depth, job.config.video.doubt)
    return rough.arrays(), {}  # type: ignore[return-value]


def _step(before: Sequence[dict[str, Any]], now: Sequence[dict[str, Any]]) -> NDArray[np.float64]:
    """How far the largest target has moved."""
    return np.subtract(now[0]["middle"], before[0]["middle"]) if before and now else np.zeros(3)


@_once
def _second(job: Job, prepare_key: str, n: int, first_keys: dict[int, str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s depth map."""
    views, plan, _ = _prepared(job, prepare_key)
    wanted = {n, *plan.sources[n]}
    rough = {k: RoughDepth.from_arrays(_get(job, key).arrays) for k, key in first_keys.items() if k in wanted}
    found = second_pass(views, plan, n, rough, job.config)
    return {"depth": found.depth, "confidence": found.confidence}, {}


def _depth_maps(job: Job, keys: dict[int, str], count: int) -> list[DepthMap | None]:
    maps: list[DepthMap | None] = [None] * count
    for n, key in keys.items():
        entry = _get(job, key)
        maps[n] = DepthMap(entry.arrays["depth"], entry.arrays["confidence"])
    return maps


@_once
def _fuse(job: Job, prepare_key: str, depth_keys: dict[int, str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The instant's field, and the depth that other views agree with."""
    views, plan, _ = _prepared(job, prepare_key)
    report = Report()
    return _fused(views, plan, _depth_maps(job, depth_keys, len(views.images)), job.config, report), {
        "report": report.values,
        "warnings": report.warnings,
    }


def _fused(views: Views, plan: Plan, maps: list[DepthMap | None], config: Config, report: Report) -> dict[str, NDArray[Any]]:
    filtered = filter_views(views, plan, maps, config.depth)
    volume = fuse_views(views, plan, filter_views(views, plan, maps, config.depth.loosened()), config, report)
    arrays: dict[str, NDArray[Any]] = {"coords": volume.coords, "values": volume.values, "origin": volume.origin}
    arrays |= {"grid": np.array([volume.voxel, *volume.shape], np.float64)}
    for n, view in enumerate(filtered):
        if view is not None:
            arrays |= {f"depth{n}": view.depth, f"confidence{n}": view.confidence}
    return arrays


def _volume_of(arrays: Mapping[str, NDArray[Any]]) -> Volume:
    voxel, *shape = arrays["grid"].tolist()
    return Volume(arrays["origin"], voxel, (int(shape[0]), int(shape[1]), int(shape[2])), arrays["coords"], arrays["values"])


def _filtered_of(arrays: Mapping[str, NDArray[Any]], count: int) -> list[DepthMap | None]:
    return [DepthMap(arrays[f"depth{n}"], arrays[f"confidence{n}"]) if f"depth{n}" in arrays else None for n in range(count)]


@_once
def _mesh(
    job: Job, prepare_key: str, fuse_key: str, before_key: str | None, gains_key: str | None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The instant's textured mesh; views and colours as the instant before had them where they can."""
    views, plan, entry = _prepared(job, prepare_key)
    fused = _get(job, fuse_key)
    report = Report(entry.meta["report"] | fused.meta["report"], [*entry.meta["warnings"], *fused.meta["warnings"]])
    given = Given()
    if gains_key is not None:
        given = replace(given, gains=_get(job, gains_key).arrays["gains"].astype(np.float32))
    if before_key is not None:
        mesh = _get(job, before_key)
        earlier = mesh.arrays
        centers = earlier["vertices"][earlier["faces"]].mean(1) + _step(mesh.meta["targets"], entry.meta["targets"])
        given = replace(given, centers=centers, views=earlier["face_views"])
    result = finish(views, plan, _filtered_of(fused.arrays, len(views.images)), _volume_of(fused.arrays), job.config, report, given=given)
    return _result_arrays(result), {"report": result.report, "targets": entry.meta["targets"]}


def _result_arrays(result: Reconstruction) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {k: getattr(result, k) for k in ("vertices", "faces", "uv", "texture", "face_views")}
    return arrays | {"gains": np.array(result.report["texture"]["gains"], np.float64)}


# --- the run ------------------------------------------------------------------------------------------------------------------------


@dataclass
class _Run:
    """Sends out the work and yields the instants in order."""

    job: Job
    out: VideoReconstruction
    rigid: bool
    executor: Executor | None
    scheduler: str | None
    track: Track
    temporary: str | None

    def instants(self) -> Iterator[Reconstruction]:
        """The reconstructions; the model of a rigid target after the last one."""
        try:
            with open_pool(self.executor, self.scheduler) as pool:
                yield from self._instants(pool)
        finally:
            if self.temporary is not None:
                shutil.rmtree(self.temporary, ignore_errors=True)

    def _instants(self, pool: Pool) -> Iterator[Reconstruction]:
        job, count = self.job, len(self.job.clips)
        base = _base_key(job)
        # Without masks and plates the background depends on samples of the whole clips, else on the first instant alone.
        looked = _samples(job) if job.masks is None and not job.whole and any(p is None for p in job.plates) else job.clips.numbers[:1]
        seen = digest([_frames_key(job.clips, numbers) for numbers in (job.clips.numbers[0], *looked)])
        learn_key = digest("learn", base, seen)
        pool.start(_learn, job, learn_key)()
        self.out.warnings += _get(job, learn_key).meta["warnings"]
        chain = _Chain(job, pool, learn_key, base)
        drivers = ThreadPoolExecutor(max(1, job.config.video.chains), thread_name_prefix="mvcore-chain")
        try:
            size = job.config.video.segment
            done: dict[int, Future[_Done]] = {t: Future() for t in range(count)}
            for first in range(0, count, size):
                drivers.submit(chain.run, range(first, min(first + size, count)), done)
            results: list[_Done] = []
            for t in self.track(range(count), "instants", count):
                results.append(done[t].result())
                self.out.seconds.append(results[-1].seconds)
                yield self._reconstruction(results[-1])
            if self.rigid:
                self._fuse_all(pool, results)
        finally:
            chain.stopped = True
            drivers.shutdown(cancel_futures=True)

    def _reconstruction(self, done: _Done) -> Reconstruction:
        job = self.job
        if done.mesh is None:
            return _empty(job, done)
        views, plan, prepared = _prepared(job, done.prepare)
        mesh, fused = _get(job, done.mesh), _get(job, done.fuse)
        a = mesh.arrays
        report = mesh.meta["report"] | {
            "instant": done.instant,
            "time": float(job.clips.times[done.instant]),
            "targets": prepared.meta["targets"],
        }
        return Reconstruction(
            vertices=a["vertices"],
            faces=a["faces"],
            uv=a["uv"],
            texture=a["texture"],
            depths=_filtered_of(fused.arrays, len(views.images)),
            cameras=Calibration(tuple(views.cameras)),
            sparse=plan.points,
            bounds=plan.box,
            face_views=a["face_views"],
            report=report,
        )

    def _fuse_all(self, pool: Pool, results: Sequence[_Done]) -> None:
        job, seen = self.job, [d for d in results if d.mesh is not None]
        if len(seen) < 2:
            raise ReconstructionError(f"a rigid model needs the target at two instants at least, it is seen at {len(seen)}")
        named = [(d.prepare, d.fuse, d.mesh or "") for d in seen]
        poses_key = digest("poses", named)
        pool.start(_poses, job, poses_key, named)()
        poses = _get(job, poses_key)
        self.out.trajectory = np.full((len(results), 4, 4), np.nan)
        self.out.trajectory[[d.instant for d in seen]] = poses.arrays["poses"]
        # Spread over the clip: more instants add little, and all are kept in memory.
        chosen = sorted({int(n) for n in np.linspace(0, len(seen) - 1, min(len(seen), job.config.video.model_instants)).round()})
        prepares = tuple(seen[n].prepare for n in chosen)
        used = digest("chosen", poses_key, chosen)
        if used not in job.store:
            job.store.save(used, poses.arrays | {"poses": poses.arrays["poses"][chosen]}, poses.meta)
        plan_key = digest("model plan", used, prepares)
        pool.start(_model_plan, job, plan_key, prepares, used)()
        views = [n for n, s in enumerate(_get(job, plan_key).meta["sources"]) if s]
        seconds = {n: digest("model second", plan_key, n) for n in views}
        model_key = digest("model", plan_key)
        if model_key not in job.store:
            missing = [n for n in views if seconds[n] not in job.store]
            firsts = {n: digest("model first", plan_key, n) for n in views}
            if missing:
                for wait in [pool.start(_model_first, job, firsts[n], prepares, used, n) for n in views]:
                    wait()
                for wait in [pool.start(_model_second, job, seconds[n], prepares, used, n, firsts) for n in missing]:
                    wait()
                for key in firsts.values():
                    job.store.path(key).unlink(missing_ok=True)
            pool.start(_model, job, model_key, prepares, used, seconds)()
        entry = _get(job, model_key)
        a = entry.arrays
        self.out.model = Reconstruction(
            vertices=a["vertices"],
            faces=a["faces"],
            uv=a["uv"],
            texture=a["texture"],
            depths=[],
            cameras=Calibration(()),
            sparse=NO_POINTS,
            bounds=a["box"],
            face_views=a["face_views"],
            report=entry.meta["report"],
        )


def _empty(job: Job, done: _Done) -> Reconstruction:
    entry = _get(job, done.prepare)
    return Reconstruction(
        vertices=np.zeros((0, 3)),
        faces=np.zeros((0, 3), np.uint32),
        uv=np.zeros((0, 2), np.float32),
        texture=np.zeros((1, 1, 3), np.uint8),
        depths=[None] * len(job.clips.clips),
        cameras=job.clips.calib,
        sparse=NO_POINTS,
        bounds=entry.arrays["box"],
        report={"instant": done.instant, "time": float(job.clips.times[done.instant]), "warnings": entry.meta["warnings"], "targets": []},
    )


@dataclass(frozen=True)
class _Done:
    """Keys of an instant's results; no mesh where no target is seen."""

    instant: int
    prepare: str
    depths: dict[int, str]
    fuse: str
    mesh: str | None
    seconds: float


@dataclass
class _Chain:
    """The work of consecutive instants, each of which starts from the one before."""

    job: Job
    pool: Pool
    learn_key: str
    base: str
    stopped: bool = False

    def run(self, instants: range, done: dict[int, Future[_Done]]) -> None:
        """Sets each instant's future; an error fails it and all that follow it."""
        before: _Done | None = None
        ready: tuple[str, Callable[[], Any]] | None = None
        for t in instants:
            if self.stopped:
                for later in instants:
                    done[later].cancel()  # another chain may be waiting for it
                return
            try:
                prepared = ready or self._start_preparing(t)
                ready = None
                if t + 1 in instants:
                    with suppress(OSError, MvcoreError):  # what is wrong with the next instant is told in its turn
                        ready = self._start_preparing(t + 1)
                # Colours are settled once a clip, at its first instant; without a target there, where the chain first sees one.
                gains = None if t == 0 else done[0].result().mesh
                if gains is None and before is not None:
                    gains = before.mesh
                before = self._instant(t, prepared, before, gains)
                done[t].set_result(before)
            except BaseException as error:
                for later in instants:
                    if later >= t:
                        done[later].set_exception(error)
                return

    def _start_preparing(self, t: int) -> tuple[str, Callable[[], Any]]:
        job = self.job
        masks = None if job.masks is None else _frames_key(job.masks, job.masks.numbers[t])
        key = digest("prepare", self.learn_key, _frames_key(job.clips, job.clips.numbers[t]), masks)
        return key, self.pool.start(_prepare, job, key, self.learn_key, t)

    def _instant(self, t: int, prepared: tuple[str, Callable[[], Any]], before: _Done | None, gains: str | None) -> _Done:
        job, pool = self.job, self.pool
        started = time.perf_counter()
        prepare, wait = prepared
        wait()
        meta = _get(job, prepare).meta
        if meta["empty"]:
            return _Done(t, prepare, {}, "", None, time.perf_counter() - started)
        earlier = None if before is None or before.mesh is None else (before.mesh, before.prepare)
        used = [n for n, s in enumerate(meta["sources"]) if s]
        fuse = digest("fuse", prepare, earlier)
        seconds = {n: digest("second", prepare, n, earlier) for n in used}
        if fuse not in job.store:
            firsts = {n: digest("first", prepare, n, earlier) for n in used}
            missing = [n for n in used if seconds[n] not in job.store]
            if missing:
                for finish_first in [pool.start(_first, job, firsts[n], prepare, n, earlier) for n in used]:
                    finish_first()
                for finish_second in [pool.start(_second, job, seconds[n], prepare, n, firsts) for n in missing]:
                    finish_second()
                for key in firsts.values():  # large, and of no more use
                    job.store.path(key).unlink(missing_ok=True)
            pool.start(_fuse, job, fuse, prepare, seconds)()
        mesh = digest("mesh", fuse, earlier, gains)
        pool.start(_mesh, job, mesh, prepare, fuse, None if earlier is None else earlier[0], gains)()
        return _Done(t, prepare, seconds, fuse, mesh, time.perf_counter() - started)


# --- a rigid target -----------------------------------------------------------------------------------------------------------------


@_once
def _poses(job: Job, keys: Sequence[tuple[str, str, str]]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Where a rigid target is at each instant; ``keys`` name each one's preparation, field and mesh."""
    config, report, clouds = job.config.video, Report(), []
    box: Bounds | None = None
    for number, (prepare, fuse, mesh) in enumerate(keys):
        views, plan, _ = _prepared(job, prepare)
        filtered = _filtered_of(_get(job, fuse).arrays, len(views.images))
        box = plan.box if box is None else box
        if any(d is not None for d in filtered):
            clouds.append(cloud_of(filtered, views.cameras, config.registration_points, number))
        else:
            a = _get(job, mesh).arrays
            clouds.append(cloud_of_mesh(a["vertices"], a["faces"], config.registration_points, number))
    assert box is not None
    poses, shares = find_poses(clouds, float(np.linalg.norm(box[1] - box[0])), config.registration_rounds)
    for n, share in enumerate(shares):
        if share < 0.3:
            report.warn(f"only {share:.0%} of the target's surface at its instant {n} lies on the one before: its pose is doubtful")
    meta = {"report": {"instants": len(keys), "overlap": shares.round(3).tolist()}, "warnings": report.warnings}
    return {"poses": poses, "box": box}, meta


@lru_cache(maxsize=1)
def _gathered(job_folder: Path, prepare_keys: tuple[str, ...], poses_key: str, job: _Same) -> tuple[Views, Plan]:
    """All instants' views in the target's frame, as if it had stood still and the cameras had moved."""
    entry = _get(job.job, poses_key)
    box = entry.arrays["box"]
    images: list[Image] = []
    masks: list[NDArray[np.uint8]] = []
    cameras: list[Camera] = []
    windows: list[Window] = []
    for key, pose in zip(prepare_keys, entry.arrays["poses"], strict=True):
        views, _, _ = _prepared(job.job, key)
        images += views.images
        masks += views.masks or []
        cameras += [c.moved(pose) for c in views.cameras]
        windows += views.windows or []
    plan = _plan(Views(images, masks, cameras, windows), _no_points(len(cameras)), box, True, job.job.config, Report())
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


@_once
def _model_plan(job: Job, prepare_keys: Sequence[str], poses_key: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Which views of which instants show the same surface."""
    _, plan = _all_views(job, prepare_keys, poses_key)
    return {}, {"sources": plan.sources}


@_once
def _model_first(job: Job, prepare_keys: Sequence[str], poses_key: str, n: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s first pass against views of all instants."""
    views, plan = _all_views(job, prepare_keys, poses_key)
    return first_pass(views, plan, n, job.config).arrays(), {}  # type: ignore[return-value]


@_once
def _model_second(
    job: Job, prepare_keys: Sequence[str], poses_key: str, n: int, first_keys: dict[int, str]
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """View ``n``'s depth map among those of all instants."""
    views, plan = _all_views(job, prepare_keys, poses_key)
    wanted = {n, *plan.sources[n]}
    rough = {k: RoughDepth.from_arrays(_get(job, key).arrays) for k, key in first_keys.items() if k in wanted}
    found = second_pass(views, plan, n, rough, job.config)
    return {"depth": found.depth, "confidence": found.confidence}, {}


@_once
def _model(
    job: Job, prepare_keys: Sequence[str], poses_key: str, depth_keys: dict[int, str]
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """One mesh of all instants in the first one's frame."""
    views, plan = _all_views(job, prepare_keys, poses_key)
    poses = _get(job, poses_key)
    report = Report({"rigid": poses.meta["report"]}, list(poses.meta["warnings"]))
    # With so many views less noise is left to be smoothed away than at one instant.
    config = replace(job.config, volume=replace(job.config.volume, solid_smoothing=job.config.volume.smoothing))
    near = sparse.choose_sources(sparse.view_scores(views.cameras, plan.points, plan.box, config.depth), MODEL_SOURCES)
    if any(plan.sources):
        plan = replace(plan, sources=near)
    arrays = _fused(views, plan, _depth_maps(job, depth_keys, len(views.images)), config, report)
    result = finish(views, plan, [], _volume_of(arrays), config, report)
    return _result_arrays(result) | {"box": plan.box}, {"report": result.report}


MODEL_SOURCES = 12
"""Views that a depth of the model is checked against: those of other instants stand near."""


def split_targets(result: Reconstruction) -> list[Reconstruction]:
    """One reconstruction a tracked target, by the box in which a connected part of the mesh lies."""
    targets = result.report.get("targets", [])
    if len(targets) < 2 or not len(result.faces):
        return [result]
    part = _core.components(result.faces)
    middles = np.stack([np.bincount(part, result.vertices[result.faces].mean(1)[:, k]) for k in range(3)], 1) / np.bincount(part)[:, None]
    away = np.stack([np.linalg.norm(middles - np.asarray(t["middle"]), axis=1) for t in targets], 1)
    owner = away.argmin(1)[part]
    return [_subset(result, owner == n, n) for n in range(len(targets)) if (owner == n).any()]


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


__all__ = ["VideoReconstruction", "reconstruct_video", "split_targets"]
