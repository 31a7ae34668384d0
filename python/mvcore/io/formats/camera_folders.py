"""Where a camera's single image lies when its calibration names cameras and no files."""

from __future__ import annotations

from pathlib import Path

from ..media import frame_files
from .records import image_in


def plain_name(name: str) -> bool:
    """Whether a camera's name can be a file's or folder's name in a folder, and leads nowhere else."""
    return bool(name) and name not in (".", "..") and not any(c in name for c in "/\\\0")


def camera_image(folder: Path, name: str) -> Path | None:
    """The image of a camera beside its calibration.

    Tried: ``NAME.png`` (any image suffix) in ``folder``, its ``images`` or ``image`` folder, then the only image in ``images/NAME``,
    ``NAME`` or ``NAME/data``. None where there is no image, where a folder holds several (a clip), and for names that are no file names.
    """
    if not plain_name(name):
        return None
    if (image := image_in(folder, name)) is not None:
        return image
    for place in (folder / "images" / name, folder / name, folder / name / "data"):
        files = frame_files(place) if place.is_dir() else []
        if files:
            return files[0] if len(files) == 1 else None
    return None
