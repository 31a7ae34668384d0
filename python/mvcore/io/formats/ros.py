"""ROS ``camera_info`` files of a rectified rig: ``left.yaml`` and ``right.yaml`` as camera_calibration writes them, or sensor_msgs fields.

``camera_matrix`` (K), ``distortion_coefficients`` (D), ``rectification_matrix`` (R) and ``projection_matrix`` (P): a point of the rig's
rectified frame X has X_rectified = X + K'^-1 P[:, 3] in a camera, K' = P[:, :3], and R turns the camera's own axes into the rectified
ones; so world (the rectified frame) to camera is R^T and R^T K'^-1 P[:, 3]. OpenCV axes, pixel centres at integers, metres. Models:
plumb_bob and rational_polynomial (OpenCV's), equidistant (OpenCV's fisheye).

Source: sensor_msgs/CameraInfo.msg; REP 104; camera_calibration_parsers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...geometry.cameras import rotation_from
from .filestorage import read_yaml
from .records import Found, Record
from .values import Entry, files_in, head

MODELS = {"plumb_bob": False, "rational_polynomial": False, "equidistant": True, "fisheye": True, "none": False, "": False}
"""Distortion models, and whether each is OpenCV's fisheye."""
SUFFIXES = (".yaml", ".yml")


def find(path: Path) -> Path | None:
    """The folder that holds the files; a file stands for its folder."""
    if path.is_file():
        return path.parent if _is_info(path) else None
    return path if any(_is_info(f) for f in files_in(path, *SUFFIXES)) else None


def _is_info(path: Path) -> bool:
    start = head(path)
    named = "projection_matrix:" in start or "\nP:" in start or "\np:" in start
    return path.suffix.lower() in SUFFIXES and "distortion_model:" in start and named


def read(path: Path) -> Found:
    """The cameras by their files' names."""
    files = [f for f in files_in(path, *SUFFIXES) if _is_info(f)]
    if len(files) < 2:
        raise Entry(None, files[0]).fail("expected the camera_info of two or more cameras, got one file")
    cameras = [(f, Entry(d, f)) for f in files for d in read_yaml(f) if d is not None]
    return Found([_record(f, c) for f, c in cameras], path)


def _record(path: Path, info: Entry) -> Record:
    kind = info.get("distortion_model")
    model = "" if kind is None else kind.text()
    if model not in MODELS:
        raise info.fail(f"the distortion model {model!r} cannot be read; {', '.join(m for m in MODELS if m)} can")
    p = _matrix(info, "projection_matrix", "P", "p").array(3, 4)
    turn = info.get("rectification_matrix", "R", "r")
    lens = info.get("distortion_coefficients", "D", "d")
    values = [] if lens is None else (lens.get("data") or Entry([], path) if isinstance(lens.value, dict) else lens).numbers()
    if len(values) not in ((0, 4) if MODELS[model] else (0, 4, 5, 8, 12, 14)):
        raise info.fail(f"distortion_coefficients: {len(values)} numbers do not fit the model {model!r}")
    try:
        r = np.eye(3) if turn is None else rotation_from(_matrix(info, "rectification_matrix", "R", "r").array(3, 3)).T
        t = r @ np.linalg.solve(p[:, :3], p[:, 3])
    except np.linalg.LinAlgError as error:
        raise info.fail(f"rectification_matrix and projection_matrix: {error}") from None
    name = info.get("camera_name")
    fisheye = MODELS[model]
    return Record(
        K=_matrix(info, "camera_matrix", "K", "k").array(3, 3),
        R=r,
        t=t,
        width=info.need("image_width", "width").pixels(),
        height=info.need("image_height", "height").pixels(),
        name=path.stem if name is None else name.text(),
        distortion=(values or [0.0] * 4) if fisheye else values if any(values) else (),
        fisheye=fisheye,
    )


def _matrix(info: Entry, *names: str) -> Entry:
    entry = info.need(*names)
    return entry.need("data") if isinstance(entry.value, dict) else entry
