"""Batch normalisation taken into the convolution before it, and out again: less work wherever its statistics do not change."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from .model import DisparityNet


def folded(net: DisparityNet) -> DisparityNet:
    """The same network, in place, with each batch normalisation that follows a convolution as its weights and bias."""
    for parent, (name, conv), (after, norm) in _pairs(net):
        if isinstance(conv, nn.Conv3d) and isinstance(norm, nn.BatchNorm3d):
            parent._modules[name] = fuse_conv_bn_eval(conv.eval(), norm.eval()).to(memory_format=torch.channels_last_3d)
            parent._modules[after] = nn.Identity()
    return net


@torch.no_grad()
def unfolded(net: DisparityNet) -> DisparityNet:
    """A network of the usual build that does what a folded one does: its batch normalisations only add the biases."""
    usual = DisparityNet(net.preset, len(net.coarse.hourglasses), net.groups, net.windowed).eval()
    state, known = net.state_dict(), usual.state_dict()
    usual.load_state_dict({k: state.get(k, v) for k, v in known.items()})
    for (_, _, (_, norm)), (_, (_, conv), _) in zip(_pairs(usual), _pairs(net), strict=True):
        if isinstance(norm, nn.BatchNorm3d) and isinstance(conv, nn.Conv3d) and conv.bias is not None:
            norm.running_mean.zero_()
            norm.running_var.fill_(1 - norm.eps)
            norm.weight.fill_(1)
            norm.bias.copy_(conv.bias)
    return usual


@torch.no_grad()
def renormalised(net: DisparityNet, batches: Iterable[tuple[Any, ...]]) -> DisparityNet:
    """The same function, in place, whose batch normalisations hold the statistics of these inputs and scale what they normalise back.

    Training with the batches' own statistics can go on from there. From weights that were folded, whose normalisations are the identity, it
    would begin with another function. ``batches`` are arguments of the network.
    """
    sums: dict[nn.Module, list[Tensor]] = {}

    def gather(norm: nn.Module, inputs: tuple[Tensor, ...], _output: Tensor) -> None:
        x = inputs[0].float()
        sums.setdefault(norm, []).append(torch.stack([x.mean((0, 2, 3, 4)), x.square().mean((0, 2, 3, 4))]))

    # In training all output modules run; their normalisations stay as they are meanwhile.
    net.train()
    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm3d)]
    hooks = [norm.eval().register_forward_hook(gather) for norm in norms]
    for arguments in batches:
        net(*arguments)
    for norm, hook in zip(norms, hooks, strict=True):
        hook.remove()
        mean, square = torch.stack(sums[norm]).mean(0)
        variance = (square - mean * mean).clamp_min(0)
        scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        norm.bias.add_((mean - norm.running_mean) * scale)
        norm.weight.copy_(scale * torch.sqrt(variance + norm.eps))
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
    return net.train()


Named = tuple[str, nn.Module | None]


def _pairs(net: nn.Module) -> Iterator[tuple[nn.Sequential, Named, Named]]:
    """Neighbours in sequences, with the sequence."""
    for module in list(net.modules()):
        if isinstance(module, nn.Sequential):
            for one, other in pairwise(list(module._modules.items())):
                yield module, one, other
