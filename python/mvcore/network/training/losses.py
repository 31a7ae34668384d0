"""What training minimises: smooth-L1 of the expectations (paper eqs 37-38) and cross-entropy of the planes' scores.

Every part is a mean over the pixels that some source sees and a mean over the hidden ones, counted apart: hidden pixels, a fifth of
all, hold most of the error, and where nothing matches it says little of how well the network matches.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from ..model import FINE_PLANES, FINE_RATIO, Training

MODULE_WEIGHTS = (0.5, 0.5, 0.7, 1.0)
"""Of the four output modules."""
SPREAD = 0.5
"""Planes: width of the Laplacian that the scores' distribution is drawn to."""
ENTROPY_WEIGHT = 0.3


HIDDEN_SHARE = 0.1
"""Of the loss: weight of the hidden pixels' mean, beside 1 - HIDDEN_SHARE for the seen pixels' mean."""


def loss(out: Training, inverse: Tensor, low: Tensor, high: Tensor, seen: Tensor) -> Tensor:
    """Of a training output against the true inverse depth; parameters as of `split_loss`."""
    parts = split_loss(out, inverse, low, high, seen)
    return (1 - HIDDEN_SHARE) * parts[0] + HIDDEN_SHARE * parts[1]


def split_loss(out: Training, inverse: Tensor, low: Tensor, high: Tensor, seen: Tensor) -> Tensor:
    """The loss over seen and over hidden pixels, (2,).

    inverse : (B, H, W) true inverse depth, 0 is unknown. low, high : (B,) the first and last plane.
    seen : (B, sources, H, W) bool, whether each source sees the pixel's surface; a pixel is hidden where none does.
    """
    planes = out.coarse_scores[-1].shape[1]
    step = ((high - low) / (planes - 1))[:, None, None]
    truth = (inverse - low[:, None, None]) / step
    known = (inverse > 0) & (truth >= 0) & (truth <= planes - 1)
    kinds = torch.stack([known & seen.any(1), known & ~seen.any(1)])
    quarter, half = (truth[:, k // 2 :: k, k // 2 :: k] for k in (4, 2))
    kinds4, kinds2 = (kinds[..., k // 2 :: k, k // 2 :: k] for k in (4, 2))
    total = inverse.new_zeros(2)
    weights = MODULE_WEIGHTS[-len(out.coarse) :]
    for weight, scores, expected in zip(weights, out.coarse_scores, out.coarse, strict=True):
        total = total + weight * _means(_smooth(expected - quarter) + ENTROPY_WEIGHT * _entropy(scores, quarter), kinds4)
    total = total + _means(_smooth(out.fine_start - half), kinds2)
    fine = (half - out.fine_start.detach()) / FINE_RATIO + (FINE_PLANES - 1) / 2
    within = kinds2 & (fine > -1) & (fine < FINE_PLANES)
    for weight, scores in zip((0.2, 0.4), out.fine_scores, strict=True):
        total = total + weight * ENTROPY_WEIGHT * _means(_entropy(scores, fine), within)
    total = total + 0.5 * _means(_smooth(out.fine - fine), within)
    return total + 0.5 * _means(_smooth((out.full - truth) / FINE_RATIO), kinds)


def _means(value: Tensor, kinds: Tensor) -> Tensor:
    """Means (2,) of values (B, h, w) over two sets of pixels (2, B, h, w); 0 of an empty set."""
    return (value * kinds).sum((1, 2, 3)) / kinds.sum((1, 2, 3)).clamp_min(1)


def _smooth(error: Tensor) -> Tensor:
    """Smooth-L1 with threshold 1 (eq 38) of each pixel."""
    return F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")


def _entropy(scores: Tensor, truth: Tensor) -> Tensor:
    """Cross-entropy of each pixel against a Laplacian around the true plane."""
    number = torch.arange(scores.shape[1], device=scores.device, dtype=torch.float32).view(1, -1, 1, 1)
    wanted = torch.softmax(-(number - truth[:, None]).abs() / SPREAD, 1)
    return -(wanted * torch.log_softmax(scores.float(), 1)).sum(1)
