"""Weights as safetensors: written atomically, read without unpickling."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from ..errors import FormatError
from ..io.files import atomically
from .model import DisparityNet


def save_weights(net: nn.Module, path: Path, notes: dict[str, str] | None = None) -> None:
    """All weights and buffers in half precision where that is lossless enough (float16), with what built the network."""
    tensors = {k: v.detach().cpu().half().contiguous() if v.dtype.is_floating_point else v.cpu() for k, v in net.state_dict().items()}
    build = {k: str(getattr(net, k)) for k in ("preset", "groups", "windowed", "classes") if hasattr(net, k)}
    hourglasses = getattr(getattr(net, "coarse", None), "hourglasses", None)
    if hourglasses is not None:
        build["hourglasses"] = str(len(hourglasses))
    atomically(path, lambda p: save_file(tensors, p, build | (notes or {})))


def notes_of(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """What built the network, and its tensors."""
    try:
        with safe_open(path, "pt") as file:
            notes = file.metadata() or {}
            state = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    except OSError:
        raise
    except Exception as error:
        raise FormatError(f"{path}: not a safetensors file: {error}") from None
    return notes, state


def load_into(net: nn.Module, state: dict[str, torch.Tensor], path: Path) -> None:
    """Takes the tensors, which must be the network's own."""
    try:
        net.load_state_dict({k: v.float() if v.dtype == torch.float16 else v for k, v in state.items()})
    except RuntimeError as error:
        raise FormatError(f"{path}: weights of another network: {str(error).splitlines()[-1].strip()}") from None


def load_disparity(path: Path) -> DisparityNet:
    """The network that a weights file was saved from, ready for inference."""
    notes, state = notes_of(path)
    windowed = notes.get("windowed", "True") == "True"
    net = DisparityNet(notes.get("preset", "compact"), int(notes.get("hourglasses", 3)), int(notes.get("groups", 8)), windowed)
    load_into(net, state, path)
    return net.eval()
