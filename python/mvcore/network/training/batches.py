"""Batches of procedural samples, each a pure function of the seed and its number, so that a killed training resumes exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...geometry.cameras import relative_map
from ..procedural.scenes import Sample, Tiles, random_pair, random_views
from .datasets import Item, cropped, find_items

PLANES = (24, 32, 48)
"""Planes of the first stage, one of these a batch."""
RENEWED = 400
"""Batches after which the stock of texture tiles is new."""


@dataclass(frozen=True)
class Batch:
    """Samples of one kind: images (B, 3, h, w) of 0 .. 255 a view, maps (B, 12) a source, truth (B, h, w), spans (B,).

    seen : (B, sources, h, w) bool, whether each source sees the pixel's surface; or (B, 1, h, w), whether any does.
    """

    images: list[Tensor]
    maps: list[Tensor]
    inverse: Tensor
    seen: Tensor
    low: Tensor
    high: Tensor
    planes: int

    def to(self, device: torch.device) -> Batch:
        """The batch on a device."""
        return self._each(lambda t: t.to(device, non_blocking=True))

    def pinned(self) -> Batch:
        """The batch in memory that a CUDA device copies from by itself."""
        return self._each(Tensor.pin_memory)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Batch:
        lists = {k: [change(v) for v in getattr(self, k)] for k in ("images", "maps")}
        return replace(self, **lists, **{k: change(getattr(self, k)) for k in ("inverse", "seen", "low", "high")})


@dataclass(frozen=True)
class Recipe:
    """What the batches are made of.

    sizes in pixels, a multiple of 16; ``pairs`` is the share of batches of rectified pairs. ``data`` names published sets on disk,
    ``LAYOUT:FOLDER`` each (`datasets`), from which the share ``files`` of the batches is drawn. ``floating`` and ``wide`` as of
    `random_pair`: what the ablations leave out. ``every``: each view of a posed scene is once the reference, not two of them; more
    samples for the rendering, less different ones.
    """

    seed: int = 1
    batch: int = 2
    width: int = 256
    height: int = 192
    pairs: float = 0.5
    held_out: bool = False
    floating: bool = True
    wide: bool = True
    every: bool = False
    data: tuple[str, ...] = ()
    files: float = 0.5


@lru_cache(maxsize=4)
def _items(source: str) -> list[Item]:
    return find_items(source)


@lru_cache(maxsize=4)
def _tiles(seed: int, epoch: int, held_out: bool) -> Tiles:
    return Tiles(np.random.default_rng((seed, 7, epoch)), held_out)


def make_batch(recipe: Recipe, number: int) -> Batch:
    """Batch ``number`` of a recipe."""
    random = np.random.default_rng((recipe.seed, 3, number))
    if recipe.data and random.random() < recipe.files:
        items = _items(recipe.data[random.integers(len(recipe.data))])
        picked = [items[k]() for k in random.integers(0, len(items), recipe.batch)]
        return stack([cropped(s, recipe.width, recipe.height, random) for s in picked], int(random.choice(PLANES)))
    tiles = _tiles(recipe.seed, number // RENEWED, recipe.held_out)
    size: dict[str, Any] = {"width": recipe.width, "height": recipe.height, "floating": recipe.floating, "wide": recipe.wide}
    if random.random() < recipe.pairs:
        scenes = [random_pair(random, tiles, **size) for _ in range(-(-recipe.batch // 2))]
    else:
        views = int(random.choice([2, 3, 4], p=[0.2, 0.4, 0.4]))
        looks = views if recipe.every else 2
        scenes = [random_views(random, tiles, views, every=recipe.every, **size) for _ in range(-(-recipe.batch // looks))]
    # Several looks at each scene: rendering costs more than training.
    return stack([look for looks in scenes for look in looks][: recipe.batch], int(random.choice(PLANES)))


def stack(samples: list[Sample], planes: int) -> Batch:
    """Samples of the same size and number of views as one batch."""
    views = len(samples[0].cameras)

    def image(k: int) -> Tensor:
        return torch.from_numpy(np.stack([s.images[k] for s in samples])).permute(0, 3, 1, 2).contiguous()

    def map_to(k: int) -> Tensor:
        return torch.from_numpy(np.stack([relative_map(s.cameras[0], s.cameras[k]) for s in samples]))

    return Batch(
        [image(k) for k in range(views)],
        [map_to(k) for k in range(1, views)],
        torch.from_numpy(np.stack([s.inverse for s in samples])),
        torch.from_numpy(np.stack([s.seen for s in samples])),
        torch.tensor([s.span[0] for s in samples], dtype=torch.float32),
        torch.tensor([s.span[1] for s in samples], dtype=torch.float32),
        planes,
    )
