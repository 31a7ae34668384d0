"""Kalibr ``camchain.yaml``: a chain of cameras, ``T_cn_cnm1`` from the one before; the first is the world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ...errors import FormatError
from .records import Found, Record

MODELS = {"radtan": False, "equidistant": True, "none": False}
"""Distortion models, and whether each is OpenCV's fisheye."""


def find(path: Path) -> Path | None:
    """A file whose name holds ``camchain``, or the only one in a folder."""
    if path.is_file():
        return path if "camchain" in path.name and path.suffix in (".yaml", ".yml") else None
    files = sorted([*path.glob("*camchain*.yaml"), *path.glob("*camchain*.yml")])
    return files[0] if len(files) == 1 else None


def read(path: Path) -> Found:
    """``cam0``, ``cam1`` ... in this order."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise FormatError(f"{path}{line}: {getattr(error, 'problem', None) or 'not YAML'}") from None
    except UnicodeDecodeError:
        raise FormatError(f"{path}:1: not a text file") from None
    chain = {k: v for k, v in data.items() if str(k).startswith("cam")} if isinstance(data, dict) else {}
    names = [f"cam{n}" for n in range(len(chain))]
    if not chain or set(names) != set(chain):
        raise FormatError(f"{path}: expected cameras cam0, cam1 ..., got {', '.join(map(str, chain)) or 'none'}")
    records, pose = [], np.eye(4)
    for n, name in enumerate(names):
        if n:
            pose = _array(path, name, chain[name], "T_cn_cnm1", (4, 4)) @ pose
        records.append(_record(path, name, chain[name], pose))
    return Found(records, path)


def _array(path: Path, name: str, camera: Any, key: str, shape: tuple[int, ...]) -> np.ndarray:
    value = camera.get(key) if isinstance(camera, dict) else None
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape:
        raise FormatError(f"{path}: {name}: {key}: expected {' x '.join(map(str, shape))} numbers, got {value!r:.80}")
    return array


def _record(path: Path, name: str, camera: Any, pose: np.ndarray) -> Record:
    model, kind = camera.get("camera_model"), camera.get("distortion_model") or "none"
    if model != "pinhole" or kind not in MODELS:
        raise FormatError(f"{path}: {name}: expected a pinhole camera with {', '.join(MODELS)} distortion, got {model} with {kind}")
    fx, fy, cx, cy = _array(path, name, camera, "intrinsics", (4,))
    width, height = _array(path, name, camera, "resolution", (2,))
    distortion = [] if kind == "none" else _array(path, name, camera, "distortion_coeffs", (4,)).tolist()
    return Record(
        K=[[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        R=pose[:3, :3],
        t=pose[:3, 3],
        width=int(width),
        height=int(height),
        name=name,
        distortion=distortion if any(distortion) else (),
        fisheye=MODELS[kind],
    )
