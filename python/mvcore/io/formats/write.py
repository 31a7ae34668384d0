"""Writers of calibrations: mvcore cameras.json, COLMAP text, nerfstudio, MVSNet, with sparse points where they are at hand.

Everything is written beside its place and then renamed.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InvalidInputError, MvcoreError, require
from ...geometry.cameras import Calibration, Camera
from ...geometry.projections import MIRROR
from ...geometry.rig import convergence
from ...types import Bounds, Frame, SparsePoints
from ..files import atomically, staged
from ..images import read_image
from ..scene import Scene
from .colmap import MODELS, rotation_to_quaternion
from .places import IMAGE_FOLDERS, dataset_root

FORMATS = ("mvcore", "colmap", "nerfstudio", "mvsnet")
MODEL_IDS = {name: number for number, (name, _) in MODELS.items()}
GREY = 128
"""Colour of a point that no image shows."""
PLANES = 192
"""Depths in an MVSNet range, as its authors sample it."""
STRETCH = 0.25
"""Share by which the range of a view's points is widened at either end, as `DepthConfig.range_stretch`."""
LEAST_POINTS = 10
"""Points of a view below which their depths say little about its range."""
SOURCES = 10
"""Sources of a view in pair.txt, as in the sets of MVSNet's authors."""


def save_calibration(path: str | Path, scene: Scene, format: str = "mvcore", *, points: SparsePoints | None = None) -> None:
    """Write a scene's cameras.

    Parameters
    ----------
    path : the file of ``mvcore`` and ``nerfstudio`` (or its folder: transforms.json), the folder of ``colmap`` (cameras.txt,
        images.txt, points3D.txt; binary where an image's name has blanks, which COLMAP's text cannot hold) and ``mvsnet`` (cams/,
        pair.txt).
    format : ``mvcore``, ``colmap``, ``nerfstudio`` or ``mvsnet``.
        Only ``mvcore`` holds a mirrored world (as bare projection matrices); the others get its reflection in z.
    points : triangulated features of the scene's views, (V, N) visible in its order: COLMAP's points and tracks, nerfstudio's
        ``ply_file_path``, MVSNet's depth ranges and view scores.

    Raises
    ------
    InvalidInputError
        A camera that the format cannot hold, or no depth range for MVSNet.

    Examples
    --------
    >>> mvcore.save_calibration("model", scene, "colmap", points=points)  # doctest: +SKIP
    """
    require(format in FORMATS, "format", f"one of {', '.join(FORMATS)}", repr(format))
    require(len(scene) > 0, "scene", "one or more views", "none")
    if points is not None:
        require(points.visible.shape == (len(scene), len(points)), "points", f"visible of shape ({len(scene)}, N)", points.visible.shape)
    writers = {"colmap": _colmap, "nerfstudio": _nerfstudio, "mvsnet": _mvsnet}
    if format == "mvcore":
        _native(Path(path), scene)
        return
    if scene.mirrored and scene.bounds is not None:
        scene = replace(scene, bounds=np.sort(np.asarray(scene.bounds) * np.diag(MIRROR)[:3], axis=0))
    writers[format](Path(path), scene, points)


def _names(scene: Scene, base: Path) -> list[str]:
    """Image names relative to a folder where they lie below it."""
    names = []
    for n, camera in enumerate(scene.calib):
        frame = scene.frames[n] if n < len(scene.frames) else None
        if isinstance(frame, str | Path):
            names.append(_relative(frame, base))
        else:
            names.append(camera.name or f"{n:06d}.png")
    return names


def _relative(file: str | Path, base: Path) -> str:
    try:
        return Path(os.path.relpath(file, base)).as_posix()
    except ValueError:  # another disk
        return Path(file).absolute().as_posix()


