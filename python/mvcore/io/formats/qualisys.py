"""Qualisys ``.qca.txt``: XML with a camera's transform (axes of its sensor, centre in millimetres) and intrinsics in 64ths of a pixel.

The sensor's y and z axes point against OpenCV's. Units stay millimetres. Distortion coefficients are stored times 64, as Pose2Sim reads
them.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ...errors import FormatError
from ..limits import MOST_SIDE
from .filestorage import read_xml
from .records import Found, Record
from .values import files_in

SUBPIXELS = 64.0
MOST = 1e12
"""A number in the file, in whatever unit."""


def find(path: Path) -> Path | None:
    """A ``.qca.txt`` file, or the only one in a folder or in its ``calibration`` folder."""
    if path.is_file():
        return path if path.name.lower().endswith(".qca.txt") else None
    files = [f for folder in (path, path / "calibration") for f in files_in(folder, ".txt") if f.name.lower().endswith(".qca.txt")]
    return files[0] if len(files) == 1 else None


def read(path: Path) -> Found:
    """The cameras in the order of the file."""
    root = read_xml(path)
    cameras = [c for c in root.iter("camera") if c.find("intrinsic") is not None]
    return Found([_record(path, n, c) for n, c in enumerate(cameras)], path)


def _record(path: Path, number: int, camera: ElementTree.Element) -> Record:
    name = camera.get("serial") or f"camera {number}"

    def value(part: str, key: str, default: float | None = None) -> float:
        element = camera.find(part)
        text = None if element is None else element.get(key)
        if text is None and default is not None:
            return default
        try:
            number = float(text)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            number = math.nan
        if not abs(number) <= MOST:
            raise FormatError(f"{path}: camera {name:.80}: {part} {key}: expected a number, got {text!r:.80}")
        return number

    left, top = value("fov_video", "left"), value("fov_video", "top")
    width, height = value("fov_video", "right") - left + 1, value("fov_video", "bottom") - top + 1
    if not (1 <= round(width) <= MOST_SIDE and 1 <= round(height) <= MOST_SIDE):
        raise FormatError(f"{path}: camera {name:.80}: fov_video: expected 1 to {MOST_SIDE} pixels a side, got {width:g} x {height:g}")
    focal = [value("intrinsic", f"focalLength{a}") / SUBPIXELS for a in "UV"]
    center = [value("intrinsic", f"centerPoint{a}") / SUBPIXELS - o for a, o in (("U", left), ("V", top))]
    skew = value("intrinsic", "skew", 0.0) / SUBPIXELS
    k = [[focal[0], skew, center[0]], [0, focal[1], center[1]], [0, 0, 1]]
    sensor = np.array([[value("transform", f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)])
    rotation = np.diag([1.0, -1.0, -1.0]) @ sensor
    position = np.array([value("transform", a) for a in "xyz"])
    radial = [value("intrinsic", f"radialDistortion{n}", 0.0) / SUBPIXELS for n in (1, 2, 3)]
    # "tangental" is the file's own spelling.
    tangential = [value("intrinsic", f"tangentalDistortion{n}", 0.0) / SUBPIXELS for n in (1, 2)]
    distortion = [*radial[:2], *tangential, *radial[2:]]
    return Record(
        K=k,
        R=rotation,
        t=-rotation @ position,
        width=round(width),
        height=round(height),
        name=name,
        distortion=(distortion if distortion[4] else distortion[:4]) if any(distortion) else (),
    )
