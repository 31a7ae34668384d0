"""The run over a clip: chains of frames, each of which starts from the one before; results come in order."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..config import Config
from ..errors import ReconstructionError, require
from ..geometry.cameras import Calibration
from ..geometry.local_frame import LocalFrame
from ..io.clips import Clips
from ..pipeline import rigid, stages
from ..pipeline.cluster import Cluster
from ..pipeline.graph import (
    Before,
    FrameTasks,
    Inputs,
    Run,
    Views,
    cropped,
    frame_tasks,
    located,
    overview,
    planned,
    reduced_cameras,
    run_frame,
    surveyed,
)
from ..pipeline.reconstruct import World, finished
from ..pipeline.report import assembled
from ..pipeline.result import Reconstruction
from ..pipeline.session import Workdir, memory_settings, open_session
from ..pipeline.sources import ClipFrame, clip_frames
from ..pipeline.stages import Findings, Plan, Survey, Target
from ..pipeline.tasks import Runner, Task, task
from ..silhouettes.background_subtraction import Background
from ..types import LOGGER, Bounds, Image, SparsePoints, Track
from .tracking import Tracker

T = TypeVar("T")

STEPS = 10
"""Steps of progress that a frame counts as."""
MODEL_WITNESSES = 12
"""Views that a depth of a rigid model is checked against: those of other frames stand near."""


class Outcome(Protocol):
    """What a run says of itself as it goes."""

    warnings: list[str]
    seconds: list[float]
    model: Reconstruction | None
    trajectory: NDArray[np.float64] | None


@dataclass(frozen=True)
class Job:
    """A clip's inputs, in the local frame. ``plates`` and ``regions`` are None where a camera has none."""

    clips: Clips
    masks: Clips | None
    plates: list[Image | None]
    regions: list[NDArray[np.uint8] | None]
    whole: bool
    bounds: Bounds | None
    config: Config
    frame: LocalFrame

    def inputs(self, frame: int) -> Inputs:
        """Of one frame."""
        masks = None if self.masks is None else clip_frames(self.masks, frame)
        return Inputs(list(clip_frames(self.clips, frame)), masks, list(self.cameras))

    @property
    def cameras(self) -> list[Any]:
        """As calibrated, in the local frame."""
        return self.frame.cameras(list(self.clips.calib))


@dataclass(frozen=True)
class Learnt:
    """Once a clip: the survey of its first frame, and the cameras' backgrounds where targets are found against them."""

    survey: Survey
    backgrounds: Task[list[Background]] | None


@dataclass
class FrameDone:
    """A frame's tasks, done; no ``views`` where no target is seen."""

    number: int
    target: Task[Target] | None
    seconds: float
    run: Run
    views: Views | None = None
    plan: Plan | None = None
    tasks: FrameTasks | None = None
    points: SparsePoints | None = None
    findings: tuple[Findings, ...] = ()


