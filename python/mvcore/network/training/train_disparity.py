"""Training of the disparity network: resumable, logged, validated; the best checkpoint is kept."""

from __future__ import annotations

import copy
import ctypes
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from ...errors import require
from ...io.files import atomically
from ..folding import folded, unfolded
from ..matcher import RECTIFIED, padded, planes_for
from ..model import DisparityNet, Prediction
from ..weights import load_into, notes_of, save_weights
from .batches import Batch, Recipe, make_batch
from .datasets import Item, find_items
from .logs import cut_log, log_row
from .losses import loss


@dataclass(frozen=True)
class Training:
    """A training run.

    steps : batches in all. rate : AdamW's, after ``warmup`` steps, falling linearly to zero over the last ``decay`` share.
    every : steps between validations and checkpoints. workers : processes that render.
    bfloat16 : the first stage's hourglasses in that precision; by default on CUDA.
    freeze_norms : batch normalisation keeps the statistics of ``start``, for batches too small to have their own.
    hours : the training ends after this long if not by its steps, and the rate falls to zero by then; such a run is not repeatable.
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
    recipe: Recipe = field(default_factory=Recipe)
    middlebury: str | None = None
    """Folder of Middlebury scenes to validate on as well."""
    start: str | None = None
    """Weights to begin from, a safetensors file of the same build; by default from nothing."""


class _Batches(Dataset[Batch]):
    def __init__(self, recipe: Recipe, steps: int) -> None:
        self.recipe, self.steps = recipe, steps

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, number: int) -> Batch:
        return make_batch(self.recipe, number)


def _stream(recipe: Recipe, first: int, steps: int, workers: int) -> Iterator[Batch]:
    numbers = range(first, steps)
    if workers == 0:
        return (make_batch(recipe, n) for n in numbers)
    spawned = {"multiprocessing_context": "spawn", "prefetch_factor": 4}
    loader: DataLoader[Batch] = DataLoader(_Batches(recipe, steps), batch_size=None, sampler=list(numbers), num_workers=workers, **spawned)  # type: ignore[arg-type]
    if workers == 1:
        return iter(loader)
    # Many processes with as many threads each would get in each other's way; they take this from us when they start.
    before = os.environ.get(THREADS)
    os.environ[THREADS] = "1"
    try:
        return iter(loader)
    finally:
        os.environ.pop(THREADS)
        if before is not None:
            os.environ[THREADS] = before


THREADS = "RAYON_NUM_THREADS"


def _to(batch: Batch, device: torch.device) -> Batch:
    def moved(value: Any) -> Any:
        return value.to(device, non_blocking=True) if isinstance(value, Tensor) else value

    lists = {k: [moved(v) for v in getattr(batch, k)] for k in ("images", "maps")}
    return replace(batch, **lists, **{k: moved(getattr(batch, k)) for k in ("inverse", "seen", "low", "high")})


class _Average:
    """Exponential average of the weights: what a falling rate would settle to."""

    def __init__(self, net: nn.Module, keep: float) -> None:
        self.net, self.keep = copy.deepcopy(net).eval(), keep

    @torch.no_grad()
    def update(self, net: nn.Module, step: int) -> None:
        keep = min(self.keep, (1 + step) / (10 + step))
        both = [(m, t) for m, t in zip(self.net.state_dict().values(), net.state_dict().values(), strict=True)]
        mine, theirs = (list(x) for x in zip(*(p for p in both if p[0].dtype.is_floating_point), strict=True))
        torch._foreach_lerp_(mine, theirs, 1 - keep)
        for m, t in both:
            if not m.dtype.is_floating_point:
                m.copy_(t)


def _rate(training: Training, step: int, seconds: float) -> float:
    done = step / training.steps
    if training.hours is not None:
        done = min(1.0, max(done, seconds / (3600 * training.hours)))
    return training.rate * min(1.0, (step + 1) / training.warmup, (1 - done) / max(training.decay, 1e-6))


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


def train_disparity(training: Training, out: Path, device: str = "cpu", report: Any = print, stop_after: int | None = None) -> Path:
    """Trains, or goes on where a run into the same folder stopped; returns the path of the best weights.

    ``out`` receives ``last.pt`` (to resume), ``log.csv`` and ``best.safetensors`` by the held-out families' bad-1 share.
    ``stop_after`` ends this call once so many steps are done; the schedule stays that of the whole training.
    """
    out.mkdir(parents=True, exist_ok=True)
    where = torch.device(device)
    torch.manual_seed(training.recipe.seed)
    net = DisparityNet(training.preset, training.hourglasses, training.groups, training.windowed).to(where).train()
    if training.start:
        load_into(net, notes_of(Path(training.start))[1], Path(training.start))
    if training.freeze_norms:
        require(training.start is not None, "start", "weights whose statistics are kept", None)
        # What has no statistics of the batch to learn from need not keep them apart.
        net = _frozen(folded(net))
    net.bfloat16 = where.type == "cuda" if training.bfloat16 is None else training.bfloat16
    average = _Average(net, training.averaging)
    optimiser = torch.optim.AdamW(net.parameters(), training.rate, weight_decay=1e-4, fused=where.type == "cuda")
    pairs = find_items(f"middlebury:{training.middlebury}") if training.middlebury else []
    step, best, before, last = 0, float("inf"), 0.0, out / "last.pt"
    if last.exists():
        state = torch.load(last, map_location=where, weights_only=True)
        begun = state.get("freeze_norms", False)
        require(begun == training.freeze_norms, "freeze_norms", f"{begun}, as the run in {out} began", training.freeze_norms)
        net.load_state_dict(state["net"])
        average.net.load_state_dict(state["average"])
        optimiser.load_state_dict(state["optimiser"])
        step, best, before = state["step"], state["best"], state["seconds"]
        cut_log(out / "log.csv", step)
    started, seen, total, skipped = time.perf_counter(), 0, 0.0, 0
    for batch in _stream(training.recipe, step, training.steps, training.workers):
        spent = before + time.perf_counter() - started
        for group in optimiser.param_groups:
            group["lr"] = _rate(training, step, spent)
        value = _step(net, optimiser, _to(batch, where))
        if value is None:
            skipped += 1
        else:
            total, seen = total + value, seen + 1
        step += 1
        average.update(net, step)
        timed_out = training.hours is not None and spent > training.hours * 3600
        if step % training.every == 0 or step == training.steps or timed_out:
            figures = validate(average.net, training.recipe.seed, where)
            figures |= validate_pairs(average.net, pairs, where) if pairs else {}
            row = {"step": step, "loss": total / max(seen, 1), "skipped": skipped, "seconds": spent, **figures}
            log_row(out / "log.csv", row)
            report(" ".join(f"{k} {v:.4g}" for k, v in row.items()))
            total, seen, skipped = 0.0, 0, 0
            if figures["pair_bad1"] + figures["views_bad1"] < best:
                best = figures["pair_bad1"] + figures["views_bad1"]
                found = unfolded(average.net) if training.freeze_norms else average.net
                save_weights(found, out / "best.safetensors", {"step": str(step)})
            state = {"net": net.state_dict(), "average": average.net.state_dict(), "optimiser": optimiser.state_dict()}
            state |= {"freeze_norms": training.freeze_norms, "step": step, "best": best, "seconds": spent}
            atomically(last, lambda p, state=state: torch.save(state, p))
        if timed_out or step == stop_after:
            break
    return out / "best.safetensors"


def _frozen(net: DisparityNet) -> DisparityNet:
    """A network in training whose batch normalisations stay as they are."""
    net.train()
    for module in net.modules():
        if isinstance(module, nn.BatchNorm3d):
            module.eval()
    return net


def _step(net: DisparityNet, optimiser: torch.optim.Optimizer, batch: Batch) -> float | None:
    """One batch; the loss, or nothing where a gradient was not finite and the weights were left alone."""
    optimiser.zero_grad(set_to_none=True)
    output = net(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, batch.planes)
    value = loss(output, batch.inverse, batch.low, batch.high)
    value.backward()
    norm = nn.utils.clip_grad_norm_(net.parameters(), 2.0)
    if not torch.isfinite(norm):
        return None
    optimiser.step()
    return float(value.detach())


@torch.no_grad()
def validate_pairs(net: DisparityNet, items: Sequence[Item], device: torch.device) -> dict[str, float]:
    """Rectified pairs with known truth, whole images: shares of known pixels off by over 2 px, mean error in px; no hole is left."""
    shares, errors = [], []
    for item in items:
        sample = item()
        h, w = sample.inverse.shape
        images = [padded(i).to(device) for i in sample.images]
        top = float(np.ceil(sample.inverse.max() / 16) * 16)
        ends = [torch.tensor([x], dtype=torch.float32, device=device) for x in (0.0, top)]
        found: Prediction = net(images[0], images[1:], [torch.from_numpy(RECTIFIED)[None].to(device)], *ends, planes_for(top))
        known = sample.inverse > 0
        error = np.abs(found.inverse[0, :h, :w].cpu().numpy() - sample.inverse)[known]
        shares.append(float((error > 2).mean()))
        errors.append(float(error.mean()))
    return {"middlebury_bad2": float(np.mean(shares)), "middlebury_epe": float(np.mean(errors))}


@lru_cache(maxsize=4)
def _held_out(seed: int, pairs: float, count: int) -> list[Batch]:
    """Batches of held-out families, of the same size whatever is trained on."""
    recipe = Recipe(seed=seed + 1_000_000, held_out=True, pairs=pairs)
    return [replace(make_batch(recipe, n), planes=32) for n in range(count)]


@torch.no_grad()
def validate(net: DisparityNet, seed: int, device: torch.device, batches: int = 12) -> dict[str, float]:
    """On held-out shapes and textures: mean error and shares of pixels worse than one plane (of 32), pairs and posed views apart."""
    figures: dict[str, float] = {}
    for name, pairs in (("pair", 1.0), ("views", 0.0)):
        errors, pixels = [], []
        for batch in _held_out(seed, pairs, batches):
            batch = _to(batch, device)
            found: Prediction = net(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, batch.planes)
            known = (batch.inverse > 0) & (batch.inverse >= batch.low[:, None, None]) & (batch.inverse <= batch.high[:, None, None])
            if name == "views":
                known &= batch.seen.any(1)
            error = (found.inverse - batch.inverse).abs()
            errors.append((error / ((batch.high - batch.low) / 31)[:, None, None])[known])
            pixels.append(error[known])
        planes = torch.cat(errors)
        figures[f"{name}_bad1"] = float((planes > 1).float().mean())
        figures[f"{name}_bad025"] = float((planes > 0.25).float().mean())
        if name == "pair":
            figures["pair_epe"] = float(torch.cat(pixels).mean())
    return figures
