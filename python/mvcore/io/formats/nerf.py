"""NeRF / nerfstudio ``transforms.json``: camera-to-world, OpenGL axes, corner origin; per-frame values override common ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FormatError
from .native import parse_json
from .records import IMAGE_SUFFIXES, Found, Record, image_size

NAMES = ("transforms.json", "transforms_train.json")


def find(path: Path) -> Path | None:
    """The file, if the path is one or holds one."""
    if path.is_file():
        return path if path.name.startswith("transforms") and path.suffix == ".json" else None
    return next((path / n for n in NAMES if (path / n).is_file()), None)


def read(path: Path) -> Found:
    """The views of a transforms file.

    Raises
    ------
    FormatError
        Also where a frame names a file outside the folder of ``transforms.json``.
    """
    data = parse_json(path)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list):
        raise FormatError(f"{path}: expected an object with a list 'frames'")
    return Found([_frame(path, n, {**data, **f}) for n, f in enumerate(frames)], path)


def _frame(path: Path, n: int, frame: dict[str, Any]) -> Record:
    where = f"{path}: frames[{n}]"
    image = _inside(path.parent, where, frame.get("file_path"))
    mask = _inside(path.parent, where, frame["mask_path"]) if frame.get("mask_path") else None
    pose = np.asarray(frame.get("transform_matrix"), np.float64)
    if pose.shape not in ((4, 4), (3, 4)):
        raise FormatError(f"{where}: transform_matrix: expected 4 x 4 numbers")
    rotation = (pose[:3, :3] * [1, -1, -1]).T
    width, height = int(frame.get("w", 0)), int(frame.get("h", 0))
    if not width and image.is_file():
        width, height = image_size(image)
    if not width:
        raise FormatError(f"{where}: no size (w, h) and no image {image.name}")
    fx = frame.get("fl_x")
    if fx is None and frame.get("camera_angle_x"):
        fx = 0.5 * width / np.tan(0.5 * float(frame["camera_angle_x"]))
    if fx is None:
        raise FormatError(f"{where}: neither fl_x nor camera_angle_x")
    fy = frame.get("fl_y", fx)
    cx, cy = frame.get("cx", width / 2), frame.get("cy", height / 2)
    fisheye = str(frame.get("camera_model", "")).upper().endswith("FISHEYE")
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortion = [float(frame.get(k, 0.0)) for k in keys]
    return Record(
        K=[[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]],
        R=rotation,
        t=-rotation @ pose[:3, 3],
        width=width,
        height=height,
        image=image,
        mask=mask,
        name=str(frame["file_path"]),
        distortion=distortion if any(distortion) else (),
        fisheye=fisheye and any(distortion),
    )


def _inside(folder: Path, where: str, name: Any) -> Path:
    if not isinstance(name, str) or not name:
        raise FormatError(f"{where}: file_path missing")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(f"{where}: {name!r} lies outside {folder}")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return path
    return next((p for s in IMAGE_SUFFIXES if (p := path.with_name(path.name + s)).is_file()), path.with_name(path.name + ".png"))
