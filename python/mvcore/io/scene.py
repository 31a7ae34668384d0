"""What a folder of calibrated images holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..geometry.cameras import Calibration
from ..types import Bounds, Frame


@dataclass(frozen=True)
class Scene:
    """What `mvcore.load` finds: frames with their cameras, and masks and bounds where the set has them.

    ``masks[i]`` is the path of frame i's mask (or None); ``bounds`` is (2, 3) float64 or None.
    """

    frames: Sequence[Frame]
    calib: Calibration
    masks: Sequence[Frame | None] | None = None
    bounds: Bounds | None = None
    format: str = ""

    def __len__(self) -> int:
        return len(self.calib)
