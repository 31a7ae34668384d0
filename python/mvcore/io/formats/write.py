"""Writers of calibrations: mvcore cameras.json, COLMAP text, MVSNet. Everything is written beside its place and then renamed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InvalidInputError, require
from ...geometry.cameras import Calibration, Camera
from ...types import Bounds
from ..files import atomically, staged
from ..scene import Scene
from .colmap import rotation_to_quaternion

FORMATS = ("mvcore", "colmap", "mvsnet")


def save_calibration(path: str | Path, scene: Scene, format: str = "mvcore") -> None:
    """Write a scene's cameras.

    Parameters
    ----------
    path : the file of ``mvcore``, the folder of ``colmap`` (cameras.txt, images.txt, points3D.txt) and ``mvsnet`` (cams/, pair.txt).
    """
    require(format in FORMATS, "format", f"one of {', '.join(FORMATS)}", repr(format))
    {"mvcore": _native, "colmap": _colmap, "mvsnet": _mvsnet}[format](Path(path), scene)


def _names(scene: Scene, base: Path) -> list[str]:
    """Image names relative to a folder where they lie below it."""
    names = []
    for n, camera in enumerate(scene.calib):
        frame = scene.frames[n] if n < len(scene.frames) else None
        if isinstance(frame, str | Path):
            names.append(os.path.relpath(frame, base))
        else:
            names.append(camera.name or f"{n:06d}.png")
    return names


def _text(path: Path, text: str) -> None:
    atomically(path, lambda temporary: _write(temporary, text))


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _native(path: Path, scene: Scene) -> None:
    views = []
    for camera, name in zip(scene.calib, _names(scene, path.parent.absolute()), strict=True):
        view: dict[str, Any] = {"image": name, "width": camera.width, "height": camera.height}
        view |= {"K": camera.K.tolist(), "R": camera.R.tolist(), "t": camera.t.tolist()}
        if camera.distortion.size:
            view |= {"dist": camera.distortion.tolist(), "fisheye": camera.fisheye}
        views.append(view)
    data: dict[str, Any] = {"convention": "x ~ K (R X + t); OpenCV axes (x right, y down, z forward); pixel centres at integer coordinates"}
    if scene.bounds is not None:
        data["bounds"] = np.asarray(scene.bounds).tolist()
    _text(path, json.dumps(data | {"views": views}, indent=1) + "\n")


def _colmap_camera(camera: Camera) -> str:
    k, d = camera.K, camera.distortion
    if abs(k[0, 1]) > 1e-6:
        raise InvalidInputError(f"camera {camera.name!r} K: COLMAP has no skew, got {k[0, 1]:g}")
    model = "PINHOLE" if not d.size else "OPENCV_FISHEYE" if camera.fisheye else "OPENCV" if d.size == 4 else "FULL_OPENCV"
    if model == "FULL_OPENCV":
        require(not d[8:].any(), f"camera {camera.name!r} distortion", "at most 8 coefficients for COLMAP", d.size)
        d = np.concatenate([d, np.zeros(8)])[:8]
    values = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *d]
    return f"{model} {camera.width} {camera.height} " + " ".join(repr(float(v)) for v in values)


def _in_folder(path: Path, fill: Callable[[Path], None]) -> None:
    """Fill a temporary folder, then move its files into place."""
    with staged(path / "cameras") as folder:
        fill(folder)
        for file in sorted(p for p in folder.rglob("*") if p.is_file()):
            target = path / file.relative_to(folder)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)


def _colmap(path: Path, scene: Scene) -> None:
    def fill(folder: Path) -> None:
        cameras, images = (
            ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS"],
            ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then points"],
        )
        for n, (camera, name) in enumerate(zip(scene.calib, _short_names(scene), strict=True), 1):
            cameras.append(f"{n} {_colmap_camera(camera)}")
            pose = [*rotation_to_quaternion(camera.R), *camera.t]
            images += [f"{n} {' '.join(repr(float(v)) for v in pose)} {n} {name}", ""]
        _write(folder / "cameras.txt", "\n".join(cameras) + "\n")
        _write(folder / "images.txt", "\n".join(images) + "\n")
        _write(folder / "points3D.txt", "# POINT3D_ID X Y Z R G B ERROR TRACK\n")

    _in_folder(path, fill)


def _short_names(scene: Scene) -> list[str]:
    """Image names from their ``images`` folder on."""
    names = []
    for n, camera in enumerate(scene.calib):
        frame = scene.frames[n] if n < len(scene.frames) else camera.name or f"{n:06d}.png"
        parts = Path(str(frame)).parts if isinstance(frame, str | Path) else (camera.name or f"{n:06d}.png",)
        names.append("/".join(parts[parts.index("images") + 1 :]) if "images" in parts else parts[-1])
    return names


def _mvsnet(path: Path, scene: Scene) -> None:
    for camera in scene.calib:
        require(
            not camera.distortion.size,
            f"camera {camera.name!r}",
            "no distortion (MVSNet files hold none)",
            camera.distortion.tolist(),
        )
    ranges = _depth_ranges(scene.calib, scene.bounds)
    pairs = _pairs(scene.calib)

    def fill(folder: Path) -> None:
        (folder / "cams").mkdir()
        for n, (camera, (near, far)) in enumerate(zip(scene.calib, ranges, strict=True)):
            pose = np.vstack([np.column_stack([camera.R, camera.t]), [0, 0, 0, 1]])
            rows = ["extrinsic", *map(_row, pose), "", "intrinsic", *map(_row, camera.K), ""]
            planes = 192
            rows.append(_row(np.array([near, (far - near) / (planes - 1), planes, far])))
            _write(folder / "cams" / f"{n:08d}_cam.txt", "\n".join(rows) + "\n")
        lines = [str(len(pairs))]
        for n, row in enumerate(pairs):
            lines += [str(n), f"{len(row)} " + " ".join(f"{j} {s:.6g}" for j, s in row)]
        _write(folder / "pair.txt", "\n".join(lines) + "\n")

    _in_folder(path, fill)


def _row(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _depth_ranges(calib: Calibration, bounds: Bounds | None) -> list[tuple[float, float]]:
    """z-depths of the bounds, or from a fifth to three times the distance to the point nearest to all axes."""
    ranges = []
    for camera in calib:
        if bounds is not None:
            corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
            z = camera.to_camera(corners)[:, 2]
            ranges.append((max(float(z.min()), 1e-3 * float(z.max())), float(z.max())))
        else:
            away = float(np.median([np.linalg.norm(camera.center - c.center) for c in calib if c is not camera])) or 1.0
            ranges.append((0.2 * away, 10 * away))
    return ranges


def _pairs(calib: Sequence[Camera], count: int = 10) -> list[list[tuple[int, float]]]:
    """The views that look most alike, scored by the angle between their axes."""
    axes = np.array([c.axis for c in calib])
    angles = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    np.fill_diagonal(angles, np.inf)
    order = np.argsort(angles, axis=1, kind="stable")[:, : min(count, len(axes) - 1)]
    return [[(int(j), float(1000 * np.exp(-angles[n, j] / 20))) for j in row] for n, row in enumerate(order)]
