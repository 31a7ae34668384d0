"""Meshroom / AliceVision ``.sfm`` and ``sfm.json``: views, intrinsics and poses, all values as text.

A pose holds the world-to-camera rotation in column order and the centre; axes are OpenCV's. Rigs: X_camera = sub-pose * pose.

focal length  ``pxFocalLength`` in pixels where the file has it, else ``focalLength`` in mm of ``sensorWidth`` (versions from 1.2.2);
              ``pixelRatio`` is fx / fy before version 1.2.5 and fy / fx from then on
principal     pixels from the corner before version 1.2.1, from the image's centre (w / 2, h / 2) from then on; pixel centres at
point         integers, as AliceVision's features and its undistortion count them
distortion    radialk1, radialk3, brown (k1 k2 k3 t1 t2; t1 and t2 are OpenCV's p1 and p2), fisheye4 (OpenCV's fisheye), and
              radialk3pt, whose function is divided by 1 + k1 + k2 + k3; others are refused by name

Sources: AliceVision, sfmDataIO/jsonIO.cpp (loadIntrinsic, loadCameraPose), camera/Distortion{Radial,Brown,Fisheye}.cpp.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InvalidInputError
from .lens import brown
from .poses import from_center
from .records import Found, Record
from .values import Entry, Float, files_in, head, known_file, read_json

NAMES = ("cameras.sfm", "sfm.sfm", "sfm.json")
DISTORTIONS = {"pinhole": "none", "radial1": "radialk1", "radial3": "radialk3", "": "none"}
"""What the camera types of older versions stand for."""


def find(path: Path) -> Path | None:
    """An SfM file, or the first in a folder by its usual names."""
    if path.is_file():
        start = head(path)
        return path if start.lstrip().startswith("{") and (path.suffix.lower() == ".sfm" or '"viewId"' in start) else None
    return known_file(path, NAMES, find) or next((f for f in files_in(path, ".sfm") if find(f)), None)


def read(path: Path) -> Found:
    """The views that have a pose."""
    root = read_json(path)
    version = _version(root)
    poses = {p.need("poseId").text(): p.need("pose") for p in root.get("poses") or []}
    if not poses:
        raise root.fail("no poses: run StructureFromMotion and take its output")
    cameras = {i.need("intrinsicId").text(): i for i in root.need("intrinsics")}
    rigs = {r.need("rigId").text(): list(r.need("subPoses")) for r in root.get("rigs") or []}
    records, total = [], 0
    for view in root.need("views"):
        total += 1
        pose, number = view.get("poseId", "viewId"), view.get("intrinsicId")
        if pose is None or pose.text() not in poses or number is None:
            continue
        if number.text() not in cameras:
            raise number.fail(f"intrinsics {number.text()!r} missing")
        records.append(_record(view, cameras[number.text()], version, _pose(view, poses[pose.text()], rigs)))
    if not records:
        raise root.fail(f"none of the {total} views has a pose: run StructureFromMotion and take its output")
    left_out = total - len(records)
    warnings = (f"{path.name}: {left_out} of {total} views have no pose and are left out",) if left_out else ()
    return Found(records, path, warnings=warnings)


def _version(root: Entry) -> tuple[int, ...]:
    entry = root.get("version")
    return tuple(int(v) for v in entry.numbers()) if entry is not None else (1, 0, 0)


def _transform(pose: Entry) -> tuple[Float, Float]:
    """Rotation (world to camera) and centre."""
    entry = pose.get("transform") or pose
    matrix, center = entry.need("rotation"), entry.need("center").array(3)
    try:
        return from_center(matrix.array(3, 3).T, center)[0], center
    except InvalidInputError as error:
        raise matrix.fail(str(error)) from None


def _pose(view: Entry, pose: Entry, rigs: dict[str, list[Entry]]) -> tuple[Float, Float]:
    r, center = _transform(pose)
    rig, independent = view.get("rigId"), view.get("isPoseIndependant")
    if rig is not None and rig.text() in rigs and independent is not None and not independent.flag():
        number, sub_poses = view.need("subPoseId"), rigs[rig.text()]
        if not 0 <= number.integer() < len(sub_poses):
            raise number.fail(f"the rig has {len(sub_poses)} sub-poses")
        sub, offset = _transform(sub_poses[number.integer()].need("pose"))
        r, center = sub @ r, center + r.T @ offset
    return r, -r @ center


def _record(view: Entry, camera: Entry, version: tuple[int, ...], pose: tuple[Float, Float]) -> Record:
    name = view.need("path").text()
    width, height = camera.need("width").pixels(), camera.need("height").pixels()
    fx, fy = _focal(camera, version, width)
    px, py = camera.need("principalPoint").array(2)
    if version >= (1, 2, 1):
        px, py = px + width / 2, py + height / 2
    kind, values = _distortion(camera)
    if kind == "radialk3pt":
        total = 1 + sum(values)
        if not total > 0:
            raise camera.fail(f"distortionParams: expected 1 + k1 + k2 + k3 > 0, got {total:g}")
        fx, fy, kind = fx / total, fy / total, "radialk3"
    lens = values if kind == "fisheye4" else _brown(kind, values)
    k = np.array([[fx, 0, px], [0, fy, py], [0, 0, 1]])
    return Record(k, *pose, width, height, Path(name), name=name, distortion=lens, fisheye=kind == "fisheye4")


def _focal(camera: Entry, version: tuple[int, ...], width: int) -> tuple[float, float]:
    pixels = camera.get("pxFocalLength")
    if pixels is not None:
        values = pixels.numbers()
        fx, fy = values if len(values) == 2 else (pixels.array(1)[0],) * 2
        if fx > 0 and fy > 0:
            return fx, fy
    focal, sensor, ratio = (camera.get(n) for n in ("focalLength", "sensorWidth", "pixelRatio"))
    if focal is None or sensor is None:
        raise camera.fail("expected pxFocalLength, or focalLength with sensorWidth")
    if not sensor.number() > 0:
        raise sensor.fail(f"expected a positive width in mm, got {sensor.number():g}")
    fx, aspect = focal.number() / sensor.number() * width, 1.0 if ratio is None else ratio.number()
    if not (fx > 0 and aspect > 0):
        raise focal.fail(f"expected a positive focal length and pixelRatio, got {focal.number():g} and {aspect:g}")
    return fx, fx * aspect if version >= (1, 2, 5) else fx / aspect


def _distortion(camera: Entry) -> tuple[str, list[float]]:
    """The model's name and its values."""
    kind, named, params = camera.get("type"), camera.get("distortionType"), camera.get("distortionParams")
    model = "pinhole" if kind is None else kind.text().lower()
    values = [] if params is None or params.value == "" else params.numbers()
    if named is not None and model == "pinhole":
        model = named.text().lower()
    model = DISTORTIONS.get(model, model)
    counts = {"none": 0, "radialk1": 1, "radialk3": 3, "radialk3pt": 3, "brown": 5, "fisheye4": 4}
    if model not in counts:
        raise camera.fail(f"the camera model {model!r} cannot be read; {', '.join(counts)} can: undistort with Meshroom first")
    if model != "none" and values and len(values) != counts[model]:
        raise camera.fail(f"distortionParams: expected {counts[model]} numbers for {model}, got {len(values)}")
    return model, (values or [0.0] * counts[model]) if model != "none" else []


def _brown(kind: str, values: list[float]) -> list[float]:
    if kind == "none":
        return []
    if kind == "brown":
        k1, k2, k3, t1, t2 = values
        return brown(k1, k2, t1, t2, k3)
    k1, k2, k3 = (values + [0.0] * 2)[:3]
    return brown(k1, k2, k3=k3)
