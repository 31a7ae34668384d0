"""What depends on what: the tasks of a frame, declared once, for photographs, clips and rigid models alike.

decode → features → survey ─┐
   └→ (silhouettes) → locate → crop → plan → match → refine → filtered → draft → rematch → filtered → extract → clean → paint
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ..config import Config
from ..depth import RoughDepth
from ..geometry.cameras import Camera
from ..silhouettes.background_subtraction import Background
from ..types import Bounds, DepthMap, SparsePoints, Track
from ..volume.tsdf import Window
from . import stages
from .sources import Source
from .stages import (
    Cleaned,
    DepthJob,
    Draft,
    Extracted,
    FieldSettings,
    Findings,
    Pixels,
    Plan,
    PlanSettings,
    Prediction,
    Rig,
    Survey,
    Target,
    Textured,
)
from .tasks import Ledger, Runner, Task, task


@dataclass
class Run:
    """What runs a frame's tasks, and what it did."""

    runner: Runner
    config: Config
    track: Track
    ledger: Ledger = field(default_factory=Ledger)

    def all(self, tasks: Sequence[Task[Any]], description: str) -> None:
        """Run tasks, shown as one line of progress."""
        if tasks:
            self.runner.all(tasks, description, self.track, self.ledger)

    def value(self, wanted: Task[Any]) -> Any:
        """A task's result."""
        return self.runner.value(wanted, self.ledger)


@dataclass(frozen=True)
class Inputs:
    """One moment: an image a camera, masks where there are any, and the cameras as calibrated."""

    sources: list[Any]
    masks: list[Any] | None
    cameras: list[Camera]


def overview(inputs: Inputs, config: Config) -> list[Task[Pixels]]:
    """Whole views, undistorted and reduced."""
    masks: Sequence[Source | None] = inputs.masks or [None] * len(inputs.sources)
    limit = config.depth.max_image_size
    return [task(stages.decode, s, m, c, limit) for s, m, c in zip(inputs.sources, masks, inputs.cameras, strict=True)]


def reduced_cameras(cameras: Sequence[Camera], limit: int) -> list[Camera]:
    """Pinholes of views reduced to at most ``limit`` pixels a side."""
    out = []
    for c in cameras:
        longer, pinhole = max(c.width, c.height), c.pinhole()
        small = (max(2, round(c.width * limit / longer)), max(2, round(c.height * limit / longer)))
        out.append(pinhole if longer <= limit else pinhole.resized(*small))
    return out


def surveyed(views: Sequence[Task[Pixels]], cameras: list[Camera], bounds: Bounds | None, config: Config) -> Task[Survey]:
    """Sparse points of whole views, the box, and the calibration's health."""
    return task(stages.survey, [task(stages.features, v, config.sparse) for v in views], cameras, bounds, config.sparse)


@dataclass(frozen=True)
class Views:
    """Views of one frame, or of a rigid target's frames, ready for matching."""

    pixels: list[Task[Pixels]]
    cameras: list[Camera]
    windows: list[Window] | None = None
    masked: bool = False


def located(
    views: list[Task[Pixels]],
    cameras: list[Camera],
    box: Bounds,
    bounds: Bounds | None,
    learnt: Task[list[Background]] | None,
    config: Config,
) -> tuple[Task[Target], Task[list[Any]] | None]:
    """Where the targets are, and their silhouettes where they are found against a background rather than given."""
    found = None
    if learnt is not None:
        found = task(stages.silhouettes, views, learnt, cameras, box, config.background, config.carve)
    return task(stages.locate, views, found, cameras, box, bounds, config.carve, config.video.least_target, config.video.margin), found


def cropped(inputs: Inputs, views: list[Task[Pixels]], target: Target, found: Task[list[Any]] | None, config: Config) -> Views:
    """The parts of the views that show the targets."""
    limit, pixels, cameras, windows = config.depth.max_image_size, [], [], []
    for n, (camera, reduced) in enumerate(zip(inputs.cameras, reduced_cameras(inputs.cameras, limit), strict=True)):
        part = target.crops[n]
        pixels.append(task(stages.crop, views[n], found, n, inputs.sources[n], camera, part, limit))
        small, window, _ = stages.cropped_camera(camera, reduced, part, limit)
        cameras.append(small)
        windows.append(window)
    return Views(pixels, cameras, windows, masked=True)


def planned(views: Views, points: SparsePoints, box: Bounds, bounded: bool, config: Config) -> Task[Plan]:
    """Where to search for the views' depth."""
    settings = PlanSettings(config.depth, config.sparse.range_stretch, config.video.stereo_angle)
    return task(stages.plan, views.cameras, points, box, bounded, views.masked, settings)


@dataclass(frozen=True)
class FrameTasks:
    """The tasks from matching to the textured mesh; None where a view has no depth."""

    rough: dict[int, Task[RoughDepth]]
    second: dict[int, Task[DepthMap]]
    draft_loose: dict[int, Task[DepthMap]]
    draft: Task[Draft] | None
    third: dict[int, Task[DepthMap]]
    loose: dict[int, Task[DepthMap]]
    filtered: list[Task[DepthMap] | None]
    extracted: Task[Extracted]
    cleaned: Task[Cleaned]
    textured: Task[Textured]
    kept: Task[Findings]


@dataclass(frozen=True)
class Before:
    """What a clip's earlier frames give to the next: the predicted surface, and the mesh whose colours are settled."""

    prediction: Task[Prediction] | None = None
    settled: Task[Textured] | None = None


