"""Which format a path holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ...errors import FormatError
from ..scene import Scene
from . import (
    colmap,
    easymocap,
    idr,
    kalibr,
    middlebury,
    mvsnet,
    native,
    nerf,
    opencv,
    qualisys,
    strecha,
)
from .records import Found, to_scene

READERS: tuple[tuple[str, Callable[[Path], Path | None], Callable[[Path], Found]], ...] = (
    ("mvcore cameras.json", native.find, native.read),
    ("NeRF transforms.json", nerf.find, nerf.read),
    ("COLMAP", colmap.find, colmap.read),
    ("MVSNet / DTU cam.txt", mvsnet.find, mvsnet.read),
    ("IDR / NeuS npz", idr.find, idr.read),
    ("Middlebury par.txt", middlebury.find, middlebury.read),
    ("Strecha .camera", strecha.find, strecha.read),
    ("Qualisys .qca.txt", qualisys.find, qualisys.read),
    ("EasyMocap intri.yml and extri.yml", easymocap.find, easymocap.read),
    ("Kalibr camchain.yaml", kalibr.find, kalibr.read),
    ("OpenCV FileStorage", opencv.find, opencv.read),
)
"""Name, finder (the path that the reader takes, or None) and reader of each format, the surest first."""


def load(path: str | Path, *, images: bool | str | Path = True, allow_outside: bool = False) -> Scene:
    """Read a scene; the format is found by itself.

    Parameters
    ----------
    path : a folder, or a calibration file in it.
    images : False reads the cameras alone; image files may then be missing. A folder is where the images lie, if the
        calibration does not say or is wrong.
    allow_outside : follow paths in the calibration that lead out of the data set's folder; they are refused otherwise.

    Returns
    -------
    Scene
        Frames are paths, in the order of the file (COLMAP: by name). Poses are world-to-camera, pixel centres at integers.

    Raises
    ------
    FileNotFoundError
        The path does not exist.
    FormatError
        No known format, or a malformed file: the message names path and line.
    """
    path = Path(path).absolute()
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    for name, find, read in READERS:
        if (at := find(path)) is not None:
            found = read(at)
            folder = None if isinstance(images, bool) else Path(images).absolute()
            named = replace(found, format=name)
            return to_scene(named, images is not False, images=folder, allow_outside=allow_outside, given=path)
    known = ", ".join(name for name, _, _ in READERS)
    raise FormatError(f"{path}: no calibration found; known formats: {known}")
