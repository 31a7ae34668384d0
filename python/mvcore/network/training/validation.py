"""How good a network is on what it was not trained on: held-out procedural families, and published rectified pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..matcher import RECTIFIED, padded, planes_for
from ..model import DisparityNet, Prediction
from .batches import Batch, Recipe
from .datasets import Item
from .stream import rendered

SETS = {"choice": 1_000_000, "report": 2_000_000}
"""The held-out sets, by what is added to the training's seed: checkpoints are chosen on one and reported on the other."""


class HeldOut:
    """The held-out sets, of the same size of image whatever is trained on; each is half pairs, half posed views.

    Batches hold two samples of one scene: ``samples`` of a set are rounded up to a multiple of four. They are rendered from now on, by
    ``workers`` processes, and waited for when they are first asked for.
    """

    def __init__(self, seed: int, samples: int, workers: int = 0) -> None:
        self.each = -(-samples // 4)
        recipes = [Recipe(seed + more, held_out=True, pairs=pairs) for more in SETS.values() for pairs in (1.0, 0.0)]
        self.coming = rendered([(r, range(self.each)) for r in recipes], workers)

    @cached_property
    def sets(self) -> dict[str, list[Batch]]:
        """Batches by the names of `SETS`."""
        batches = [replace(b, planes=32) for b in self.coming]
        return {name: batches[2 * k * self.each : 2 * (k + 1) * self.each] for k, name in enumerate(SETS)}


@torch.no_grad()
def validate(net: DisparityNet, batches: Sequence[Batch], device: torch.device) -> dict[str, float]:
    """Errors on batches of pairs and of posed views, which are told apart by their spans: a pair's begins at 0.

    ``_bad1`` and ``_bad025`` are shares of pixels off by over one or a quarter of 32 planes, ``_epe`` mean errors in pixels; of pairs over
    all known pixels and, ``pair_seen_…``, over those that the other image shows; of views over what some source sees.
    """
    parts: dict[str, list[Tensor]] = {k: [] for k in ("pair", "pair_seen", "views", "pair_px", "pair_seen_px")}
    for batch in batches:
        batch = batch.to(device)
        out: Prediction = net(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, batch.planes)
        known = (batch.inverse > 0) & (batch.inverse >= batch.low[:, None, None]) & (batch.inverse <= batch.high[:, None, None])
        seen = known & batch.seen.any(1)
        error = (out.inverse - batch.inverse).abs()
        planes = error / ((batch.high - batch.low) / (batch.planes - 1))[:, None, None]
        if bool((batch.low == 0).all()):
            parts["pair"].append(planes[known])
            parts["pair_px"].append(error[known])
            parts["pair_seen"].append(planes[seen])
            parts["pair_seen_px"].append(error[seen])
        else:
            parts["views"].append(planes[seen])
    figures: dict[str, float] = {}
    for name in ("pair", "pair_seen", "views"):
        if parts[name]:
            off = torch.cat(parts[name])
            figures |= {f"{name}_bad1": float((~(off <= 1)).float().mean()), f"{name}_bad025": float((~(off <= 0.25)).float().mean())}
        if parts.get(f"{name}_px"):
            figures[f"{name}_epe"] = float(torch.cat(parts[f"{name}_px"]).mean())
    return figures


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
        out: Prediction = net(images[0], images[1:], [torch.from_numpy(RECTIFIED)[None].to(device)], *ends, planes_for(top))
        known = sample.inverse > 0
        error = np.abs(out.inverse[0, :h, :w].cpu().numpy() - sample.inverse)[known]
        shares.append(float((error > 2).mean()))
        errors.append(float(error.mean()))
    return {"middlebury_bad2": float(np.mean(shares)), "middlebury_epe": float(np.mean(errors))}
