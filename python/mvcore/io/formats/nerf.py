"""NeRF, instant-ngp and nerfstudio ``transforms.json``: camera-to-world, OpenGL axes, corner origin.

Values of a frame override common ones. ``camera_model`` names the projection (nerfstudio), or ``is_fisheye`` does
(instant-ngp); without either, distortion is OpenCV's k1 k2 p1 p2 k3 with nerfstudio's k4, a factor of r⁸.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FormatError
from ..limits import read_json
from .lens import brown, corner_radius, polynomial
from .native import numbers, path_in, pixels
from .places import named
from .records import Found, Record
from .values import files_in

NAMES = ("transforms.json", "transforms_train.json")
PERSPECTIVE = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def find(path: Path) -> Path | None:
    """The file, if the path is one or holds one; of other names (``transforms_test.json``) the only one."""
    if path.is_file():
        return path if path.name.lower().startswith("transforms") and path.suffix.lower() == ".json" else None
    others = [f for f in files_in(path, ".json") if f.name.lower().startswith("transforms")]
    return named(path, *NAMES) or (others[0] if len(others) == 1 else None)


def read(path: Path) -> Found:
    """The views of a transforms file."""
    data = read_json(path)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list):
        raise FormatError(f"{path}: expected an object with a list 'frames'")
    records = []
    for n, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise FormatError(f"{path}: frames[{n}]: expected an object, got {frame!r:.40}")
        records.append(_frame(path, f"{path}: frames[{n}]", {**data, **frame}))
    return Found(records, path)


def _frame(path: Path, where: str, frame: dict[str, Any]) -> Record:
    image = path_in(f"{where}: file_path", frame.get("file_path"))
    if image is None:
        raise FormatError(f"{where}: file_path missing")
    pose = numbers(f"{where}: transform_matrix", frame.get("transform_matrix"), (4, 4), (3, 4))
    rotation = (pose[:3, :3] * [1, -1, -1]).T
    width, height = pixels(f"{where}: w", frame.get("w")), pixels(f"{where}: h", frame.get("h"))
    distortion, fisheye = _lens(where, frame)
    return Record(
        K=lambda width, height: _matrix(where, frame, width, height),
        R=rotation,
        t=-rotation @ pose[:3, 3],  # the centre stays, also where R is rounded (`Camera`)
        width=width if height else 0,
        height=height if width else 0,
        image=image,
        mask=path_in(f"{where}: mask_path", frame.get("mask_path")),
        name=str(image),
        distortion=distortion,
        fisheye=fisheye,
    )


def _number(where: str, frame: dict[str, Any], key: str, default: float | None = None) -> float | None:
    value = frame.get(key)
    return default if value is None else float(numbers(f"{where}: {key}", value, ()))


def _matrix(where: str, frame: dict[str, Any], width: int, height: int) -> list[list[float]]:
    fx, fy = _number(where, frame, "fl_x"), _number(where, frame, "fl_y")
    if fx is None and fy is None:
        fx, fy = (_focal(_angle(where, frame, a), side) for a, side in (("x", width), ("y", height)))
    if fx is None and fy is None:
        raise FormatError(f"{where}: neither fl_x nor camera_angle_x (an angle of 0 to pi)")
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    cx, cy = _number(where, frame, "cx", width / 2), _number(where, frame, "cy", height / 2)
    return [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]  # type: ignore[operator, list-item]


def _angle(where: str, frame: dict[str, Any], axis: str) -> float | None:
    """The field of view in radians; instant-ngp also takes degrees."""
    degrees = _number(where, frame, f"{axis}_fov")
    return _number(where, frame, f"camera_angle_{axis}", None if degrees is None else float(np.radians(degrees)))


def _focal(angle: float | None, side: int) -> float | None:
    return 0.5 * side / float(np.tan(0.5 * angle)) if angle is not None and 0 < angle < np.pi else None


def _lens(where: str, frame: dict[str, Any]) -> tuple[list[float] | Callable[[int, int], list[float]], bool]:
    """OpenCV's coefficients, and whether they are the fisheye model's."""
    model = str(frame.get("camera_model") or "").upper()
    if model and model not in (*PERSPECTIVE, *FISHEYE):
        known = ", ".join((*PERSPECTIVE, *FISHEYE))
        raise FormatError(f"{where}: camera_model {model!r:.40} is not supported; expected one of {known}")
    flag = frame.get("is_fisheye") or frame.get("fisheye_model")
    fisheye = model in FISHEYE or flag is True or flag == 1  # instant-ngp's flag
    k1, k2, k3, k4, k5, k6 = (_number(where, frame, f"k{n}", 0.0) or 0.0 for n in range(1, 7))
    p1, p2 = (_number(where, frame, f"p{n}", 0.0) or 0.0 for n in (1, 2))
    if fisheye:
        if p1 or p2:
            raise FormatError(f"{where}: p1, p2: expected 0 for a fisheye, got {p1:g}, {p2:g}")
        return [k1, k2, k3, k4], True
    if model == "FULL_OPENCV":
        return [k1, k2, p1, p2, k3, k4, k5, k6], False
    if not k4:
        return brown(k1, k2, p1, p2, k3), False
    return lambda width, height: _four_terms(where, frame, width, height, [k1, k2, k3, k4], p1, p2), False


def _four_terms(where: str, frame: dict[str, Any], width: int, height: int, radial: list[float], p1: float, p2: float) -> list[float]:
    """nerfstudio's 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸ as OpenCV's rational model."""
    matrix = np.array(_matrix(where, frame, width, height))
    values = polynomial(radial, p1, p2, float(matrix[0, 0]), corner_radius(matrix, width, height))
    if values is None:
        text = ", ".join(f"{v:g}" for v in radial)
        raise FormatError(f"{where}: k1 .. k4: expected a distortion that does not turn back in the image, got {text}; is it a fisheye?")
    return values
