"""Training of the recognition head on procedural targets: SGD, resumable, logged, validated on held-out families."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ...io.files import atomically
from ..procedural.objects import TrainingObject
from ..recognition import TargetClassifier, rank_1, squared_error
from ..weights import save_weights
from .logs import cut_log, log_row

ANGLES = np.radians([-60.0, -30.0, 30.0, 60.0])
"""Azimuths of the probes; the gallery is seen from 0."""


@dataclass(frozen=True)
class RecognitionTraining:
    """A training run: ``classes`` targets, ``pictures`` of each, ``steps`` batches of ``batch`` images, SGD at ``rate``."""

    steps: int = 3000
    preset: str = "compact"
    classes: int = 300
    pictures: int = 24
    batch: int = 48
    rate: float = 0.02
    every: int = 250
    seed: int = 1
    error: str = "entropy"


def picture_stock(classes: int, pictures: int, seed: int) -> NDArray[np.uint8]:
    """(classes, pictures, SIZE, SIZE, 3): each target from random sides, up to 70 degrees from its front."""
    random = np.random.default_rng((seed, 5))
    stock = []
    for n in range(classes):
        target = TrainingObject(seed * 100_003 + n, False)
        sides = zip(random.uniform(-1.22, 1.22, pictures), random.uniform(0, 0.6, pictures), strict=True)
        stock.append([target.photograph(a, e, random) for a, e in sides])
    return np.array(stock, np.uint8)


def validate_recognition(net: TargetClassifier, targets: int = 100, seed: int = 9) -> dict[str, float]:
    """Rank-1 of held-out targets across angles: gallery from the front, probes turned by 30 and 60 degrees; and what chance gives."""
    random = np.random.default_rng((seed, 6))
    bodies = [TrainingObject(seed * 7919 + n, True) for n in range(targets)]
    gallery = net.embed([b.photograph(0.0, 0.3, random) for b in bodies])
    figures = {"chance": 1 / targets}
    for angle in ANGLES:
        probes = net.embed([b.photograph(float(angle), 0.3, random) for b in bodies])
        figures[f"rank1_{np.degrees(angle):+.0f}"] = rank_1(gallery, probes)
    return figures


def train_recognition(
    training: RecognitionTraining, out: Path, device: str = "cpu", report: Any = print, stop_after: int | None = None
) -> Path:
    """Trains, or goes on where a run into the same folder stopped; returns the path of the best weights by rank-1 across angles."""
    out.mkdir(parents=True, exist_ok=True)
    where = torch.device(device)
    torch.manual_seed(training.seed)
    net = TargetClassifier(training.classes, training.preset).to(where)
    optimiser = torch.optim.SGD(net.parameters(), training.rate, momentum=0.9, nesterov=True, weight_decay=5e-4)
    step, best, last = 0, -1.0, out / "last.pt"
    if last.exists():
        state = torch.load(last, map_location=where, weights_only=True)
        net.load_state_dict(state["net"])
        optimiser.load_state_dict(state["optimiser"])
        step, best = state["step"], state["best"]
        cut_log(out / "log.csv", step)
    stock = torch.from_numpy(picture_stock(training.classes, training.pictures, training.seed)).permute(0, 1, 4, 2, 3)
    started, total, seen = time.perf_counter(), 0.0, 0
    while step < training.steps:
        for group in optimiser.param_groups:
            falling = 0.5 * (1 + math.cos(math.pi * step / training.steps))
            group["lr"] = training.rate * min(1.0, (step + 1) / 100) * falling
        images, classes = _drawn(stock, training, step)
        torch.manual_seed(training.seed * 1_000_003 + step)
        net.train()
        optimiser.zero_grad(set_to_none=True)
        scores = net(images.to(where))
        error = squared_error if training.error == "squared" else nn.functional.cross_entropy
        value = error(scores, classes.to(where))
        value.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimiser.step()
        step, seen, total = step + 1, seen + 1, total + float(value.detach())
        if step % training.every == 0 or step == training.steps or step == stop_after:
            figures = validate_recognition(net)
            row = {"step": step, "loss": total / seen, "seconds": time.perf_counter() - started, **figures}
            log_row(out / "log.csv", row)
            report(" ".join(f"{k} {v:.4g}" for k, v in row.items()))
            total, seen = 0.0, 0
            mean = float(np.mean([v for k, v in figures.items() if k.startswith("rank1")]))
            if mean > best:
                best = mean
                save_weights(net, out / "best.safetensors", {"step": str(step)})
            state = {"net": net.state_dict(), "optimiser": optimiser.state_dict(), "step": step, "best": best}
            atomically(last, lambda p, state=state: torch.save(state, p))
        if step == stop_after:
            break
    return out / "best.safetensors"


def _drawn(stock: Tensor, training: RecognitionTraining, step: int) -> tuple[Tensor, Tensor]:
    """Batch number ``step``: a pure function of the seed and the number; images shifted by up to four pixels."""
    random = np.random.default_rng((training.seed, 8, step))
    classes = random.integers(0, training.classes, training.batch)
    images = stock[classes, random.integers(0, training.pictures, training.batch)]
    shifted = [torch.roll(i, tuple(int(s) for s in random.integers(-4, 5, 2)), (1, 2)) for i in images]
    return torch.stack(shifted), torch.from_numpy(classes)
