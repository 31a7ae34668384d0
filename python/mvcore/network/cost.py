"""The cost space: group-wise correlation of the reference's features with the sources' features warped to planes."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from .. import _core


def scaled_maps(maps: Tensor, factor: int) -> Tensor:
    """Relative maps (…, 12) between views for images reduced by ``factor``, whose pixels cover factor² of the full ones."""
    a, b = maps[..., :9].unflatten(-1, (3, 3)), maps[..., 9:]
    shrink = torch.tensor([[1 / factor, 0, (1 - factor) / 2 / factor], [0, 1 / factor, (1 - factor) / 2 / factor], [0, 0, 1]])
    grow = torch.tensor([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
    shrink, grow = shrink.to(maps), grow.to(maps)
    return torch.cat([(shrink @ a @ grow).flatten(-2), b @ shrink.T], -1)


def landing(maps: Tensor, planes: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels of the source, (B, D, H, W) x and y, where reference pixels at inverse depths (B, D, H, W) land (eqs 9-12)."""
    _b, _d, h, w = planes.shape
    y, x = torch.meshgrid(torch.arange(h, device=maps.device), torch.arange(w, device=maps.device), indexing="ij")
    pixel = torch.stack([x, y, torch.ones_like(x)]).to(maps).flatten(1)
    ray = (maps[:, :9].unflatten(-1, (3, 3)) @ pixel).unflatten(-1, (h, w))
    q = [ray[:, None, k] + planes * maps[:, 9 + k, None, None, None] for k in range(3)]
    z = torch.where(q[2] > 1e-6, q[2], torch.full_like(q[2], float("nan")))
    return torch.nan_to_num(q[0] / z, nan=-1e4), torch.nan_to_num(q[1] / z, nan=-1e4)


def correlate_one(reference: Tensor, source: Tensor, maps: Tensor, planes: Tensor, groups: int) -> Tensor:
    """Mean product of each group of channels, (B, G, D, H, W); 0 where a plane falls outside the source.

    reference (B, C, H, W) and source (B, C, h, w) features of unit length a group; planes (B, D, H, W) inverse depths.
    """
    b, d, hh, ww = planes.shape
    c = reference.shape[1]
    x, y = landing(maps, planes)
    h, w = source.shape[-2:]
    grid = torch.stack([(x + 0.5) * (2 / w) - 1, (y + 0.5) * (2 / h) - 1], -1).flatten(1, 2).clamp(-4, 4)
    warped = F.grid_sample(source, grid.to(source.dtype), mode="bilinear", padding_mode="zeros", align_corners=False)
    warped = warped.view(b, groups, c // groups, d, hh, ww)
    return (warped * reference.view(b, groups, c // groups, 1, hh, ww)).sum(2)


def unit(features: Tensor, groups: int) -> Tensor:
    """Each group of channels scaled to unit length."""
    grouped = features.float().contiguous().unflatten(1, (groups, -1))
    return (grouped * torch.rsqrt(grouped.square().sum(2, keepdim=True) + 1e-6)).flatten(1, 2)


def cost_space(
    reference: Tensor, sources: list[Tensor], maps: list[Tensor], planes: Tensor, groups: int, gain: Tensor, bias: Tensor
) -> Tensor:
    """`correlate`, by the Rust kernel where nothing asks for gradients and the tensors are on the CPU; channels last in memory."""
    if torch.is_grad_enabled() or reference.device.type != "cpu":
        return correlate(reference, sources, maps, planes, groups, gain, bias)
    views = [f.float().permute(0, 2, 3, 1).contiguous().numpy() for f in (reference, *sources)]
    ways = torch.stack([m.float() for m in maps], 1).numpy()
    swept = planes.float().contiguous().numpy()
    weights = gain.detach().float().numpy()
    volumes = [
        torch.from_numpy(_core.correlate(views[0][b], [v[b] for v in views[1:]], ways[b], swept[b], weights, float(bias)))
        for b in range(len(swept))
    ]
    return torch.stack(volumes).permute(0, 4, 1, 2, 3)


def correlate(
    reference: Tensor, sources: list[Tensor], maps: list[Tensor], planes: Tensor, groups: int, gain: Tensor, bias: Tensor
) -> Tensor:
    """Mean of the sources' correlations weighted by visibility, (B, G, D, H, W).

    A source's visibility at a pixel is the sigmoid of its best weighted correlation over all planes, ``max_d gain·corr_d + bias``:
    what a source sees correlates somewhere, what it does not see nowhere.
    """
    total, weights = 0.0, 0.0
    for source, m in zip(sources, maps, strict=True):
        corr = correlate_one(reference, source, m, planes, groups)
        weight = torch.sigmoid((corr * gain.view(1, -1, 1, 1, 1)).sum(1).amax(1) + bias)[:, None, None] + 1e-3
        total, weights = total + weight * corr, weights + weight
    return total / weights