def _text(path: Path, text: str) -> None:
    atomically(path, lambda temporary: _write(temporary, text))


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _native(path: Path, scene: Scene) -> None:
    base = path.parent.absolute()
    views = []
    for n, (camera, name) in enumerate(zip(scene.calib, _names(scene, base), strict=True)):
        view: dict[str, Any] = {"image": name, "width": camera.width, "height": camera.height}
        if camera.name and camera.name != name:
            view["name"] = camera.name
        if scene.mirrored:
            view["P"] = (camera.projection @ MIRROR).tolist()
        else:
            view |= {"K": camera.K.tolist(), "R": camera.R.tolist(), "t": camera.t.tolist()}
        if camera.distortion.size:
            view |= {"dist": camera.distortion.tolist(), "fisheye": camera.fisheye}
        mask = scene.masks[n] if scene.masks is not None and not scene.alpha else None
        if isinstance(mask, str | Path):
            view["mask"] = _relative(mask, base)
        views.append(view)
    data: dict[str, Any] = {"convention": "x ~ K (R X + t); OpenCV axes (x right, y down, z forward); pixel centres at integer coordinates"}
    if scene.bounds is not None:
        data["bounds"] = np.asarray(scene.bounds).tolist()
    _text(path, json.dumps(data | {"views": views}, indent=1) + "\n")


def _colmap_camera(camera: Camera) -> str:
    k, d = camera.K, camera.distortion
    if abs(k[0, 1]) > 1e-6:
        raise InvalidInputError(f"camera {camera.name!r} K: COLMAP has no skew, got {k[0, 1]:g}")
    model = "OPENCV_FISHEYE" if camera.fisheye else "PINHOLE" if not d.size else "OPENCV" if d.size == 4 else "FULL_OPENCV"
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


def _short_names(scene: Scene) -> list[str]:
    """Image names from the folder that holds them all on: the data set's ``images``, ``rgb`` .., else the deepest common one."""
    given = [scene.frames[n] if n < len(scene.frames) else None for n in range(len(scene))]
    files = [Path(f).absolute() for f in given if isinstance(f, str | Path)]
    if len(files) < len(given):
        return [Path(f).name if isinstance(f, str | Path) else c.name or f"{n:06d}.png" for n, (f, c) in enumerate(zip(given, scene.calib))]
    common = Path(os.path.commonpath([f.parent for f in files]))
    root = dataset_root(Path(scene.calib.source).absolute().parent) if scene.calib.source else common
    inside = [p for p in (common, *common.parents) if p.is_relative_to(root) and p != root]
    base = next((p for p in inside if p.name.lower() in IMAGE_FOLDERS), common)
    return [f.relative_to(base).as_posix() for f in files]


