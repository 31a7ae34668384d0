"""What training minimises: smooth-L1 of the expectations (paper eqs 37-38) and cross-entropy of the planes' scores."""

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


def loss(out: Training, inverse: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Of a training output against the true inverse depth (B, H, W); 0 is unknown."""
    planes = out.coarse_scores[-1].shape[1]
    step = ((high - low) / (planes - 1))[:, None, None]
    truth = (inverse - low[:, None, None]) / step
    known = (inverse > 0) & (truth >= 0) & (truth <= planes - 1)
    quarter, half = (truth[:, k // 2 :: k, k // 2 :: k] for k in (4, 2))
    known4, known2 = (known[:, k // 2 :: k, k // 2 :: k] for k in (4, 2))
    total = inverse.new_zeros(())
    weights = MODULE_WEIGHTS[-len(out.coarse) :]
    for weight, scores, expected in zip(weights, out.coarse_scores, out.coarse, strict=True):
        total = total + weight * (_smooth(expected - quarter, known4) + ENTROPY_WEIGHT * _entropy(scores, quarter, known4))
    total = total + _smooth(out.fine_start - half, known2)
    fine = (half - out.fine_start.detach()) / FINE_RATIO + (FINE_PLANES - 1) / 2
    within = known2 & (fine > -1) & (fine < FINE_PLANES)
    for weight, scores in zip((0.2, 0.4), out.fine_scores, strict=True):
        total = total + weight * ENTROPY_WEIGHT * _entropy(scores, fine, within)
    total = total + 0.5 * _smooth(out.fine - fine, within)
    return total + _smooth((out.full - truth) / FINE_RATIO, known) * 0.5


def _smooth(error: Tensor, known: Tensor) -> Tensor:
    """Mean smooth-L1 with threshold 1 (eq 38) over what is known."""
    value = F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
    return (value * known).sum() / known.sum().clamp_min(1)


def _entropy(scores: Tensor, truth: Tensor, known: Tensor) -> Tensor:
    """Cross-entropy against a Laplacian around the true plane."""
    number = torch.arange(scores.shape[1], device=scores.device, dtype=torch.float32).view(1, -1, 1, 1)
    wanted = torch.softmax(-(number - truth[:, None]).abs() / SPREAD, 1)
    value = -(wanted * torch.log_softmax(scores.float(), 1)).sum(1)
    return (value * known).sum() / known.sum().clamp_min(1)
