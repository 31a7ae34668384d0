"""openMVG ``sfm_data.json``: views, intrinsics and extrinsics as cereal writes them.

World-to-camera rotation (rows) and centre, OpenCV axes, pixel centres at integers as openMVG's features count them. Models: pinhole,
pinhole_radial_k1 and k3, pinhole_brown_t2 (``disto_t2`` k1 k2 k3 t1 t2; t1 and t2 are OpenCV's p1 and p2) and fisheye (OpenCV's);
others, spherical among them, are refused by name. cereal gives a type's name only where it first occurs, later its number alone, and
nests what a base class holds in ``value0``.

Sources: openMVG, cameras/Camera_Pinhole_{io,Radial_io,Brown,Fisheye}.hpp, sfm/sfm_data_io_cereal.cpp; cereal's documentation on
polymorphism.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InvalidInputError
from .lens import brown
from .poses import from_center
from .records import Found, Record
from .values import Entry, Float, files_in, head, read_json

MODELS = ("pinhole", "pinhole_radial_k1", "pinhole_radial_k3", "pinhole_brown_t2", "fisheye")
NEW = 0x80000000
"""Bit of a type's number that says that its name stands beside it."""
UNDEFINED = 0xFFFFFFFF


def find(path: Path) -> Path | None:
    """An sfm_data file, or the first in a folder."""
    if path.is_file():
        return path if path.suffix.lower() == ".json" and '"sfm_data_version"' in head(path) else None
    return next((f for f in files_in(path, ".json") if find(f)), None)


def read(path: Path) -> Found:
    """The views that have a pose."""
    root = read_json(path)
    poses = {p.need("key").integer(): p.need("value") for p in root.get("extrinsics") or []}
    cameras = _cameras(root)
    if not poses or not cameras:
        missing = " and ".join(n for n, v in (("intrinsics", cameras), ("extrinsics", poses)) if not v)
        raise root.fail(f"no {missing}: take the sfm_data of a reconstruction, not that of SfMInit_ImageListing")
    base = root.get("root_path")
    folder = base.text().replace("\\", "/").rstrip("/").rpartition("/")[2] if base is not None else ""
    records, total = [], 0
    for item in root.need("views"):
        view, total = _data(item), total + 1
        pose, number = view.need("id_pose").integer(), view.need("id_intrinsic").integer()
        if pose not in poses or number == UNDEFINED:
            continue
        if number not in cameras:
            raise view.fail(f"id_intrinsic: intrinsics {number} missing")
        local = view.get("local_path")
        name = "/".join(n for n in (folder, local.text() if local is not None else "", view.need("filename").text()) if n)
        k, distortion, fisheye, width, height = cameras[number]
        r, t = _pose(poses[pose])
        records.append(Record(k, r, t, width, height, Path(name), name=name, distortion=distortion, fisheye=fisheye))
    if not records:
        raise root.fail(f"none of the {total} views has a pose")
    left_out = total - len(records)
    warnings = (f"{path.name}: {left_out} of {total} views have no pose and are left out",) if left_out else ()
    return Found(records, path, warnings=warnings)


def _data(item: Entry) -> Entry:
    """What a pointer of cereal points to, with the values of base classes beside its own."""
    data = item.need("value").need("ptr_wrapper").need("data")
    values, level = dict(data.value) if isinstance(data.value, dict) else {}, data.value
    while isinstance(level, dict) and isinstance(level.get("value0"), dict):
        level = level["value0"]
        values = {**level, **values}
    return Entry(values, data.source, data.key)


def _pose(pose: Entry) -> tuple[Float, Float]:
    matrix = pose.need("rotation")
    try:
        return from_center(matrix.array(3, 3), pose.need("center").array(3))
    except InvalidInputError as error:
        raise matrix.fail(str(error)) from None


def _cameras(root: Entry) -> dict[int, tuple[Float, list[float], bool, int, int]]:
    """K, distortion, fisheye, width and height by number."""
    kinds: dict[int, str] = {}
    out = {}
    for item in root.get("intrinsics") or []:
        value = item.need("value")
        number, name = value.get("polymorphic_id"), value.get("polymorphic_name")
        code = number.integer() & ~NEW if number is not None else 0
        if name is not None:
            kinds[code] = name.text()
        kind = kinds.get(code, "pinhole")
        if kind not in MODELS:
            raise value.fail(f"the camera model {kind!r} cannot be read; {', '.join(MODELS)} can")
        out[item.need("key").integer()] = _camera(_data(item), kind)
    return out


def _camera(data: Entry, kind: str) -> tuple[Float, list[float], bool, int, int]:
    width, height = data.need("width").pixels(), data.need("height").pixels()
    f, (x, y) = data.need("focal_length").number(), data.need("principal_point").array(2)
    k = np.array([[f, 0, x], [0, f, y], [0, 0, 1]])
    if kind == "fisheye":
        return k, data.need("fisheye").array(4).tolist(), True, width, height
    if kind == "pinhole_brown_t2":
        k1, k2, k3, t1, t2 = data.need("disto_t2").array(5)
        return k, brown(k1, k2, t1, t2, k3), False, width, height
    if kind == "pinhole_radial_k3":
        k1, k2, k3 = data.need("disto_k3").array(3)
        return k, brown(k1, k2, k3=k3), False, width, height
    k1 = data.need("disto_k1").array(1)[0] if kind == "pinhole_radial_k1" else 0.0
    return k, brown(k1), False, width, height
