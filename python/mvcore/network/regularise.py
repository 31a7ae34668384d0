"""From the cost space to disparity: stacked 3D hourglasses, output modules, soft-argmin (paper eqs 35-36)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv3d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm3d(outputs), nn.ReLU(inplace=True))


class _Guide(nn.Module):
    """The reference's context decides how much each channel of the volume counts at each pixel."""

    def __init__(self, context: int, channels: int) -> None:
        super().__init__()
        self.project = nn.Conv2d(context, channels, 1)

    def forward(self, volume: Tensor, context: Tensor) -> Tensor:
        return volume * torch.sigmoid(self.project(context)).unsqueeze(2) * 2


class Hourglass(nn.Module):
    """Two halvings and back with skip connections: each cell learns of its wider surroundings."""

    def __init__(self, channels: tuple[int, int, int]) -> None:
        super().__init__()
        a, b, c = channels
        self.down1, self.mid1 = _conv(a, b, 2), _conv(b, b)
        self.down2, self.mid2 = _conv(b, c, 2), _conv(c, c)
        self.up2, self.up1 = nn.Conv3d(c, b, 1, bias=False), nn.Conv3d(b, a, 1, bias=False)
        self.join2, self.join1 = _conv(b, b), nn.Sequential(nn.BatchNorm3d(a), nn.ReLU(inplace=True))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, D, H, W) to the same shape."""
        one = self.mid1(self.down1(x))
        two = self.mid2(self.down2(one))
        one = self.join2(one + _like(self.up2(two), one))
        return self.join1(x + _like(self.up1(one), x))


def _like(x: Tensor, other: Tensor) -> Tensor:
    return F.interpolate(x, size=other.shape[2:], mode="trilinear", align_corners=False)


class Output(nn.Sequential):
    """An output module: two 3D convolutions down to one channel of costs' negatives."""

    def __init__(self, channels: int) -> None:
        super().__init__(*_conv(channels, 8), nn.Conv3d(8, 1, 3, padding=1, bias=False))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, D, H, W) to (B, D, H, W)."""
        return super().forward(x).squeeze(1)


class Regulariser(nn.Module):
    """Costs (B, G, D, H, W) to scores (B, D, H, W) by stacked hourglasses with an output module before and after each.

    In training all outputs are returned; at inference the last alone is computed.
    """

    def __init__(self, groups: int, channels: tuple[int, int, int], context: int, hourglasses: int) -> None:
        super().__init__()
        self.enter = nn.Sequential(_conv(groups, channels[0]), _conv(channels[0], channels[0]))
        self.guide = _Guide(context, channels[0])
        self.hourglasses = nn.ModuleList(Hourglass(channels) for _ in range(hourglasses))
        self.outputs = nn.ModuleList(Output(channels[0]) for _ in range(hourglasses + 1))

    def forward(self, costs: Tensor, context: Tensor) -> list[Tensor]:
        """Scores of each output module; at inference of the last."""
        x = self.guide(self.enter(costs.contiguous(memory_format=torch.channels_last_3d)), context)
        if not self.training:
            for hourglass in self.hourglasses:
                x = hourglass(x)
            return [self.outputs[-1](x)]
        scores = [self.outputs[0](x)]
        for hourglass, output in zip(self.hourglasses, self.outputs[1:], strict=True):
            x = hourglass(x)
            scores.append(output(x))
        return scores


def soft_argmin(scores: Tensor) -> Tensor:
    """Expected plane number (B, H, W) under softmax of the scores (B, D, H, W) (eqs 35-36 with scores for negative costs)."""
    number = torch.arange(scores.shape[1], device=scores.device, dtype=torch.float32)
    return torch.einsum("bdhw,d->bhw", torch.softmax(scores.float(), 1), number)


def windowed_soft_argmin(scores: Tensor, radius: int = 2) -> tuple[Tensor, Tensor]:
    """Soft-argmin over the planes within ``radius`` of the peak, and the probability of the four bins nearest to it.

    The plain expectation stands between the two depths of an edge; the window stays on one of them.
    """
    p = torch.softmax(scores.float(), 1)
    d = p.shape[1]
    peak = p.argmax(1, keepdim=True)
    number = torch.arange(d, device=p.device, dtype=torch.float32).view(1, -1, 1, 1)
    near = p * ((number - peak).abs() <= radius)
    plane = (near * number).sum(1) / near.sum(1).clamp_min(1e-9)
    low = (plane.floor().long() - 1).clamp(0, max(d - 4, 0))
    bins = low[:, None] + torch.arange(min(4, d), device=p.device).view(1, -1, 1, 1)
    return plane, p.gather(1, bins).sum(1)


class ConvexUpsample(nn.Module):
    """Doubles a map: each fine pixel is a learned convex mixture of the nine coarse ones around it."""

    def __init__(self, context: int, hidden: int = 32) -> None:
        super().__init__()
        self.mask = nn.Sequential(nn.Conv2d(context, hidden, 3, padding=1), nn.ELU(inplace=True), nn.Conv2d(hidden, 36, 1))

    def forward(self, values: Tensor, context: Tensor) -> Tensor:
        """values (B, K, H, W) to (B, K, 2H, 2W)."""
        b, k, h, w = values.shape
        mask = torch.softmax(self.mask(context).float().view(b, 1, 9, 4, h, w), 2)
        around = F.unfold(F.pad(values, (1, 1, 1, 1), mode="replicate"), 3).view(b, k, 9, 1, h, w)
        return F.pixel_shuffle((mask * around).sum(2).flatten(1, 2), 2)
