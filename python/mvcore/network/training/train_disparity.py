"""Training of the disparity network: resumable, logged, validated; the best checkpoint is kept."""

from __future__ import annotations

import copy
import ctypes
import json
import math
import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ...errors import require
from ...io.files import atomically
from ..folding import folded, renormalised, unfolded
from ..model import DisparityNet
from ..weights import load_disparity, load_into, notes_of, save_weights
from .batches import Batch, Recipe, make_batch
from .datasets import find_items
from .logs import cut_log, log_row
from .losses import HIDDEN_SHARE, split_loss
from .stream import rendered, replayed
from .validation import HeldOut, validate, validate_pairs


@dataclass(frozen=True)
class Training:
    """A training run.

    steps : batches in all. rate : AdamW's, after ``warmup`` steps, falling as a cosine to zero over the last ``decay`` share.
    every : steps between validations and checkpoints. workers : processes that render.
    bfloat16 : the first stage's hourglasses in that precision; by default on CUDA.
    freeze_norms : batch normalisation keeps the statistics of ``start``, for batches too small to have their own.
    settle : share of the training, at its end, in which batch normalisation uses the averaged statistics that inference will use.
    hours : the training ends after this long if not by its steps, and the rate falls to zero by then; such a run is not repeatable.
    replay : samples of each number of views that are kept on the device to draw the batches from, so that no step waits for rendering
    (`stream.Stock`); 0 trains once on each batch, in order. Such a run is not repeatable either.
    validation : samples in each of the two held-out sets.
    """

    steps: int = 10_000
    preset: str = "compact"
    hourglasses: int = 3
    groups: int = 8
    windowed: bool = True
    rate: float = 1e-3
    warmup: int = 300
    decay: float = 0.7
    every: int = 250
    averaging: float = 0.998
    hours: float | None = None
    workers: int = 1
    bfloat16: bool | None = None
    freeze_norms: bool = False
    settle: float = 0.25
    replay: int = 0
    validation: int = 200
    recipe: Recipe = field(default_factory=Recipe)
    middlebury: str | None = None
    """Folder of Middlebury scenes to validate on as well."""
    start: str | None = None
    """Weights to begin from, a safetensors file of the same build; by default from nothing."""


class _Average:
    """Exponential average of the weights: what a falling rate would settle to."""

    def __init__(self, net: nn.Module, keep: float) -> None:
        self.net, self.keep = copy.deepcopy(net).eval(), keep
        both = list(zip(self.net.state_dict().values(), net.state_dict().values(), strict=True))
        self.real, self.whole = ([p for p in both if p[0].dtype.is_floating_point == k] for k in (True, False))

    @torch.no_grad()
    def update(self, step: int) -> None:
        keep = min(self.keep, (1 + step) / (10 + step))
        torch._foreach_lerp_(*(list(x) for x in zip(*self.real, strict=True)), 1 - keep)
        for ours, theirs in self.whole:
            ours.copy_(theirs)


def _done(training: Training, step: int, seconds: float) -> float:
    """The share of a training that is done, by its steps or by its time, whichever ends first."""
    done = step / training.steps
    if training.hours is not None:
        done = max(done, seconds / (3600 * training.hours))
    return min(1.0, done)


def _rate(training: Training, step: int, seconds: float) -> float:
    left = min(1.0, (1 - _done(training, step, seconds)) / max(training.decay, 1e-6))
    return training.rate * min((step + 1) / training.warmup, 0.5 - 0.5 * math.cos(math.pi * left))


def keep_memory() -> None:
    """Lets this process keep freed memory: otherwise a CPU spends a fifth of a step on getting the same pages back from the system.

    Does something on Linux with glibc only. It holds for the whole process, so it is for commands, not for a library's user.
    """
    if sys.platform == "linux" and platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        for parameter, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 2**28)):
            libc.mallopt(parameter, value)


M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4
"""glibc's names for what mallopt sets."""


