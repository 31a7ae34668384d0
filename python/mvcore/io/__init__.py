"""Reading and writing: camera formats, images, masks, meshes' companions."""

from .clips import Clips, load_video
from .formats.detect import load
from .formats.write import save_calibration

__all__ = ["Clips", "load", "load_video", "save_calibration"]