@dataclass
class ClipRun:
    """Sends out the work and yields the frames' reconstructions in order."""

    job: Job
    out: Outcome
    rigid: bool
    executor: Executor | None
    scheduler: str | Cluster | None
    workdir: Any
    max_memory: int | None
    track: Track
    steps: queue.SimpleQueue[None] = field(default_factory=queue.SimpleQueue)
    stopped: bool = False

    def frames(self) -> Iterator[Reconstruction]:
        """The reconstructions; the model of a rigid target after the last one."""
        cameras = list(self.job.clips.calib)
        config, budget, threads = memory_settings(self.job.config, self.max_memory, cameras)
        self.job = replace(self.job, config=config)
        with open_session(self.workdir, self.executor, self.scheduler, budget, threads) as (place, runner):
            yield from self._frames(runner, place)

    def _frames(self, runner: Runner, workdir: Workdir) -> Iterator[Reconstruction]:
        count, started = len(self.job.clips), time.perf_counter()
        learnt = self._learn(Run(runner, self.job.config, self.track))
        self.out.warnings += learnt.survey.findings.warnings
        learning = time.perf_counter() - started
        world = World(self.job.frame, self.job.clips.calib, workdir)
        drivers = ThreadPoolExecutor(max(1, self.job.config.video.chains), thread_name_prefix="mvcore-chain")
        try:
            size = self.job.config.video.segment
            done: dict[int, Future[FrameDone]] = {t: Future() for t in range(count)}
            for first in range(0, count, size):
                drivers.submit(self._chain, runner, learnt, range(first, min(first + size, count)), done)
            tracker, results = Tracker(), []
            for t in self._progress(done):
                results.append(done[t].result())
                self.out.seconds.append(results[-1].seconds + (learning if t == 0 else 0.0))
                yield self._reconstruction(results[-1], tracker, learnt, world)
            if self.rigid:
                self._model(Run(runner, self.job.config, self.track), results, world)
        except BaseException:
            runner.stop()
            raise
        finally:
            self.stopped = True
            drivers.shutdown(cancel_futures=True)

    def _progress(self, done: dict[int, Future[FrameDone]]) -> Iterator[int]:
        """The numbers of the frames as they are done, in order, with progress in steps between them."""

        def events() -> Iterator[int | None]:
            shown, total = 0, STEPS * len(done)
            for t, future in done.items():
                while not future.done():
                    try:
                        self.steps.get(timeout=0.1)
                    except queue.Empty:
                        continue
                    if shown < total - (len(done) - t):  # each frame counts once more when it is done
                        shown += 1
                        yield None
                for _ in range(shown, STEPS * (t + 1) - 1):
                    shown += 1
                    yield None
                shown += 1
                yield t

        yield from (t for t in self.track(events(), "frames", STEPS * len(done)) if t is not None)

    # ---- once a clip

    def _learn(self, run: Run) -> Learnt:
        """The calibration's health, the volume to look at, and the backgrounds."""
        job, config = self.job, self.job.config
        inputs = job.inputs(0)
        whole = overview(inputs, config)
        run.all(whole, "images")
        surveying = surveyed(whole, reduced_cameras(inputs.cameras, config.depth.max_image_size), job.bounds, config)
        run.all([surveying], "sparse points")
        survey: Survey = run.value(surveying)
        if job.masks is not None or job.whole:
            return Learnt(survey, None)
        missing = [n for n, plate in enumerate(job.plates) if plate is None]
        learnt = self._learnt_plates(run, missing, survey.box) if missing else None
        backgrounds = task(stages.all_backgrounds, learnt, job.plates, job.regions)
        run.all([backgrounds], "background")
        return Learnt(survey, backgrounds)

    def _learnt_plates(self, run: Run, missing: list[int], box: Bounds) -> Task[list[Background]]:
        """From samples of the whole clips, whatever part is reconstructed."""
        job, config = self.job, self.job.config.background
        line = job.clips.timeline
        chosen = line[sorted({int(n) for n in np.linspace(0, len(line) - 1, min(len(line), config.samples)).round()})]
        require(len(chosen) >= 3, "background", "a clean plate of every camera, or at least 3 frames to learn it from", len(chosen))
        samples = []
        for n in missing:
            clip, camera = job.clips.clips[n], job.cameras[n]
            samples += [task(stages.decode, ClipFrame.of(clip, int(t)), None, camera, config.max_size) for t in chosen[:, n]]
        run.all(samples, "background samples")
        cameras = reduced_cameras([job.cameras[n] for n in missing], config.max_size)
        counts = [len(chosen)] * len(missing)
        learnt = task(stages.backgrounds, samples, counts, cameras, box, config, job.config.carve)
        run.all([learnt], "background")
        return learnt

    # ---- frames

    def _chain(self, runner: Runner, learnt: Learnt, frames: range, done: dict[int, Future[FrameDone]]) -> None:
        """Sets each frame's future; an error fails it and all that follow it."""
        before: FrameDone | None = None
        for t in frames:
            try:
                if self.stopped:
                    raise ReconstructionError("the run was stopped")
                # Colours are settled once a clip, at its first frame; without a target there, where the chain first sees one.
                settled = None if t == 0 else done[0].result().tasks
                if settled is None and before is not None:
                    settled = before.tasks
                run = Run(runner, self.job.config, self._step)
                before = self._frame(run, learnt, t, before, settled)
                done[t].set_result(before)
            except BaseException as error:
                for later in frames:
                    if later >= t:
                        done[later].set_exception(error)
                return

    def _step(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        yield from items
        self.steps.put(None)

    def _frame(self, run: Run, learnt: Learnt, t: int, before: FrameDone | None, settled: FrameTasks | None) -> FrameDone:
        job, config, started = self.job, self.job.config, time.perf_counter()
        inputs = job.inputs(t)
        whole, cameras = overview(inputs, config), reduced_cameras(inputs.cameras, config.depth.max_image_size)
        run.all(whole, "images")
        target, found = None, ()
        if job.whole:
            survey: Survey = run.value(surveyed(whole, cameras, job.bounds, config))
            views, points, box, found = Views(whole, cameras), survey.points, survey.box, (survey.findings,)
        else:
            target, silhouettes = located(whole, cameras, learnt.survey.box, job.bounds, learnt.backgrounds, config)
            where: Target = run.value(target)
            if not where.parts:
                LOGGER.warning("frame %d: no target is seen", t)
                return FrameDone(t, target, time.perf_counter() - started, run)
            views, box, points = cropped(inputs, whole, where, silhouettes, config), where.box, stages.no_points(len(cameras))
            run.all(views.pixels, "target")
            found = (learnt.survey.findings,) if t == 0 else ()
        plan: Plan = run.value(planned(views, points, box, not job.whole or job.bounds is not None, config))
        prediction = None
        if before is not None and before.tasks is not None:
            prediction = task(stages.predict, before.tasks.textured, before.target, target)
        tasks = frame_tasks(views, plan, config, Before(prediction, settled.textured if settled else None), target)
        run_frame(run, tasks)
        if t == 0 and not job.whole:
            points = learnt.survey.points
        return FrameDone(t, target, time.perf_counter() - started, run, views, plan, tasks, points, (*found, plan.findings))

    def _reconstruction(self, done: FrameDone, tracker: Tracker, learnt: Learnt, world: World) -> Reconstruction:
        where = {"instant": done.number, "time": float(self.job.clips.times[done.number])}
        if done.tasks is None or done.views is None or done.plan is None or done.points is None:
            return self._empty(done, learnt, where, world)
        result = finished(done.run, done.views, done.plan, done.tasks, done.findings, done.points, world)
        parts = done.run.value(done.target).parts if done.target is not None else []
        placed = [p | {"middle": world.frame.world(p["middle"]).tolist(), "box": world.frame.world_box(p["box"]).tolist()} for p in parts]
        result.report |= where | {"targets": tracker.follow(done.number, placed)}
        return result

    def _empty(self, done: FrameDone, learnt: Learnt, where: dict[str, Any], world: World) -> Reconstruction:
        said = Findings(where | {"targets": []}, ["no target is seen at this frame"])
        return Reconstruction(
            vertices=np.zeros((0, 3)),
            faces=np.zeros((0, 3), np.uint32),
            uv=np.zeros((0, 2), np.float32),
            texture=np.zeros((1, 1, 3), np.uint8),
            depths=[None] * len(self.job.clips.clips),
            cameras=self.job.clips.calib,
            sparse=stages.no_points(len(self.job.clips.clips)),
            bounds=world.frame.world_box(learnt.survey.box),
            report=assembled([said], done.run.ledger, self.job.config, len(self.job.clips.clips)),
        )

    # ---- a rigid target

    def _model(self, run: Run, results: Sequence[FrameDone], world: World) -> None:
        """Poses of a rigid target, and one model of all frames' views."""
        seen = [d for d in results if d.tasks is not None and d.views is not None and d.plan is not None]
        if len(seen) < 2:
            raise ReconstructionError(f"a rigid model needs the target at two instants at least, it is seen at {len(seen)}")
        config = self.job.config.video
        clouds = []
        for number, d in enumerate(seen):
            assert d.tasks is not None
            assert d.views is not None
            clouds.append(task(rigid.cloud, d.tasks.filtered, d.tasks.textured, d.views.cameras, config.registration_points, number))
        run.all(clouds, "surfaces of the frames")
        assert seen[0].plan is not None
        registering = task(rigid.registered, clouds, seen[0].plan.box, config.registration_rounds)
        run.all([registering], "poses")
        trajectory: rigid.Trajectory = run.value(registering)
        self.out.trajectory = np.full((len(results), 4, 4), np.nan)
        self.out.trajectory[[d.number for d in seen]] = world.frame.pose(trajectory.poses)
        # Spread over the clip: more frames add little.
        chosen = sorted({int(n) for n in np.linspace(0, len(seen) - 1, min(len(seen), config.model_instants)).round()})
        views = _gathered([(seen[n].views, trajectory.poses[n]) for n in chosen])
        # With so many views less noise is left to be smoothed away than at one frame.
        volume = self.job.config.volume
        settings = replace(self.job.config, volume=replace(volume, solid_smoothing=volume.smoothing))
        plan: Plan = run.value(planned(views, stages.no_points(len(views.cameras)), seen[0].plan.box, True, settings))
        tasks = frame_tasks(views, plan, settings, witnesses=MODEL_WITNESSES)
        run_frame(run, tasks)
        everywhere = replace(world, calib=Calibration(tuple(c for _ in chosen for c in world.calib)))
        findings = [trajectory.findings, plan.findings]
        self.out.model = finished(run, views, plan, tasks, findings, stages.no_points(len(views.cameras)), everywhere)


def _gathered(frames: Sequence[tuple[Views | None, NDArray[np.float64]]]) -> Views:
    """Views of several frames in the target's frame, as if it had stood still and the cameras had moved."""
    pixels, cameras, windows = [], [], []
    for views, pose in frames:
        assert views is not None
        pixels += views.pixels
        cameras += [c.moved(pose) for c in views.cameras]
        windows += views.windows or []
    return Views(pixels, cameras, windows, masked=True)
