"""Calibrated multi-view images in, a textured 3D mesh out.

scene = mvcore.load("fountain/")
result = mvcore.reconstruct(scene.frames, scene.calib)
result.save("fountain.glb")
"""

from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

from .cameras import Calibration, Camera
from .config import Config
from .errors import FormatError, InvalidInputError, MvcoreError, ReconstructionError
from .types import DepthMap, Scene, SparsePoints

if TYPE_CHECKING:
    from .depth import disparity
    from .io import load, load_video, save_calibration
    from .pipeline import reconstruct
    from .result import Reconstruction
    from .video import reconstruct_video

__version__ = _version("mvcore")

_LATER = {
    "disparity": "depth",
    "load": "io",
    "load_video": "io",
    "save_calibration": "io",
    "reconstruct": "pipeline",
    "reconstruct_video": "video",
    "Reconstruction": "result",
}
"""Names that bring OpenCV with them: imported when they are first used."""

__all__ = [
    "Calibration",
    "Camera",
    "Config",
    "DepthMap",
    "FormatError",
    "InvalidInputError",
    "MvcoreError",
    "Reconstruction",
    "ReconstructionError",
    "Scene",
    "SparsePoints",
    "disparity",
    "load",
    "load_video",
    "reconstruct",
    "reconstruct_video",
    "save_calibration",
]


def __getattr__(name: str) -> Any:
    if name in _LATER:
        from importlib import import_module

        return getattr(import_module(f".{_LATER[name]}", __name__), name)
    raise AttributeError(f"module 'mvcore' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
