"""What a folder of calibrated images holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.cameras import Calibration
from ..geometry.projections import MIRROR
from ..types import Bounds, Frame


@dataclass(frozen=True)
class Scene:
    """What `mvcore.load` finds: frames with their cameras, and masks and bounds where the set has them.

    frames : paths or images; after ``load(path, images=False)`` None where there is no file.
    masks : the path of each frame's mask, None for a frame without; ``alpha`` says that they are the images' own alpha channels.
    bounds : (2, 3) float64 or None.
    format : what the calibration was read as.
    warnings : what was assumed, scaled, or left out.

    The cameras of a left-handed world (``mirrored``) are those of its reflection in z: X_caller = mirror X. Everything else, such as
    ``bounds`` and what `reconstruct` returns, is in the caller's world.
    """

    frames: Sequence[Frame]
    calib: Calibration
    masks: Sequence[Frame | None] | None = None
    bounds: Bounds | None = None
    format: str = ""
    warnings: tuple[str, ...] = ()
    alpha: bool = False

    def __len__(self) -> int:
        return len(self.calib)

    @property
    def mirrored(self) -> bool:
        """Whether the caller's world is left-handed."""
        return self.calib.mirrored

    @property
    def mirror(self) -> NDArray[np.float64] | None:
        """X_caller = mirror X, (4, 4), its own inverse; None where the world is not mirrored."""
        return MIRROR.copy() if self.mirrored else None

    def subset(self, numbers: Sequence[int]) -> Scene:
        """The scene of some views, in the order of the numbers."""
        calib = replace(self.calib, cameras=tuple(self.calib[n] for n in numbers))
        masks = None if self.masks is None else tuple(self.masks[n] for n in numbers)
        return replace(self, frames=tuple(self.frames[n] for n in numbers), calib=calib, masks=masks)
