"""MC-Calib ``calibrated_cameras_data.yml`` (OpenCV FileStorage): ``camera_0``, ``camera_1`` ...

``camera_pose_matrix`` is 4 x 4 camera to world: the file holds the inverse of the projection's. OpenCV axes, pixel centres at integers.
``distortion_type`` 0 is Brown's (k1 k2 p1 p2 k3 in OpenCV's order), 1 Kannala's (OpenCV's fisheye); newer files name it in
``camera_model``. Groups of cameras share no frame: of several the largest is read.

Source: MC-Calib, McCalib/src/McCalib.cpp (saveCamerasParams) and CameraGroup.cpp.
"""

from __future__ import annotations

import re
from pathlib import Path

from ...errors import InvalidInputError
from .filestorage import read_filestorage
from .poses import from_camera_to_world
from .records import Found, Record
from .values import Entry, files_in, head

CAMERA = re.compile(r"camera_\d+")
MODELS = {"0": False, "1": True, "perspective": False, "brown": False, "fisheye": True, "kannala": True}
"""Types and names of the distortion, and whether each is OpenCV's fisheye."""


def find(path: Path) -> Path | None:
    """The file, or the first in a folder."""
    if path.is_file():
        start = head(path)
        return path if path.suffix.lower() in (".yml", ".yaml") and "nb_camera" in start and "camera_0" in start else None
    return next((f for f in files_in(path, ".yml", ".yaml") if find(f)), None)


def read(path: Path) -> Found:
    """The cameras by number."""
    root = Entry(read_filestorage(path), path)
    cameras = sorted(((n, c) for n, c in root.items() if CAMERA.fullmatch(n)), key=lambda c: int(c[0].removeprefix("camera_")))
    groups: dict[str, list[Record]] = {}
    for name, camera in cameras:
        group = camera.get("camera_group")
        groups.setdefault("0" if group is None else group.text(), []).append(_record(name, camera))
    best = max(groups, key=lambda g: len(groups[g])) if groups else ""
    several = f"{path.name}: only camera group {best} of {len(groups)}, which share no frame, is read"
    return Found(groups.get(best, []), path, warnings=(several,) if len(groups) > 1 else ())


def _record(name: str, camera: Entry) -> Record:
    pose, kind, lens = camera.need("camera_pose_matrix"), camera.get("camera_model", "distortion_type"), camera.get("distortion_vector")
    model = "0" if kind is None else kind.text().lower()
    if model not in MODELS:
        raise camera.fail(f"the camera model {model!r} cannot be read; {', '.join(MODELS)} can")
    fisheye, values = MODELS[model], [] if lens is None else lens.numbers()
    if len(values) not in ((4,) if fisheye else (0, 4, 5, 8)):
        raise camera.fail(f"distortion_vector: expected {'4' if fisheye else '4, 5 or 8'} numbers, got {len(values)}")
    try:
        r, t = from_camera_to_world(pose.array(4, 4))
    except InvalidInputError as error:
        raise pose.fail(str(error)) from None
    return Record(
        K=camera.need("camera_matrix").array(3, 3),
        R=r,
        t=t,
        width=camera.need("img_width").pixels(),
        height=camera.need("img_height").pixels(),
        name=name,
        distortion=values if fisheye or any(values) else (),
        fisheye=fisheye,
    )
