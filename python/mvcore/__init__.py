"""Calibrated multi-view images in, a textured 3D mesh out.

scene = mvcore.load("fountain/")
result = mvcore.reconstruct(scene.frames, scene.calib)
result.save("fountain.glb")
"""

from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

from .config import Config
from .errors import FormatError, InvalidInputError, MvcoreError, ReconstructionError
from .geometry.cameras import Calibration, Camera
from .types import DepthMap, SparsePoints

if TYPE_CHECKING:
    from . import nurbs
    from .depth import disparity
    from .evaluation import metrics
    from .io import load, load_video, save_calibration
    from .io.scene import Scene
    from .pipeline.preflight import check
    from .pipeline.reconstruct import reconstruct
    from .pipeline.result import Reconstruction
    from .video.api import reconstruct_video
    from .volume import carving as carve

__version__ = _version("mvcore")

_LATER = {
    "check": "pipeline.preflight",
    "disparity": "depth",
    "load": "io",
    "load_video": "io",
    "save_calibration": "io",
    "reconstruct": "pipeline.reconstruct",
    "reconstruct_video": "video.api",
    "Reconstruction": "pipeline.result",
    "Scene": "io.scene",
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
    "carve",
    "check",
    "disparity",
    "load",
    "load_video",
    "metrics",
    "nurbs",
    "reconstruct",
    "reconstruct_video",
    "save_calibration",
]


_MODULES = {"carve": "volume.carving", "metrics": "evaluation.metrics", "nurbs": "nurbs"}
"""Modules under the names by which users know them."""


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name in _LATER:
        return getattr(import_module(f".{_LATER[name]}", __name__), name)
    if name in _MODULES:
        return import_module(f".{_MODULES[name]}", __name__)
    raise AttributeError(f"module 'mvcore' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
