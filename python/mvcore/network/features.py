"""The trunk: VGG16's convolution blocks with ELU, the paper's local block, and a pyramid around them (paper eqs 32-33)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class Widths:
    """Channels of the three VGG blocks, of the two context levels, and of the features for matching."""

    blocks: tuple[int, int, int]
    context: tuple[int, int]
    quarter: int
    half: int


PRESETS = {
    "paper": Widths((64, 128, 256), (256, 256), 64, 32),
    "compact": Widths((16, 32, 64), (96, 128), 32, 16),
}
BLOCK_LAYERS = (2, 2, 3)
"""Convolutions in VGG16's first three blocks: conv1_1 to conv3_3."""


class _Block(nn.Sequential):
    """Convolutions 3x3, each followed by ELU: x_l = f(W_l * x_(l-1) + b_l) (eq 32)."""

    def __init__(self, inputs: int, outputs: int, layers: int) -> None:
        parts: list[nn.Module] = []
        for n in range(layers):
            parts += [nn.Conv2d(inputs if n == 0 else outputs, outputs, 3, padding=1), nn.ELU(inplace=True)]
        super().__init__(*parts)


class Trunk(nn.Module):
    """VGG16 through conv3_3 with ELU in place of ReLU and two 2x2 max-pools (eq 33): half- and quarter-size features."""

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        a, b, c = widths.blocks
        self.blocks = nn.ModuleList(_Block(i, o, n) for i, o, n in zip((3, a, b), (a, b, c), BLOCK_LAYERS, strict=True))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 3, H, W) to (B, b, H/2, W/2) and (B, c, H/4, W/4)."""
        full = self.blocks[0](image)
        half = self.blocks[1](F.max_pool2d(full, 2))
        return half, self.blocks[2](F.max_pool2d(half, 2))


class LocalBlock(nn.Sequential):
    """The paper's 1x1, 3x3, 1x1 block with ELU; the last layer is left linear, for its output is compared by direction."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(
            nn.Conv2d(inputs, inputs, 1),
            nn.ELU(inplace=True),
            nn.Conv2d(inputs, inputs, 3, padding=1),
            nn.ELU(inplace=True),
            nn.Conv2d(inputs, outputs, 1),
        )


class Features(nn.Module):
    """Features for matching at quarter and half size, with context from 1/8 and 1/16 passed down.

    Each is normalised to unit length, so that exposure and contrast of a view do not count.
    """

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        self.trunk = Trunk(widths)
        _a, b, c = widths.blocks
        d, e = widths.context
        self.eighth, self.sixteenth = _Block(c, d, 2), _Block(d, e, 2)
        self.down8, self.down4, self.down2 = nn.Conv2d(e, d, 1), nn.Conv2d(d, c, 1), nn.Conv2d(c, b, 1)
        self.local4, self.local2 = LocalBlock(c, widths.quarter), LocalBlock(b, widths.half)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(B, 3, H, W), sides divisible by 16, to matching features at 1/4 and 1/2 and context at 1/4 and 1/2."""
        half, quarter = self.trunk(image)
        eighth = self.eighth(F.max_pool2d(quarter, 2))
        sixteenth = self.sixteenth(F.max_pool2d(eighth, 2))
        eighth = F.elu(eighth + _doubled(self.down8(sixteenth)))
        quarter = F.elu(quarter + _doubled(self.down4(eighth)))
        half = F.elu(half + _doubled(self.down2(quarter)))
        return self.local4(quarter), self.local2(half), quarter, half


def _doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def normalised(image: Tensor) -> Tensor:
    """(B, 3, H, W) of 0 .. 255 to zero mean and unit deviation an image."""
    image = image.float()
    mean = image.mean((1, 2, 3), keepdim=True)
    return (image - mean) / image.std((1, 2, 3), keepdim=True).clamp_min(1.0)


def load_vgg16(trunk: Trunk, state: dict[str, Tensor]) -> None:
    """Takes conv1_1 to conv3_3 from a torchvision VGG16 state dict, (features.N.weight, features.N.bias)."""
    numbers = iter((0, 2, 5, 7, 10, 12, 14))
    with torch.no_grad():
        for block in trunk.blocks:
            for layer in block:
                if isinstance(layer, nn.Conv2d):
                    n = next(numbers)
                    for name, mine in (("weight", layer.weight), ("bias", layer.bias)):
                        theirs = state.get(f"features.{n}.{name}")
                        if theirs is None or theirs.shape != mine.shape:
                            got = "nothing" if theirs is None else tuple(theirs.shape)
                            raise ValueError(f"state: expected features.{n}.{name} of shape {tuple(mine.shape)}, got {got}")
                        mine.copy_(theirs)