class _Run:
    """What a training changes: the network, its average, the optimiser's state, and how far it has come."""

    def __init__(self, training: Training, out: Path, device: torch.device) -> None:
        self.training, self.out, self.device = training, out, device
        self.started, self.steps = time.perf_counter(), 0
        torch.manual_seed(training.recipe.seed)
        last = out / "last.pt"
        self.net = _built(training, device, last.exists())
        self.average = _Average(self.net, training.averaging)
        self.optimiser = torch.optim.AdamW(self.net.parameters(), training.rate, weight_decay=1e-4, fused=True)
        self.step, self.best, self.before, self.settled = 0, float("inf"), 0.0, False
        if last.exists():
            self._resume(last)
        self.sums = torch.zeros(3, device=device)

    def _resume(self, last: Path) -> None:
        state = torch.load(last, map_location=self.device, weights_only=True)
        begun = state.get("freeze_norms", False)
        require(begun == self.training.freeze_norms, "freeze_norms", f"{begun}, as the run in {self.out} began", self.training.freeze_norms)
        self.net.load_state_dict(state["net"])
        self.average.net.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.best, self.before, self.settled = state["step"], state["best"], state["seconds"], state["settled"]
        if self.settled:
            _frozen(self.net)
        cut_log(self.out / "log.csv", self.step)

    @property
    def seconds(self) -> float:
        return self.before + time.perf_counter() - self.started

    def train_on(self, batch: Batch) -> None:
        """One batch. Where a gradient is not finite the weights are left alone. Nothing here waits for the device."""
        if not self.settled and _done(self.training, self.step, self.seconds) >= 1 - self.training.settle:
            self._settle()
        for group in self.optimiser.param_groups:
            group["lr"] = _rate(self.training, self.step, self.seconds)
        self.optimiser.zero_grad(set_to_none=True)
        output = self.net(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, batch.planes)
        parts = split_loss(output, batch.inverse, batch.low, batch.high, batch.seen)
        ((1 - HIDDEN_SHARE) * parts[0] + HIDDEN_SHARE * parts[1]).backward()
        norm = nn.utils.clip_grad_norm_(self.net.parameters(), 2.0)
        bad = (~torch.isfinite(norm)).float()
        # torch's fused optimisers make no step where this is 1.
        self.optimiser.found_inf = bad  # type: ignore[attr-defined]
        self.optimiser.step()
        self.sums += torch.cat([torch.nan_to_num(parts.detach(), posinf=0) * (1 - bad), bad[None]])
        self.step, self.steps = self.step + 1, self.steps + 1
        self.average.update(self.step)

    def _settle(self) -> None:
        """From now on batch normalisation uses the average's statistics, which validation and inference use."""
        self.settled = True
        buffers = dict(self.average.net.named_buffers())
        for name, buffer in self.net.named_buffers():
            buffer.copy_(buffers[name])
        _frozen(self.net)

    def checkpoint(self, figures: dict[str, float]) -> dict[str, float]:
        """Writes the log's line, the state, and the weights if they are the best so far; the line."""
        seen, hidden, skipped = self.sums.tolist()
        good = max(self.steps - skipped, 1)
        row = {"step": self.step, "loss_seen": seen / good, "loss_hidden": hidden / good, "skipped": int(skipped), "seconds": self.seconds}
        log_row(self.out / "log.csv", row | figures)
        self.sums.zero_()
        self.steps = 0
        if figures["pair_bad1"] + figures["views_bad1"] < self.best:
            self.best = figures["pair_bad1"] + figures["views_bad1"]
            usual = unfolded(self.average.net) if self.training.freeze_norms else self.average.net
            save_weights(usual, self.out / "best.safetensors", {"step": str(self.step)})
        state = {"net": self.net.state_dict(), "average": self.average.net.state_dict(), "optimiser": self.optimiser.state_dict()}
        state |= {"freeze_norms": self.training.freeze_norms, "settled": self.settled}
        state |= {"step": self.step, "best": self.best, "seconds": self.seconds}
        atomically(self.out / "last.pt", lambda p: torch.save(state, p))
        return row | figures


def _built(training: Training, device: torch.device, resumed: bool) -> DisparityNet:
    net = DisparityNet(training.preset, training.hourglasses, training.groups, training.windowed).to(device).train()
    if training.start and not resumed:
        load_into(net, notes_of(Path(training.start))[1], Path(training.start))
        if not training.freeze_norms:
            few = replace(training.recipe, batch=min(4, training.recipe.batch))
            batches = (make_batch(few, n).to(device) for n in range(6))
            net = renormalised(net, ((b.images[0], b.images[1:], b.maps, b.low, b.high, b.planes) for b in batches))
    if training.freeze_norms:
        require(training.start is not None, "start", "weights whose statistics are kept", None)
        # What has no statistics of the batch to learn from need not keep them apart.
        net = _frozen(folded(net))
    net.bfloat16 = device.type == "cuda" if training.bfloat16 is None else training.bfloat16
    return net


def _batches(training: Training, first: int, device: torch.device) -> Iterator[Batch]:
    numbers = range(first, training.steps)
    if training.replay and numbers:
        return replayed(training.recipe, numbers, training.workers, training.replay, device)
    return (b.to(device) for b in rendered([(training.recipe, numbers)], training.workers))


def train_disparity(training: Training, out: Path, device: str = "cpu", report: Any = print, stop_after: int | None = None) -> Path:
    """Trains, or goes on where a run into the same folder stopped; returns the path of the best weights.

    ``out`` receives ``last.pt`` (to resume), ``log.csv`` and ``best.safetensors`` by the shares of pixels off by a plane in the held-out
    set ``choice``, and at the end ``report.json``: the figures of the held-out set ``report`` for the best weights and those it began from.
    ``stop_after`` ends this call once so many steps are done; the schedule stays that of the whole training.
    """
    out.mkdir(parents=True, exist_ok=True)
    where = torch.device(device)
    run = _Run(training, out, where)
    torch.backends.cudnn.benchmark = where.type == "cuda"
    pairs = find_items(f"middlebury:{training.middlebury}") if training.middlebury else []
    batches = _batches(training, run.step, where)
    held_out = HeldOut(training.recipe.seed, training.validation, training.workers)
    for batch in batches:
        run.train_on(batch)
        timed_out = training.hours is not None and run.seconds > training.hours * 3600
        if run.step % training.every == 0 or run.step == training.steps or timed_out:
            figures = validate(run.average.net, held_out.sets["choice"], where)
            figures |= validate_pairs(run.average.net, pairs, where) if pairs else {}
            report(" ".join(f"{k} {v:.4g}" for k, v in run.checkpoint(figures).items()))
        if timed_out or run.step == stop_after:
            break
    best = out / "best.safetensors"
    if run.step != stop_after:
        names = {"best": best} | ({"start": Path(training.start)} if training.start else {})
        figures = {k: validate(load_disparity(p).to(where), held_out.sets["report"], where) for k, p in names.items()}
        atomically(out / "report.json", lambda p: p.write_text(json.dumps(figures, indent=1)))
        report(f"on the set that chose nothing: {figures}")
    return best


def _frozen(net: DisparityNet) -> DisparityNet:
    """A network in training whose batch normalisations stay as they are."""
    net.train()
    for module in net.modules():
        if isinstance(module, nn.BatchNorm3d):
            module.eval()
    return net
