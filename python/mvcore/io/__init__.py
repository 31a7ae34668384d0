"""Reading and writing: camera formats, images, masks, meshes' companions."""

from .detect import load
from .write import save_calibration

__all__ = ["load", "save_calibration"]
