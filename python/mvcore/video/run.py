"""The run over a clip: chains of instants, each starting from the one before, sent to a pool; results come in order."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import MvcoreError, ReconstructionError
from ..geometry.cameras import Calibration
from ..pipeline.executors import Pool, open_pool
from ..pipeline.result import Reconstruction
from ..pipeline.store import digest
from ..types import Track
from . import rigid
from . import stages as work
from .stages import NO_POINTS, Job, filtered_of, prepared, stored
from .tracking import Tracker


class Outcome(Protocol):
    """What a run tells of itself as it goes."""

    warnings: list[str]
    seconds: list[float]
    model: Reconstruction | None
    trajectory: NDArray[np.float64] | None


@dataclass
class Run:
    """Sends out the work and yields the instants in order."""

    job: Job
    out: Outcome
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
        started = time.perf_counter()
        # Without masks and plates the background depends on samples of the whole clips, else on the first instant alone.
        unknown = job.masks is None and not job.whole and any(p is None for p in job.plates)
        looked = work.learning_samples(job) if unknown else job.clips.numbers[:1]
        seen = digest([work.frames_key(job.clips, numbers) for numbers in (job.clips.numbers[0], *looked)])
        learn_key = digest("learn", work.base_key(job), seen)
        pool.start(work.learn, job, learn_key)()
        self.out.warnings += stored(job, learn_key).meta["warnings"]
        learnt = time.perf_counter() - started
        chain = _Chain(job, pool, learn_key)
        drivers = ThreadPoolExecutor(max(1, job.config.video.chains), thread_name_prefix="mvcore-chain")
        try:
            size = job.config.video.segment
            done: dict[int, Future[_Done]] = {t: Future() for t in range(count)}
            for first in range(0, count, size):
                drivers.submit(chain.run, range(first, min(first + size, count)), done)
            results: list[_Done] = []
            tracker = Tracker()
            for t in self.track(range(count), "instants", count):
                results.append(done[t].result())
                self.out.seconds.append(results[-1].seconds + (learnt if t == 0 else 0.0))
                yield self._reconstruction(results[-1], tracker)
            if self.rigid:
                self._fuse_all(pool, results)
        finally:
            chain.stopped = True
            drivers.shutdown(cancel_futures=True)

    def _reconstruction(self, done: _Done, tracker: Tracker) -> Reconstruction:
        job = self.job
        if done.mesh is None:
            return _empty(job, done)
        views, plan, entry = prepared(job, done.prepare)
        mesh, field = stored(job, done.mesh), stored(job, done.fuse)
        a = mesh.arrays
        report = mesh.meta["report"] | {
            "instant": done.instant,
            "time": float(job.clips.times[done.instant]),
            "targets": tracker.follow(done.instant, entry.meta["targets"]),
        }
        return Reconstruction(
            vertices=a["vertices"],
            faces=a["faces"],
            uv=a["uv"],
            texture=a["texture"],
            depths=filtered_of(field.arrays, len(views.images)),
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
        pool.start(rigid.poses, job, poses_key, named)()
        poses = stored(job, poses_key)
        self.out.trajectory = np.full((len(results), 4, 4), np.nan)
        self.out.trajectory[[d.instant for d in seen]] = poses.arrays["poses"]
        # Spread over the clip: more instants add little, and all are kept in memory.
        chosen = sorted({int(n) for n in np.linspace(0, len(seen) - 1, min(len(seen), job.config.video.model_instants)).round()})
        prepares = tuple(seen[n].prepare for n in chosen)
        used = digest("chosen", poses_key, chosen)
        if used not in job.store:
            job.store.save(used, poses.arrays | {"poses": poses.arrays["poses"][chosen]}, poses.meta)
        plan_key = digest("model plan", used, prepares)
        pool.start(rigid.model_plan, job, plan_key, prepares, used)()
        views = [n for n, s in enumerate(stored(job, plan_key).meta["sources"]) if s]
        seconds = {n: digest("model second", plan_key, n) for n in views}
        model_key = digest("model", plan_key)
        if model_key not in job.store:
            firsts = {n: digest("model first", plan_key, n) for n in views}

            def first(n: int) -> Callable[[], Any]:
                return pool.start(rigid.model_first, job, firsts[n], prepares, used, n)

            def second(n: int) -> Callable[[], Any]:
                return pool.start(rigid.model_second, job, seconds[n], prepares, used, n, firsts)

            _match(job, firsts, seconds, first, second)
            pool.start(rigid.model, job, model_key, prepares, used, seconds)()
        entry = stored(job, model_key)
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


def _match(
    job: Job,
    firsts: dict[int, str],
    seconds: dict[int, str],
    first: Callable[[int], Callable[[], Any]],
    second: Callable[[int], Callable[[], Any]],
) -> None:
    """Both passes of all views whose second is missing; the first ones' results are large, and of no use afterwards."""
    missing = [n for n, key in seconds.items() if key not in job.store]
    if not missing:
        return
    for start, views in ((first, list(firsts)), (second, missing)):
        for wait in [start(n) for n in views]:
            wait()
    for key in firsts.values():
        job.store.path(key).unlink(missing_ok=True)


def _empty(job: Job, done: _Done) -> Reconstruction:
    entry = stored(job, done.prepare)
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
        masks = None if job.masks is None else work.frames_key(job.masks, job.masks.numbers[t])
        key = digest("prepare", self.learn_key, work.frames_key(job.clips, job.clips.numbers[t]), masks)
        return key, self.pool.start(work.prepare, job, key, self.learn_key, t)

    def _instant(self, t: int, prepared: tuple[str, Callable[[], Any]], before: _Done | None, gains: str | None) -> _Done:
        job, pool = self.job, self.pool
        started = time.perf_counter()
        prepare, wait = prepared
        wait()
        meta = stored(job, prepare).meta
        if meta["empty"]:
            return _Done(t, prepare, {}, "", None, time.perf_counter() - started)
        begun = None if before is None or before.mesh is None else digest("expect", prepare, before.mesh)
        # What is removed again bears the instant's number: another chain may be at the same frames.
        expect = None if begun is None else digest(begun, t)
        used = [n for n, s in enumerate(meta["sources"]) if s]
        fuse = digest("fuse", prepare, begun)
        mesh = digest("mesh", fuse, begun, gains)
        seconds = {n: digest("second", prepare, n, begun) for n in used}
        if fuse in job.store and mesh in job.store:
            return _Done(t, prepare, seconds, fuse, mesh, time.perf_counter() - started)
        if before is not None and expect is not None and expect not in job.store:
            pool.start(work.expect, job, expect, prepare, before.mesh, before.prepare)()
        if fuse not in job.store:
            firsts = {n: digest("first", prepare, n, begun, t) for n in used}

            def first(n: int) -> Callable[[], Any]:
                return pool.start(work.first, job, firsts[n], prepare, n, expect)

            def second(n: int) -> Callable[[], Any]:
                return pool.start(work.second, job, seconds[n], prepare, n, firsts)

            _match(job, firsts, seconds, first, second)
            pool.start(work.fuse, job, fuse, prepare, seconds)()
        pool.start(work.mesh, job, mesh, prepare, fuse, expect, gains)()
        if expect is not None:
            job.store.path(expect).unlink(missing_ok=True)
        return _Done(t, prepare, seconds, fuse, mesh, time.perf_counter() - started)