def frame_tasks(
    views: Views, plan: Plan, config: Config, before: Before | None = None, target: Task[Target] | None = None, witnesses: int | None = None
) -> FrameTasks:
    """From planned views to the textured mesh.

    Parameters
    ----------
    before : of an earlier frame. target : whose ghosts are left out. witnesses : views that a depth is checked against, by default its
        sources.
    """
    before = before or Before()
    rig = Rig(views.cameras, views.windows, views.masked, plan.box, any(plan.sources))
    used = [n for n, s in enumerate(plan.sources) if s]
    rough = {n: _matched(views, plan, n, before.prediction, config) for n in used}
    surface = config.surface
    # Parts of the field are decimated on their own by half of what the mesh may move.
    field_ = FieldSettings(
        config.volume, config.carve, config.standing, surface.min_component, surface.unseen_reach, surface.decimation / 2
    )
    third_pass = bool(config.depth.surface_rounds)
    second = {n: _refined(views, plan, n, rough, config, last=not third_pass) for n in used}
    draft, draft_loose, third = None, {}, second
    checked = plan.sources if witnesses is None else stages.witnesses(views.cameras, plan, witnesses, config.depth)
    if third_pass and used:
        draft_loose = _agreeing(views, checked, second, config, loosened=True)
        draft = task(stages.draft, _by_view(draft_loose, views), views.pixels, rig, field_)
        third = {n: _rematched(views, plan, n, second[n], rough[n], draft, config) for n in used}
    loose = _agreeing(views, checked, third, config, loosened=True)
    tight = _by_view(_agreeing(views, checked, third, config, loosened=False), views)
    extracted = task(stages.extract, _by_view(loose, views), views.pixels, rig, draft, target, field_)
    cleaned = task(stages.clean, extracted, rig, config.surface)
    textured = task(stages.paint, cleaned, extracted, views.pixels, rig, before.settled, before.prediction, config.texture)
    kept = task(stages.kept_share, tight, plan.sources, views.masked)
    return FrameTasks(rough, second, draft_loose, draft, third if draft else {}, loose, tight, extracted, cleaned, textured, kept)


def _job(views: Views, plan: Plan, n: int, sources: Sequence[int]) -> tuple[list[Task[Pixels]], DepthJob]:
    every = [n, *sources]
    return [views.pixels[k] for k in every], DepthJob([views.cameras[k] for k in every], *plan.ranges[n])


def _matched(views: Views, plan: Plan, n: int, prior: Task[Prediction] | None, config: Config) -> Task[RoughDepth]:
    return task(stages.match, *_job(views, plan, n, plan.sources[n]), prior, config.depth, config.matcher, config.device)


def _refined(views: Views, plan: Plan, n: int, rough: dict[int, Task[RoughDepth]], config: Config, last: bool) -> Task[DepthMap]:
    near = [j for j in plan.sources[n] if j in rough]
    return task(stages.refine, *_job(views, plan, n, near), [rough[k] for k in [n, *near]], config.depth, last)


def _rematched(
    views: Views, plan: Plan, n: int, depth: Task[DepthMap], rough: Task[RoughDepth], draft: Task[Draft], config: Config
) -> Task[DepthMap]:
    return task(stages.rematch, *_job(views, plan, n, plan.sources[n]), depth, rough, draft, config.depth)


def _agreeing(
    views: Views, sources: Sequence[Sequence[int]], depths: dict[int, Task[DepthMap]], config: Config, loosened: bool
) -> dict[int, Task[DepthMap]]:
    settings, out = config.depth.loosened() if loosened else config.depth, {}
    for n in depths:
        every = [n, *(j for j in sources[n] if j in depths)]
        out[n] = task(stages.filtered, [depths[k] for k in every], views.pixels[n], [views.cameras[k] for k in every], settings)
    return out


def _by_view(tasks: dict[int, Task[DepthMap]], views: Views) -> list[Any]:
    return [tasks.get(n) for n in range(len(views.pixels))]


def run_frame(run: Run, frame: FrameTasks) -> None:
    """Run a frame's tasks in order, those whose results are missing; what no later task needs is dropped as it goes."""
    wanted = [frame.textured, frame.kept, *(t for t in frame.filtered if t is not None)]
    needed = run.runner.needed(wanted)

    def step(tasks: Sequence[Task[Any]], description: str) -> None:
        run.all([t for t in tasks if t.key in needed], description)

    step(list(frame.rough.values()), "depth, first pass")
    step(list(frame.second.values()), "depth, second pass")
    if frame.draft is not None:
        step(list(frame.draft_loose.values()), "geometric filter")
        step([frame.draft], "intermediate surface")
        run.runner.drop(frame.draft_loose.values())
        step(list(frame.third.values()), "depth, third pass")
        run.runner.drop(frame.second.values())
    run.runner.drop(frame.rough.values())
    step([*frame.loose.values(), *(t for t in frame.filtered if t is not None)], "geometric filter")
    step([frame.extracted], "fusion")
    depth = frame.third if frame.draft is not None else frame.second
    run.runner.drop([*depth.values(), *frame.loose.values(), *([frame.draft] if frame.draft else [])])
    step([frame.cleaned], "surface")
    step([frame.textured, frame.kept], "texture")
    for t in wanted:
        run.value(t) if t is frame.kept else run.runner.start(t, run.ledger).result()
