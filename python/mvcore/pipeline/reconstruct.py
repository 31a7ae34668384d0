"""Calibrated images in, a textured mesh out: one frame of the task graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from ..config import Config
from ..errors import ReconstructionError, require
from ..geometry.cameras import Calibration, Camera
from ..geometry.local_frame import LocalFrame
from ..io import load
from ..io.images import find_masks
from ..io.scene import Scene
from ..types import Bounds, Frame, SparsePoints, Track, no_track
from .checks import as_box
from .cluster import Cluster
from .graph import FrameTasks, Inputs, Run, Views, cropped, frame_tasks, located, overview, planned, reduced_cameras, run_frame, surveyed
from .preflight import preflight
from .report import assembled
from .result import Reconstruction
from .session import Workdir, memory_settings, open_session, stored_depths
from .sources import mask_sources, photographs
from .stages import Findings, Plan, Survey, no_points


def as_calibration(calib: Calibration | Sequence[Camera] | str | Path) -> Calibration:
    """Cameras, or a path that `mvcore.load` reads, as a calibration."""
    if isinstance(calib, str | Path):
        return load(calib, images=False).calib
    return calib if isinstance(calib, Calibration) else Calibration(tuple(calib))


def reconstruct(
    frames: Sequence[Frame] | Scene,
    calib: Calibration | Sequence[Camera] | str | Path | None = None,
    *,
    masks: Sequence[Frame | None] | str | Path | None = None,
    bounds: ArrayLike | None = None,
    config: Config | Mapping[str, Any] | None = None,
    track: Track | None = None,
    workdir: str | Path | None = None,
    executor: Executor | None = None,
    scheduler: str | Cluster | None = None,
    max_memory: int | None = None,
) -> Reconstruction:
    """Calibrated images in, a textured mesh out.

    Parameters
    ----------
    frames : (h, w, 3) uint8 RGB arrays or image paths, one a camera; or a scene of `mvcore.load`, whose masks and bounds are used.
    calib : cameras in the frames' order, or a path that `mvcore.load` reads.
    masks : (h, w) uint8 or bool, or paths, or a folder; non-zero on the target. Carves the mesh to the visual hull.
    bounds : ((x0, y0, z0), (x1, y1, z1)) of the target in the world; wins over what the images suggest.
    config : settings, or a mapping of them.
    track : wraps the iterables of long stages, to show progress.
    workdir : folder that keeps results by content; the same call goes on there after an interruption. By default a temporary one.
    executor : where the work runs, any `concurrent.futures` executor; by default threads of this process.
    scheduler : address of a dask.distributed scheduler instead, ``tcp://host:port``, or a `Cluster` with TLS;
        all its workers must see ``workdir``.
    max_memory : bytes that the process may take beyond what it takes idle.

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

    Examples
    --------
    >>> scene = mvcore.load("fountain/")  # doctest: +SKIP
    >>> mvcore.reconstruct(scene).save("fountain.glb")  # doctest: +SKIP
    """
    settings = config if isinstance(config, Config) else Config.from_dict(config or {})
    request = _request(frames, calib, masks, bounds)
    remote = executor is not None or scheduler is not None
    before = _checked(request, settings, workdir=workdir, max_memory=max_memory, remote=remote)
    settings, budget, threads = memory_settings(settings, max_memory, list(request.calib))
    with open_session(workdir, executor, scheduler, budget, threads) as (place, runner):
        return _reconstructed(Run(runner, settings, track or no_track), request, place, before)


@dataclass(frozen=True)
class _Request:
    """What a caller asks for, checked: as it was handed over, and inputs and bounds in the local frame."""

    frames: Sequence[Frame]
    masks: Sequence[Frame | None] | None
    box: Bounds | None
    inputs: Inputs
    calib: Calibration
    bounds: Bounds | None
    frame: LocalFrame


def _request(frames: Any, calib: Any, masks: Any, bounds: ArrayLike | None) -> _Request:
    if isinstance(frames, Scene):
        require(calib is None, "calib", "none beside a scene, which has its own", type(calib).__name__)
        scene = frames
        masks, bounds = scene.masks if masks is None else masks, scene.bounds if bounds is None else bounds
        frames, calib = scene.frames, scene.calib
    require(calib is not None, "calib", "cameras, one a frame, or a path", "none")
    calib = as_calibration(calib)
    require(len(frames) == len(calib), "frames", f"{len(calib)}, one a camera", len(frames))
    calib.check_baselines()
    box = as_box(bounds)
    if isinstance(masks, str | Path):
        masks = find_masks(masks, frames)
    require(masks is None or len(masks) == len(frames), "masks", f"{len(frames)}, one a frame", len(masks or ()))
    frame = LocalFrame.of(calib)
    cameras = frame.cameras(list(calib))
    inputs = Inputs(photographs(frames, cameras), None if masks is None else mask_sources(masks, cameras), cameras)
    return _Request(frames, masks, box, inputs, calib, None if box is None else frame.box_inwards(box), frame)


def _checked(request: _Request, settings: Config, **arguments: Any) -> Findings:
    """What `preflight` notices before any work; masks are decoded, and looked at, where their task runs."""
    masks = None if request.masks is None else list(request.masks)
    found = preflight(request.frames, request.calib, masks, request.box, settings, decode_masks=False, **arguments)
    found.require_good()
    return Findings(warnings=found.warnings)


def _reconstructed(run: Run, request: _Request, workdir: Workdir, before: Findings) -> Reconstruction:
    config, inputs, bounds = run.config, request.inputs, request.bounds
    whole, cameras = overview(inputs, config), reduced_cameras(inputs.cameras, config.depth.max_image_size)
    run.all(whole, "images")
    surveying = surveyed(whole, cameras, bounds, config)
    run.all([surveying], "sparse points")
    survey: Survey = run.value(surveying)
    views, points, box, target = Views(whole, cameras), survey.points, survey.box, None
    findings = [before, survey.findings]
    if inputs.masks is not None:
        target, _ = located(whole, cameras, survey.box, bounds, None, config)
        where = run.value(target)
        findings.append(where.findings)
        if not where.parts:
            raise ReconstructionError(
                "no place lies inside the masks of most views that see it: check the masks' order, and that they are bright inside"
            )
        views, box = cropped(inputs, whole, where, None, config), where.box
        run.all(views.pixels, "target")
        points = no_points(len(cameras))
    planning = planned(views, points, box, bounds is not None or views.masked, config)
    plan: Plan = run.value(planning)
    tasks = frame_tasks(views, plan, config, target=target)
    run_frame(run, tasks)
    world = World(request.frame, request.calib, workdir)
    return finished(run, views, plan, tasks, [*findings, plan.findings], survey.points, world)


@dataclass(frozen=True)
class World:
    """How a result goes back to the caller: the frame, the cameras as calibrated, and where its depth maps lie."""

    frame: LocalFrame
    calib: Calibration
    workdir: Workdir


def finished(
    run: Run, views: Views, plan: Plan, tasks: FrameTasks, findings: Sequence[Findings], points: SparsePoints, world: World
) -> Reconstruction:
    """A frame's result in the caller's frame, with its report."""
    get, frame = run.runner.get, world.frame
    mesh = get(tasks.textured)
    box = frame.world_box(plan.box)
    every = [*findings, get(tasks.kept), get(tasks.extracted).findings, get(tasks.cleaned).findings, mesh.findings]
    every.append(Findings({"bounds": box.tolist()}))
    cameras = zip(views.cameras, world.calib, strict=True)
    return Reconstruction(
        vertices=frame.world(mesh.vertices),
        faces=frame.faces(mesh.faces),
        uv=mesh.uv,
        texture=mesh.texture,
        depths=stored_depths(world.workdir, run.runner, tasks.filtered),
        cameras=Calibration(tuple(replace(view, t=given.t) for view, given in cameras), world.calib.source, frame.mirrored),
        sparse=replace(points, positions=frame.world(points.positions)),
        bounds=box,
        face_views=mesh.face_views,
        report=assembled(every, run.ledger, run.config, len(views.pixels)),
    )