def _pixels(camera: Camera, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the image shows points, distortion included, (n, 2)."""
    if not len(positions):
        return np.zeros((0, 2))
    if not camera.distorted:
        return camera.project(positions)
    turn, points = cv2.Rodrigues(camera.R)[0], np.asarray(positions, np.float64).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if camera.fisheye else cv2.projectPoints
    return project(points, turn, camera.t.copy(), camera.K.copy(), camera.distortion.copy())[0].reshape(-1, 2)


def _colours(scene: Scene, points: SparsePoints, pixels: Sequence[NDArray[np.float64]]) -> NDArray[np.uint8]:
    """(N, 3) colour of each point in the first image that shows it; grey where there is none."""
    colours = np.full((len(points), 3), GREY, np.uint8)
    missing = np.ones(len(points), bool)
    for frame, visible, x in zip(scene.frames, points.visible, pixels, strict=False):
        numbers = np.flatnonzero(visible)
        wanted = missing[numbers]
        if not wanted.any() or (image := _image(frame)) is None:
            continue
        at = np.rint(x[wanted]).astype(int)
        inside = (at >= 0).all(1) & (at < [image.shape[1], image.shape[0]]).all(1)
        numbers = numbers[wanted][inside]
        colours[numbers] = image[at[inside, 1], at[inside, 0]]
        missing[numbers] = False
    return colours


def _image(frame: Frame | None) -> NDArray[np.uint8] | None:
    if not isinstance(frame, str | Path):
        return frame
    try:
        return read_image(frame)
    except (MvcoreError, OSError):
        return None  # colours are no reason to fail


def _colmap(path: Path, scene: Scene, points: SparsePoints | None) -> None:
    names = _short_names(scene)
    lines = [_colmap_camera(camera) for camera in scene.calib]
    shared = {line: n for n, line in enumerate(dict.fromkeys(lines), 1)}
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS", *(f"{n} {line}" for line, n in shared.items())]
    seen = [np.zeros((0, 2))] * len(scene)
    if points is not None:
        seen = [_pixels(c, points.positions[v]) for c, v in zip(scene.calib, points.visible, strict=True)]
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID .."]
    for n, (camera, name, x) in enumerate(zip(scene.calib, names, seen, strict=True)):
        pose = [*rotation_to_quaternion(camera.R), *camera.t]
        numbers = np.flatnonzero(points.visible[n]) + 1 if points is not None else []
        observed = " ".join(f"{u + 0.5:.6f} {v + 0.5:.6f} {p}" for (u, v), p in zip(x, numbers, strict=True))
        images += [f"{n + 1} {' '.join(repr(float(v)) for v in pose)} {shared[lines[n]]} {name}", observed]

    model = {"cameras": cameras, "images": images, "points3D": _colmap_points(scene, points, seen)}

    def fill(folder: Path) -> None:
        if any(c.isspace() for name in names for c in name):  # COLMAP ends a name at a blank in its text files
            _colmap_binary(folder, model, names)
            return
        for part, lines in model.items():
            _write(folder / f"{part}.txt", "\n".join(lines) + "\n")

    _in_folder(path, fill)


def _colmap_binary(folder: Path, model: dict[str, list[str]], names: Sequence[str]) -> None:
    """The rows of a text model as COLMAP's binary files."""
    cameras = [line.split() for line in model["cameras"][1:]]
    out = [struct.pack("<Q", len(cameras))]
    for number, kind, width, height, *values in cameras:
        head = (int(number), MODEL_IDS[kind], int(width), int(height))
        out.append(struct.pack(f"<iiQQ{len(values)}d", *head, *map(float, values)))
    (folder / "cameras.bin").write_bytes(b"".join(out))
    rows = model["images"][1:]
    out = [struct.pack("<Q", len(names))]
    for name, image, seen in zip(names, rows[::2], rows[1::2], strict=True):
        number, *pose, camera = image.split(maxsplit=9)[:9]
        words = seen.split()
        out.append(struct.pack("<i7di", int(number), *map(float, pose), int(camera)) + name.encode() + b"\0")
        out.append(struct.pack("<Q", len(words) // 3))
        out += [struct.pack("<ddq", float(u), float(v), int(p)) for u, v, p in zip(*[iter(words)] * 3, strict=True)]
    (folder / "images.bin").write_bytes(b"".join(out))
    points = [line.split() for line in model["points3D"][1:]]
    out = [struct.pack("<Q", len(points))]
    for number, *values in points:
        position, colour, error, track = values[:3], values[3:6], values[6], values[7:]
        out.append(struct.pack("<Q3d3Bd", int(number), *map(float, position), *map(int, colour), float(error)))
        out.append(struct.pack(f"<Q{len(track)}i", len(track) // 2, *map(int, track)))
    (folder / "points3D.bin").write_bytes(b"".join(out))


def _colmap_points(scene: Scene, points: SparsePoints | None, seen: Sequence[NDArray[np.float64]]) -> list[str]:
    lines = ["# POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_INDEX .."]
    if points is None:
        return lines
    index = np.cumsum(points.visible, 1) - 1  # of a point among those of its image
    colours = _colours(scene, points, seen)
    for n, (position, colour) in enumerate(zip(points.positions, colours, strict=True)):
        track = " ".join(f"{v + 1} {index[v, n]}" for v in np.flatnonzero(points.visible[:, n]))
        lines.append(f"{n + 1} {_row(position)} {' '.join(map(str, colour))} {float(points.errors[n]):.6g} {track}")
    return lines


def _nerfstudio(path: Path, scene: Scene, points: SparsePoints | None) -> None:
    """https://docs.nerf.studio/quickstart/data_conventions.html: camera to world, OpenGL axes, corner origin."""
    file = path if path.suffix.lower() == ".json" else path / "transforms.json"
    names = _names(scene, file.parent.absolute())
    frames = [_nerf_frame(camera, name) for camera, name in zip(scene.calib, names, strict=True)]
    data: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if all(c.fisheye for c in scene.calib) else "OPENCV"}
    require(len({c.fisheye for c in scene.calib}) <= 1, "scene", "cameras of one model for nerfstudio", "fisheye and pinhole cameras")
    file.parent.mkdir(parents=True, exist_ok=True)
    if points is not None:
        seen = [_pixels(c, points.positions[v]) for c, v in zip(scene.calib, points.visible, strict=True)]
        cloud = file.with_name("sparse_pc.ply")
        _point_cloud(cloud, points.positions, _colours(scene, points, seen))
        data["ply_file_path"] = cloud.name
    _text(file, json.dumps(data | {"frames": frames}, indent=1) + "\n")


def _nerf_frame(camera: Camera, name: str) -> dict[str, Any]:
    who = f"camera {camera.name!r}"
    require(abs(camera.K[0, 1]) <= 1e-6, f"{who} K", "no skew (nerfstudio has none)", camera.K[0, 1])
    require(
        camera.fisheye or not camera.distortion[5:].any(), f"{who} distortion", "at most k1 k2 p1 p2 k3 for nerfstudio", camera.distortion
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.R.T * [1, -1, -1], camera.center
    keys = ("k1", "k2", "k3", "k4") if camera.fisheye else ("k1", "k2", "p1", "p2", "k3")
    k = camera.K
    frame: dict[str, Any] = {"file_path": name, "w": camera.width, "h": camera.height, "fl_x": k[0, 0], "fl_y": k[1, 1]}
    frame |= {"cx": k[0, 2] + 0.5, "cy": k[1, 2] + 0.5, **dict(zip(keys, camera.distortion.tolist(), strict=False))}
    return frame | {"transform_matrix": pose.tolist()}


def _point_cloud(path: Path, positions: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
    """Binary PLY; doubles, so that absolute coordinates lose nothing."""
    table = np.zeros(len(positions), [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for n, name in enumerate(table.dtype.names or ()):
        table[name] = positions[:, n] if n < 3 else colours[:, n - 3]
    kinds = "".join(f"property {'double' if n < 3 else 'uchar'} {name}\n" for n, name in enumerate(table.dtype.names or ()))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{kinds}end_header\n"
    atomically(path, lambda temporary: _bytes(temporary, header.encode() + table.tobytes()))


def _bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _mvsnet(path: Path, scene: Scene, points: SparsePoints | None) -> None:
    for camera in scene.calib:
        require(not camera.distorted, f"camera {camera.name!r}", "no distortion (MVSNet files hold none)", camera.distortion.tolist())
    ranges = [_depth_range(scene.calib, n, scene.bounds, points) for n in range(len(scene))]
    pairs = _pairs(_scores(scene.calib, scene.bounds, points))

    def fill(folder: Path) -> None:
        (folder / "cams").mkdir()
        for n, (camera, (near, far)) in enumerate(zip(scene.calib, ranges, strict=True)):
            pose = np.vstack([np.column_stack([camera.R, camera.t]), [0, 0, 0, 1]])
            rows = ["extrinsic", *map(_row, pose), "", "intrinsic", *map(_row, camera.K), ""]
            rows.append(_row(np.array([near, (far - near) / (PLANES - 1), PLANES, far])))
            _write(folder / "cams" / f"{n:08d}_cam.txt", "\n".join(rows) + "\n")
        lines = [str(len(pairs))]
        for n, row in enumerate(pairs):
            lines += [str(n), f"{len(row)} " + " ".join(f"{j} {s:.6g}" for j, s in row)]
        _write(folder / "pair.txt", "\n".join(lines) + "\n")

    _in_folder(path, fill)


def _row(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _depth_range(calib: Calibration, n: int, bounds: Bounds | None, points: SparsePoints | None) -> tuple[float, float]:
    """Nearest and farthest z-depth of a view: of its points, else of the bounds, else around what all cameras look at.

    Raises
    ------
    InvalidInputError
        None of the three says where to look.
    """
    camera = calib[n]
    if points is not None:
        z = camera.to_camera(points.positions[points.visible[n]])[:, 2]
        z = z[z > 0]
        if len(z) >= LEAST_POINTS:
            near, far = np.quantile(z, [0.01, 0.99])
            return float(near / (1 + STRETCH)), float(far * (1 + STRETCH))
    if bounds is not None:
        corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        z = camera.to_camera(corners)[:, 2]
        if z.max() > 0:
            return max(float(z.min()), 0.02 * float(z.max())), float(z.max())
    if points is not None and len(points) >= LEAST_POINTS:  # a view that shows few of the points: those of all views
        z = camera.to_camera(points.positions)[:, 2]
        if (z > 0).sum() >= LEAST_POINTS:
            near, far = np.quantile(z[z > 0], [0.01, 0.99])
            return float(near / (1 + STRETCH)), float(far * (1 + STRETCH))
    middle = _middle(calib, bounds, points)
    away = float(camera.to_camera(middle[None])[0, 2]) if middle is not None else 0.0
    if away <= 0:
        raise InvalidInputError(
            f"camera {camera.name!r}: expected points or bounds for its MVSNet depth range, got neither, and the cameras look at no "
            "common place: convert where the images are"
        )
    return 0.2 * away, 3 * away


PARALLEL = 2.0
"""Degrees between viewing directions below which the place where they meet is arbitrary."""


def _middle(calib: Calibration, bounds: Bounds | None, points: SparsePoints | None) -> NDArray[np.float64] | None:
    """What the cameras look at; None where their axes are about parallel."""
    if points is not None and len(points) >= LEAST_POINTS:
        return np.median(points.positions, 0)
    if bounds is not None:
        return np.asarray(bounds).mean(0)
    axes = np.array([c.axis for c in calib])
    if np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1))).max() < PARALLEL:
        return None
    return convergence(calib)


def _scores(calib: Calibration, bounds: Bounds | None, points: SparsePoints | None) -> NDArray[np.float64]:
    """(V, V) scores of MVSNet (Yao et al. 2018, 4.1): sum of G(angle) over shared points; without points G at what all look at."""
    count = len(calib)
    centers = np.array([c.center for c in calib])
    middle = _middle(calib, bounds, points)
    scores = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1, count):
            shared = np.zeros((0, 3))
            if points is not None:
                shared = points.positions[points.visible[i] & points.visible[j]]
            elif middle is not None:
                shared = middle[None]
            scores[i, j] = scores[j, i] = float(_gaussian(_angles(shared - centers[i], shared - centers[j])).sum())
    return scores


def _angles(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Degrees between vectors (n, 3), (n,)."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip((a * b).sum(1) / np.maximum(lengths, 1e-300), -1, 1)))


def _gaussian(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """exp(-(angle - 5)² / 2 sigma²), sigma 1 below 5 degrees and 10 above (the paper's theta_0, sigma_1, sigma_2)."""
    return np.exp(-((angle - 5.0) ** 2) / (2 * np.where(angle <= 5.0, 1.0, 10.0) ** 2))


def _pairs(scores: NDArray[np.float64]) -> list[list[tuple[int, float]]]:
    """The best sources of each view with their scores, best first; the view itself is none."""
    ranked = scores.copy()
    np.fill_diagonal(ranked, -1)
    order = np.argsort(-ranked, axis=1, kind="stable")[:, : min(SOURCES, len(scores) - 1)]
    return [[(int(j), float(scores[n, j])) for j in row] for n, row in enumerate(order)]
