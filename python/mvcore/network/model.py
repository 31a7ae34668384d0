"""The disparity network: one set of weights for rectified pairs and for posed views (paper section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .cost import cost_space, scaled_maps, unit
from .features import PRESETS, Features, normalised
from .regularise import ConvexUpsample, Regulariser, soft_argmin, windowed_soft_argmin

COARSE_GROUPS, FINE_GROUPS = 8, 8
COARSE_CHANNELS, FINE_CHANNELS = (16, 32, 48), (8, 16, 32)
FINE_PLANES = 8
FINE_RATIO = 0.25
"""Interval of the second stage's planes in intervals of the first's."""


Looks = tuple[Tensor, Tensor, Tensor, Tensor]
"""Features of an image: for the cost space at quarter and half size, and for the hourglasses there."""


@dataclass
class Prediction:
    """What the network says of a view, in inverse depth.

    inverse : (B, H, W) at full size; confidence : (B, H, W) probability of the four nearest planes, 0 .. 1.
    """

    inverse: Tensor
    confidence: Tensor


@dataclass
class Training:
    """What the losses need: planes' scores and expectations, in planes of their stage."""

    coarse_scores: list[Tensor]
    coarse: list[Tensor]
    fine_start: Tensor
    fine_scores: list[Tensor]
    fine: Tensor
    full: Tensor


class DisparityNet(nn.Module):
    """Features, cost space, hourglasses at quarter size; a narrow second search at half size; learned up-sampling to full.

    Parameters
    ----------
    preset : ``compact`` or ``paper``, the widths of the trunk.
    hourglasses : stacked; with one output module before them and one after each, three give the paper's four.
    groups : correlation groups at quarter size.

    ``bfloat16`` puts the first stage's hourglasses, most of the work, into that precision. The rest stays in float32: planes a quarter
    of the first stage's interval apart cost nearly the same in bfloat16, and in some batches the second stage's gradients had little
    to do with float32's.
    """

    def __init__(self, preset: str = "compact", hourglasses: int = 3, groups: int = COARSE_GROUPS, windowed: bool = True) -> None:
        super().__init__()
        widths = PRESETS[preset]
        self.preset, self.groups, self.windowed = preset, groups, windowed
        self.bfloat16 = False
        self.features = Features(widths)
        context = widths.blocks[2]
        self.coarse = Regulariser(groups, COARSE_CHANNELS, context, hourglasses)
        detail = widths.blocks[1]
        self.fine = Regulariser(FINE_GROUPS, FINE_CHANNELS, detail, 1)
        self.up4, self.up2 = ConvexUpsample(context), ConvexUpsample(detail)
        self.gain = nn.Parameter(torch.full((groups,), 4.0 / groups))
        self.bias = nn.Parameter(torch.tensor(-2.0))
        self.apply(_initialised)
        self.apply(_channels_last)

    def forward(
        self, reference: Tensor, sources: list[Tensor], maps: list[Tensor], low: Tensor, high: Tensor, planes: int
    ) -> Prediction | Training:
        """Inverse depth of the reference view.

        reference : (B, 3, H, W) of 0 .. 255, sides divisible by 16; sources : likewise, one each.
        maps : (B, 12) relative maps reference to source for full-size pixels; low, high : (B,) inverse depths; planes : of the first stage.
        """
        return self.compare(self._features([reference, *sources]), maps, low, high, planes)

    def look(self, image: Tensor) -> Looks:
        """Features of one image (1, 3, H, W): what `compare` takes of it, whatever it is compared with."""
        return self._features([image])[0]

    def compare(self, looks: Sequence[Looks], maps: list[Tensor], low: Tensor, high: Tensor, planes: int) -> Prediction | Training:
        """The rest of the way, from the features of the reference view and of its sources. Parameters as of `forward`."""
        quarter, half, context, detail = zip(*looks, strict=True)
        step = (high - low) / (planes - 1)
        number = torch.arange(planes, device=low.device, dtype=torch.float32)
        b, _c, h, w = quarter[0].shape
        swept = (low[:, None] + step[:, None] * number)[..., None, None].expand(b, planes, h, w)
        f = [unit(q, self.groups) for q in quarter]
        costs = cost_space(f[0], f[1:], [scaled_maps(m, 4) for m in maps], swept, self.groups, self.gain, self.bias)
        with torch.autocast(low.device.type, torch.bfloat16, enabled=self.bfloat16):
            coarse_scores = self.coarse(costs, context[0])
        coarse, confidence = self._expected(coarse_scores[-1])
        begun = self.up4(torch.stack([coarse, confidence], 1), context[0])
        start = begun.detach()
        inverse = low[:, None, None] + step[:, None, None] * start[:, 0]
        offset = (torch.arange(FINE_PLANES, device=low.device) - (FINE_PLANES - 1) / 2) * FINE_RATIO
        narrow = inverse[:, None] + (offset * step[:, None])[..., None, None]
        g = [unit(x, FINE_GROUPS) for x in half]
        one = torch.ones(FINE_GROUPS, device=low.device) * (4.0 / FINE_GROUPS)
        costs = cost_space(g[0], g[1:], [scaled_maps(m, 2) for m in maps], narrow, FINE_GROUPS, one, self.bias)
        fine_scores = self.fine(costs, detail[0])
        fine = soft_argmin(fine_scores[-1])
        moved = start[:, 0] + (fine - (FINE_PLANES - 1) / 2) * FINE_RATIO
        full = self.up2(torch.stack([moved, start[:, 1]], 1), detail[0])
        if self.training:
            expectations = [soft_argmin(s) for s in coarse_scores]
            return Training(coarse_scores, expectations, begun[:, 0], fine_scores, fine, full[:, 0])
        return Prediction(low[:, None, None] + step[:, None, None] * full[:, 0], full[:, 1])

    def _expected(self, scores: Tensor) -> tuple[Tensor, Tensor]:
        plane, confidence = windowed_soft_argmin(scores)
        return (plane if self.windowed else soft_argmin(scores)), confidence

    def _features(self, images: list[Tensor]) -> list[Looks]:
        if all(i.shape == images[0].shape for i in images):
            together = self.features(normalised(torch.cat(images)))
            return list(zip(*(t.chunk(len(images)) for t in together), strict=True))
        return [self.features(normalised(i)) for i in images]


def _initialised(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d | nn.Conv3d):
        nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def _channels_last(module: nn.Module) -> None:
    """Weights in the layout that torch's convolutions are fastest in on a CPU: up to twice, with 8 channels."""
    if isinstance(module, nn.Conv2d):
        module.to(memory_format=torch.channels_last)
    elif isinstance(module, nn.Conv3d):
        module.to(memory_format=torch.channels_last_3d)
