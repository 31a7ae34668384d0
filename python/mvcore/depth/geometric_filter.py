"""Depth that other views agree with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import DepthConfig
from ..geometry.cameras import Camera, relative_map
from ..types import DepthMap


def filter_depth(
    index: int, depths: Sequence[DepthMap], cameras: Sequence[Camera], others: Sequence[int], config: DepthConfig | None = None
) -> tuple[DepthMap, NDArray[np.uint8]]:
    """Depth of view ``index`` that other views agree with, and by how many: the dynamic rule of D2HC-RMVSNet."""
    config = config or DepthConfig()
    mine, camera = depths[index], cameras[index]
    others = list(others)[:32]
    there = np.array([relative_map(camera, cameras[j]) for j in others], np.float32).reshape(-1, 12)
    back = np.array([relative_map(cameras[j], camera) for j in others], np.float32).reshape(-1, 12)
    kept, support = _core.consistency(
        mine.depth,
        [depths[j].depth for j in others],
        there,
        back,
        min(config.min_views, max(1, len(others))),
        config.pixel_unit,
        config.depth_unit,
    )
    return DepthMap(kept, np.where(kept > 0, mine.confidence, 0).astype(np.float32)), support
