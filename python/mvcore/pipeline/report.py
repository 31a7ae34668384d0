"""The report of a run, put together from what its stages returned."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ..config import Config
from .stages import Findings
from .tasks import Ledger

GROUPS = {
    "io": ("decode", "crop"),
    "sparse": ("features", "survey", "plan"),
    "silhouettes": ("backgrounds", "silhouettes", "locate"),
    "depth": ("match", "refine", "rematch", "predict"),
    "consistency": ("filtered", "kept_share"),
    "volume": ("draft", "extract"),
    "surface": ("clean",),
    "texture": ("paint",),
    "rigid": ("registered",),
}
"""Names in the report, and the stages whose seconds they sum."""


def assembled(findings: Sequence[Findings], ledger: Ledger, config: Config, views: int) -> dict[str, Any]:
    """Figures and warnings of all stages, and what the run took."""
    report: dict[str, Any] = {"views": views, "matcher": config.matcher, "config": asdict(config)}
    warnings: list[str] = []
    for one in findings:
        report |= one.figures
        warnings += [w for w in one.warnings if w not in warnings]
    return report | {
        "warnings": warnings,
        "seconds": _seconds(ledger),
        "tasks": {"run": ledger.run, "reused": ledger.reused},
        "peak_memory_mib": round(peak_memory() / 2**20),
    }


def _seconds(ledger: Ledger) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    for name, members in GROUPS.items():
        spent = [ledger.seconds[m] for m in members if m in ledger.seconds]
        if spent:
            out[name] = {kind: round(sum(s[kind] for s in spent), 3) for kind in ("wall", "cpu")}
    return out


def peak_memory() -> int:
    """Bytes of the largest resident set of this process so far; 0 where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
