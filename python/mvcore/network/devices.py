"""Where the network can run."""

from __future__ import annotations

import torch


def cuda_available() -> bool:
    """Whether torch finds a CUDA device."""
    return torch.cuda.is_available()
