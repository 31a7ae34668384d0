"""Depth and disparity maps: PFM, 16-bit PNG with a stated scale, NPZ."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, require
from .files import atomically
from .limits import MOST_ARRAYS, read_bytes

Map = NDArray[np.float32]


def write_pfm(path: str | Path, values: Map) -> None:
    """One-channel PFM: rows bottom-up, little-endian. ``values`` (h, w) float32."""
    values = np.asarray(values, np.float32)
    require(values.ndim == 2, "values", "shape (h, w)", values.shape)
    header = f"Pf\n{values.shape[1]} {values.shape[0]}\n-1.0\n".encode()
    atomically(Path(path), lambda p: p.write_bytes(header + np.ascontiguousarray(values[::-1], "<f4").tobytes()) and None)


def read_pfm(path: str | Path) -> Map:
    """(h, w) float32 of a one-channel PFM."""
    path = Path(path)
    parts = read_bytes(path, MOST_ARRAYS).split(b"\n", 3)
    try:
        kind, size, scale, data = parts
        width, height = map(int, size.split())
        order = "<f4" if float(scale) < 0 else ">f4"
    except ValueError:
        raise FormatError(f"{path}:1: not a PFM file") from None
    if kind.strip() != b"Pf" or min(width, height) < 1 or len(data) < 4 * width * height:
        raise FormatError(f"{path}:1: not a complete one-channel PFM file")
    return np.frombuffer(data, order, width * height).reshape(height, width)[::-1].astype(np.float32)


def write_depth_png(path: str | Path, depth: Map) -> float:
    """16-bit PNG, 0 = none; returns the scale: depth = value * scale (also written beside it as ``name.scale.txt``)."""
    scale = float(depth.max(initial=0)) / 65535 or 1.0
    values = np.rint(depth / scale).astype(np.uint16)
    ok, data = cv2.imencode(".png", values)
    require(ok, "depth", "an array that PNG can hold", depth.shape)
    path = Path(path)
    atomically(path, lambda p: p.write_bytes(data.tobytes()) and None)
    atomically(path.with_suffix(".scale.txt"), lambda p: p.write_text(f"{scale!r}\n") and None)
    return scale


def colourise(values: Map) -> NDArray[np.uint8]:
    """A map as a picture, (h, w, 3) uint8 RGB: near is warm, 0 (none) is black."""
    known = values > 0
    if not known.any():
        return np.zeros((*values.shape, 3), np.uint8)
    inverse = np.where(known, 1 / np.maximum(values, 1e-12), 0)
    low, high = np.quantile(inverse[known], [0.02, 0.98])
    level = np.clip((inverse - low) / max(high - low, 1e-12) * 255, 0, 255).astype(np.uint8)
    picture = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    picture[~known] = 0
    return picture
