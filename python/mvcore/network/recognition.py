"""The recognition head on the trunk: a target's class, and the 1024-vector by which it is matched across views (paper eqs 32-34)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from ..errors import require
from .features import PRESETS, LocalBlock, Trunk, normalised
from .procedural.objects import SIZE
from .weights import load_into, notes_of

EMBEDDING = 1024
"""Values of the first fully connected layer: the paper's figure."""
LOCAL = 32
"""Channels that the local block hands to the head."""
SHIPPED = Path(__file__).with_name("recognition.safetensors")


class TargetClassifier(nn.Module):
    """Trunk, local block, 2x2 max-pool, fully connected 1024, fully connected n, softmax (section 3.1).

    Parameters
    ----------
    classes : n targets that the last layer tells apart.
    preset : ``compact`` or ``paper``, the widths of the trunk.
    """

    def __init__(self, classes: int, preset: str = "compact") -> None:
        super().__init__()
        require(classes >= 2, "classes", "at least 2", classes)
        require(preset in PRESETS, "preset", f"one of {', '.join(PRESETS)}", repr(preset))
        self.preset, self.classes = preset, classes
        widths = PRESETS[preset]
        self.trunk = Trunk(widths)
        self.local = LocalBlock(widths.blocks[2], LOCAL)
        self.first = nn.Linear(LOCAL * (SIZE // 8) ** 2, EMBEDDING)
        self.last = nn.Linear(EMBEDDING, classes)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
                module.to(memory_format=torch.channels_last)

    def vector(self, images: Tensor) -> Tensor:
        """(B, 1024) of images (B, 3, 64, 64) of 0 .. 255."""
        features = F.max_pool2d(self.local(self.trunk(normalised(images))[1]), 2)
        return torch.tanh(self.first(features.flatten(1)))

    def forward(self, images: Tensor) -> Tensor:
        """Scores (B, n); their softmax are the classes' probabilities."""
        return self.last(F.dropout(self.vector(images), 0.3, self.training))

    @torch.no_grad()
    def embed(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """(B, 1024) float32 vectors of unit length of (h, w, 3) uint8 images of targets; their dot product is the likeness."""
        self.eval()
        return F.normalize(self.vector(_stacked(images)), dim=1).numpy()

    @torch.no_grad()
    def classify(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """(B, n) probabilities of the classes."""
        self.eval()
        return torch.softmax(self(_stacked(images)), 1).numpy()


def _stacked(images: Sequence[NDArray[np.uint8]]) -> Tensor:
    require(len(images) > 0, "images", "at least one", "none")
    small = []
    for n, image in enumerate(images):
        good = isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3 and image.size > 0
        require(good, "images", "(h, w, 3) uint8", f"number {n} of another kind")
        smaller = min(image.shape[:2]) > SIZE
        small.append(cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR))
    return torch.from_numpy(np.stack(small)).permute(0, 3, 1, 2)


def squared_error(scores: Tensor, classes: Tensor) -> Tensor:
    """Half the mean squared distance between probabilities and truth (eq 34); cross-entropy trains faster."""
    wanted = F.one_hot(classes, scores.shape[1]).float()
    return 0.5 * (torch.softmax(scores, 1) - wanted).square().sum(1).mean()


def rank_1(gallery: NDArray[np.float32], probes: NDArray[np.float32]) -> float:
    """Share of probes (n, K) whose likeliest of the gallery (n, K) is their own, row by row the same targets."""
    return float(((probes @ gallery.T).argmax(1) == np.arange(len(probes))).mean())


def load_classifier(path: Path | None = None) -> TargetClassifier:
    """A trained classifier; by default the one in the package, whose ``embed`` is of use for targets never seen."""
    notes, state = notes_of(path or SHIPPED)
    net = TargetClassifier(int(notes.get("classes", 2)), notes.get("preset", "compact"))
    load_into(net, state, path or SHIPPED)
    return net.eval()
