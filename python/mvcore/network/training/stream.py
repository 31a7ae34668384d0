"""Batches on their way to training: rendered by processes of their own, and kept on the device to be drawn from again."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from queue import Queue
from threading import Thread
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from .batches import PLANES, Batch, Recipe, make_batch

Task = tuple[Recipe, range]
"""A recipe and the numbers of those of its batches that are wanted."""
THREADS = ("RAYON_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class _Tasks(Dataset[Batch]):
    """Few bytes, however many batches: a process that starts takes in no more than a pipe holds before it has imported everything."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        self.tasks = tasks

    def __len__(self) -> int:
        return sum(len(numbers) for _, numbers in self.tasks)

    def __getitem__(self, place: int) -> Batch:
        for recipe, numbers in self.tasks:
            if place < len(numbers):
                return make_batch(recipe, numbers[place])
            place -= len(numbers)
        raise IndexError(place)


def _one_thread(_worker: int) -> None:
    cv2.setNumThreads(0)


def rendered(tasks: Sequence[Task], workers: int) -> Iterator[Batch]:
    """The batches of these tasks in order, rendered ahead by ``workers`` processes of one thread each; 0 is this process."""
    if workers == 0:
        return (make_batch(recipe, n) for recipe, numbers in tasks for n in numbers)
    # A process alone may use every thread; many with as many each would get in each other's way. They take this from us when they start.
    alone = workers == 1
    before = {name: os.environ.get(name) for name in THREADS}
    if not alone:
        os.environ.update(dict.fromkeys(THREADS, "1"))
    spawned: dict[str, Any] = {"multiprocessing_context": "spawn", "prefetch_factor": 4, "worker_init_fn": None if alone else _one_thread}
    loader: DataLoader[Batch] = DataLoader(_Tasks(tasks), batch_size=None, num_workers=workers, **spawned)
    try:
        return iter(loader)
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


class Stock:
    """The samples rendered last, on the device, from which batches are drawn again and again: training then never waits for rendering.

    Samples are kept apart by their number of views, ``size`` of each. A drawn batch is of one such kind, chosen as often as it was
    rendered; it is mirrored at random, and each view passes through one more camera: exposure, colour balance, gamma and noise.
    """

    def __init__(self, size: int, device: torch.device, seed: int) -> None:
        self.size, self.device = size, device
        self.kept: dict[int, list[Tensor]] = {}
        self.count: dict[int, int] = {}
        self.random = np.random.default_rng((seed, 11))
        self.noise = torch.Generator(device).manual_seed(seed)

    def add(self, batch: Batch) -> None:
        """Keeps a batch's samples in the place of the oldest of their kind."""
        views, many = len(batch.images), len(batch.inverse)
        batch = batch.to(self.device)
        shown = batch.seen.any(1, keepdim=True)
        parts = [torch.stack(batch.images, 1), torch.stack(batch.maps, 1), batch.inverse, shown, batch.low, batch.high]
        if views not in self.kept:
            self.kept[views] = [torch.empty((self.size, *p.shape[1:]), dtype=p.dtype, device=self.device) for p in parts]
        places = (torch.arange(many, device=self.device) + self.count.get(views, 0)) % self.size
        for kept, part in zip(self.kept[views], parts, strict=True):
            kept[places] = part
        self.count[views] = self.count.get(views, 0) + many

    def draw(self, batch: int, planes: int) -> Batch:
        """A batch of kept samples, each drawn alone. Needs a batch that was added."""
        kinds = list(self.count)
        often = np.array([self.count[k] for k in kinds], float)
        views = int(self.random.choice(kinds, p=often / often.sum()))
        filled = min(self.count[views], self.size)
        chosen = torch.from_numpy(self.random.integers(0, filled, batch)).to(self.device, non_blocking=True)
        images, maps, inverse, shown, low, high = (k.index_select(0, chosen) for k in self.kept[views])
        drawn = Batch(list(images.unbind(1)), list(maps.unbind(1)), inverse, shown, low, high, planes)
        if self.random.random() < 0.5:
            drawn = mirrored(drawn, -2)
        # Pairs, which are among the samples of two views, keep left and right.
        if views > 2 and self.random.random() < 0.5:
            drawn = mirrored(drawn, -1)
        return replace(drawn, images=[self._again(i) for i in drawn.images])

    def _again(self, images: Tensor) -> Tensor:
        """One view of each sample, (B, 3, h, w), through one more camera."""
        b = len(images)

        def normal(deviation: float, *shape: int) -> Tensor:
            return torch.randn(shape, generator=self.noise, device=self.device) * deviation

        value = images.float() / 255
        value = value * torch.exp(normal(0.1, b, 1, 1, 1) + normal(0.03, b, 3, 1, 1))
        value = value.clamp(0, 1) ** torch.exp(normal(0.1, b, 1, 1, 1))
        value = value + normal(0.015, *images.shape) * torch.rand((b, 1, 1, 1), generator=self.noise, device=self.device)
        return (value * 255).clamp(0, 255)


def mirrored(batch: Batch, axis: int) -> Batch:
    """The batch with every view mirrored, top to bottom (axis -2) or left to right (axis -1): the maps follow."""
    flip = torch.eye(3, device=batch.inverse.device)
    row = -1 - axis
    flip[row, row], flip[row, 2] = -1, batch.inverse.shape[axis] - 1

    def follow(m: Tensor) -> Tensor:
        a, b = m[:, :9].unflatten(1, (3, 3)), m[:, 9:]
        return torch.cat([(flip @ a @ flip).flatten(1), b @ flip.T], 1)

    turned = {k: getattr(batch, k).flip(axis) for k in ("inverse", "seen")}
    return replace(batch, images=[i.flip(axis) for i in batch.images], maps=[follow(m) for m in batch.maps], **turned)


def replayed(recipe: Recipe, numbers: range, workers: int, size: int, device: torch.device) -> Iterator[Batch]:
    """As many batches as there are numbers, drawn from a `Stock` of ``size`` that takes in whatever was rendered meanwhile.

    It waits for the first `FIRST` rendered batches a worker, and for none after them. What is drawn depends on the speed of both.
    """
    stock, ready = Stock(size, device, recipe.seed + 7919 * numbers.start), Queue[Batch | Exception](8)
    source = rendered([(recipe, numbers)], workers)
    Thread(target=_fill, args=(source, ready, device.type == "cuda"), daemon=True).start()

    def drawn() -> Iterator[Batch]:
        for _ in range(min(len(numbers), FIRST * max(1, workers))):
            stock.add(_taken(ready.get()))
        for _ in numbers:
            while not ready.empty():
                stock.add(_taken(ready.get()))
            yield stock.draw(recipe.batch, int(stock.random.choice(PLANES)))

    return drawn()


FIRST = 1
"""Rendered batches a process that are waited for, before training begins."""


def _fill(source: Iterator[Batch], ready: Queue[Batch | Exception], pin: bool) -> None:
    """Hands rendered batches on, in memory from which a copy to the device needs no waiting; and an error, to be raised there."""
    try:
        for batch in source:
            ready.put(batch.pinned() if pin else batch)
    except Exception as error:
        ready.put(error)


def _taken(item: Batch | Exception) -> Batch:
    if isinstance(item, Exception):
        raise item
    return item
