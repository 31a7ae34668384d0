"""Times and warnings of a run."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ..errors import ReconstructionError
from ..geometry.cameras import Camera
from ..types import DepthMap, Report


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


def _say_left_out(sources: list[list[int]], cameras: Sequence[Camera], report: Report) -> None:
    alone = [n for n, s in enumerate(sources) if not s]
    report.values["left_out"] = alone
    if len(alone) == len(sources):
        raise ReconstructionError(
            "no two views see the same surface from less than 65 degrees apart: check the poses, or add views in between"
        )
    for n in alone:
        report.warn(f"view {n} ({cameras[n].name or 'unnamed'}) is left out: no other view sees its surface from a near enough angle")


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
