"""OpenSfM and OpenDroneMap: ``reconstruction.json``.

A shot's ``rotation`` (angle-axis) and ``translation`` are world-to-camera, axes x right, y down, z forward. Focal lengths and principal
points are in units of the image's longer side, from the image's middle ((w - 1) / 2, (h - 1) / 2), pixel centres at integers.
``perspective`` and ``simple_radial`` (k1, k2), ``radial`` (k1, k2), ``brown`` (k1 k2 k3 p1 p2 as OpenCV's), ``fisheye`` (k1, k2) and
``fisheye_opencv`` (k1 .. k4) are OpenCV's models; others, such as spherical, are refused by name. Of several reconstructions, which
share no frame, the one with most shots is read.

Sources: OpenSfM documentation, "Geometric models"; opensfm/io.py (camera_from_json, shot_from_json); opensfm/features.py
(normalized_image_coordinates).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .lens import brown
from .poses import read_rotation
from .records import Found, Record
from .values import Entry, files_in, head, read_json

NAME = "reconstruction.json"
PINHOLE = ("perspective", "simple_radial", "radial", "brown")
FISHEYE = ("fisheye", "fisheye_opencv")


def find(path: Path) -> Path | None:
    """The file, or the one of that name in a folder or its ``opensfm`` folder."""
    if path.is_file():
        start = head(path)
        known = path.name.lower() == NAME or '"projection_type"' in start
        return path if path.suffix.lower() == ".json" and start.lstrip().startswith("[") and known else None
    for folder in (path, path / "opensfm"):
        if (found := next((f for f in files_in(folder, ".json") if f.name.lower() == NAME and find(f)), None)) is not None:
            return found
    return None


def read(path: Path) -> Found:
    """The shots of the largest reconstruction."""
    parts = list(read_json(path))
    if not parts:
        raise Entry(None, path).fail("no reconstruction in the list")
    sizes = [len(list(p.need("shots").items())) for p in parts]
    best = parts[int(np.argmax(sizes))]
    cameras = dict(best.need("cameras").items())
    records = [_record(name, shot, cameras) for name, shot in best.need("shots").items()]
    warnings = ()
    if len(parts) > 1:
        warnings = (f"{path.name}: the largest of {len(parts)} reconstructions is read: {max(sizes)} of {sum(sizes)} shots",)
    return Found(records, path, warnings=warnings)


def _record(name: str, shot: Entry, cameras: dict[str, Entry]) -> Record:
    number = shot.need("camera")
    if number.text() not in cameras:
        raise number.fail(f"camera {number.text()!r} missing")
    camera = cameras[number.text()]
    kind = camera.need("projection_type").text()
    if kind not in PINHOLE + FISHEYE:
        raise camera.fail(f"the projection type {kind!r} cannot be read; {', '.join(PINHOLE + FISHEYE)} can: undistort first")

    def v(*names: str) -> float:
        entry = camera.get(*names)
        return 0.0 if entry is None else entry.number()

    width, height = camera.need("width").pixels(), camera.need("height").pixels()
    longer = max(width, height)
    fx = camera.need("focal_x", "focal").number() * longer
    fy = camera.need("focal_y", "focal", "focal_x").number() * longer
    k = np.array([[fx, 0, (width - 1) / 2 + v("c_x") * longer], [0, fy, (height - 1) / 2 + v("c_y") * longer], [0, 0, 1]])
    fisheye = kind in FISHEYE
    if fisheye and (v("p1") or v("p2")):
        raise camera.fail(f"the projection type {kind!r} with p1, p2 cannot be read: undistort first")
    lens = [v(f"k{n}") for n in range(1, 5)] if fisheye else brown(v("k1"), v("k2"), v("p1"), v("p2"), v("k3"))
    r, t = read_rotation(shot.need("rotation")), shot.need("translation").array(3)
    return Record(k, r, t, width, height, Path(name), name=name, distortion=lens, fisheye=fisheye)
