"""Kalibr ``camchain.yaml`` (or another name): a chain of cameras, ``T_cn_cnm1`` from the one before; the first is the world.

OpenVINS' ``kalibr_imucam_chain.yaml`` has no chain but each camera's ``T_imu_cam`` (camera to IMU): there the IMU is the world.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FormatError, InvalidInputError
from ..limits import MOST_SIDE
from .filestorage import read_yaml
from .poses import from_camera_to_world
from .records import Found, Record
from .values import files_in

MODELS = {"radtan": False, "equidistant": True, "none": False}
"""Distortion models, and whether each is OpenCV's fisheye: ``equidistant`` is, whatever its coefficients."""
SUFFIXES = (".yaml", ".yml")
LOOK = 4096
"""Bytes in which a file shows whether it is a chain."""


def find(path: Path) -> Path | None:
    """A file whose name holds ``camchain``, or the only one in a folder; else one whose content is a chain of cameras."""
    if path.is_file():
        return path if path.suffix.lower() in SUFFIXES and ("camchain" in path.name.lower() or _is_chain(path)) else None
    files = files_in(path, *SUFFIXES)
    named = [f for f in files if "camchain" in f.name.lower()]
    chains = named or [f for f in files if _is_chain(f)]
    return chains[0] if len(chains) == 1 else None


def _is_chain(path: Path) -> bool:
    """Whether a file looks like a chain: its first camera's name starts a line, and its camera model is named."""
    with path.open("rb") as file:
        start = file.read(LOOK)
    return b"camera_model:" in start and (start.startswith(b"cam0:") or b"\ncam0:" in start)


def read(path: Path) -> Found:
    """``cam0``, ``cam1`` ... in this order."""
    documents = read_yaml(path)
    data = documents[0] if len(documents) == 1 else None
    chain = {k: v for k, v in data.items() if k.startswith("cam")} if isinstance(data, dict) else {}
    names = [f"cam{n}" for n in range(len(chain))]
    if not chain or set(names) != set(chain):
        got = ", ".join(chain) or "none"
        raise FormatError(f"{path}: expected cameras cam0, cam1 ..., got {got:.80}")
    poses = _poses(path, names, chain)
    return Found([_record(path, name, chain[name], pose) for name, pose in zip(names, poses, strict=True)], path)


def _poses(path: Path, names: list[str], chain: dict[str, Any]) -> list[np.ndarray]:
    """World to camera: the first camera is the world, or the IMU where the file has no chain but ``T_cam_imu`` or ``T_imu_cam``."""
    for key in ("T_cam_imu", "T_imu_cam"):
        if all(isinstance(c, dict) and c.get(key) is not None for c in chain.values()) and not any(
            "T_cn_cnm1" in c for c in chain.values()
        ):
            poses = [_array(path, n, chain[n], key, (4, 4)) for n in names]
            return poses if key == "T_cam_imu" else [_inverse(path, n, p) for n, p in zip(names, poses, strict=True)]
    out = [np.eye(4)]
    for name in names[1:]:
        out.append(_array(path, name, chain[name], "T_cn_cnm1", (4, 4)) @ out[-1])
    return out


def _inverse(path: Path, name: str, pose: np.ndarray) -> np.ndarray:
    try:
        r, t = from_camera_to_world(pose)
    except InvalidInputError as error:
        raise FormatError(f"{path}: {name}: T_imu_cam: {error}") from None
    return np.vstack([np.column_stack([r, t]), [0, 0, 0, 1]])


def _array(path: Path, name: str, camera: Any, key: str, shape: tuple[int, ...]) -> np.ndarray:
    value = camera.get(key) if isinstance(camera, dict) else None
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise FormatError(f"{path}: {name}: {key}: expected {' x '.join(map(str, shape))} finite numbers, got {value!r:.80}")
    return array


def _record(path: Path, name: str, camera: Any, pose: np.ndarray) -> Record:
    if not isinstance(camera, dict):
        raise FormatError(f"{path}: {name}: expected a camera's names and values, got {camera!r:.80}")
    model, kind = camera.get("camera_model"), camera.get("distortion_model") or "none"
    if model != "pinhole" or not isinstance(kind, str) or kind not in MODELS:
        raise FormatError(
            f"{path}: {name}: expected a pinhole camera with {', '.join(MODELS)} distortion, got {model!r:.40} with {kind!r:.40}"
        )
    fx, fy, cx, cy = _array(path, name, camera, "intrinsics", (4,))
    width, height = _array(path, name, camera, "resolution", (2,))
    if not (min(width, height) >= 1 and max(width, height) <= MOST_SIDE):
        raise FormatError(f"{path}: {name}: resolution: expected 1 to {MOST_SIDE} pixels a side, got {width:g} x {height:g}")
    distortion = [] if kind == "none" else _array(path, name, camera, "distortion_coeffs", (4,)).tolist()
    return Record(
        K=[[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        R=pose[:3, :3],
        t=pose[:3, 3],
        width=int(width),
        height=int(height),
        name=name,
        distortion=distortion if any(distortion) or MODELS[kind] else (),
        fisheye=MODELS[kind],
    )
