"""Polycam's raw export: one JSON a keyframe in ``keyframes/cameras`` (or ``corrected_cameras``), images beside them.

``t_00 .. t_23`` are the rows of the 3 x 4 camera-to-world matrix, camera axes x right, y up, z back (ARKit), metres. fx fy cx cy are in
pixels with the origin at the image's top-left corner, so pixel centres are at halves.

Sources: nerfstudio's polycam_utils.py (which permutes the world's axes; here they stay); Apple's ARCamera.intrinsics and
AVCameraCalibrationData.intrinsicMatrix ("relative to the top-left corner of the top-left pixel").
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InvalidInputError
from ..pairing import natural_order
from .poses import OPENGL, from_camera_to_world
from .records import Found, Record
from .values import files_in, head, read_json

FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
"""Cameras and images; the corrected ones are those that Polycam has adjusted."""


def find(path: Path) -> Path | None:
    """The folder of the cameras: at the path, below ``keyframes``, or around a camera's file."""
    if path.is_file():
        if '"t_00"' not in head(path) and path.name != "mesh_info.json":
            return None
        path = path.parent
    for folder in (path, path / "keyframes"):
        for name, _ in FOLDERS:
            for place in (folder / name, folder):
                if place.name == name and any('"t_00"' in head(f) for f in files_in(place, ".json")[:1]):
                    return place
    return None


def read(path: Path) -> Found:
    """The keyframes in natural order."""
    files = sorted(files_in(path, ".json"), key=natural_order)
    return Found([_record(f, Path(dict(FOLDERS)[path.name]) / f.stem) for f in files], path.parent)


def _record(path: Path, image: Path) -> Record:
    frame = read_json(path)
    fx, fy, cx, cy = (frame.need(n).number() for n in ("fx", "fy", "cx", "cy"))
    pose = np.array([[frame.need(f"t_{i}{j}").number() for j in range(4)] for i in range(3)])
    try:
        r, t = from_camera_to_world(pose, OPENGL)
    except InvalidInputError as error:
        raise frame.fail(f"t_00 .. t_22: {error}") from None
    k = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    return Record(k, r, t, frame.need("width").pixels(), frame.need("height").pixels(), image, name=image.name)
