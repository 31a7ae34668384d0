"""CMU Panoptic Studio ``calibration_*.json``: a list ``cameras``.

World-to-camera ``R`` and ``t`` (centimetres), OpenCV axes and distortion (``distCoef`` k1 k2 p1 p2 k3), pixel centres at integers.
Images: ``hdImgs/NAME`` or any file or folder with a camera's name.

Source: Panoptic Studio Toolbox, python/panutils.py (projectPoints) and its README.
"""

from __future__ import annotations

from pathlib import Path

from .poses import read_rotation
from .records import Found, Record
from .values import Entry, files_in, head, read_json


def find(path: Path) -> Path | None:
    """A calibration file, or the first in a folder."""
    if path.is_file():
        start = head(path)
        return path if path.suffix.lower() == ".json" and '"distCoef"' in start and '"cameras"' in start else None
    return next((f for f in files_in(path, ".json") if find(f)), None)


def read(path: Path) -> Found:
    """The cameras in the file's order; of several types HD, else the first."""
    cameras = list(read_json(path).need("cameras"))
    kinds: dict[str, list[Entry]] = {}
    for camera in cameras:
        kind = camera.get("type")
        kinds.setdefault("" if kind is None else kind.text(), []).append(camera)
    kind = "hd" if "hd" in kinds else next(iter(kinds), "")
    records = [_record(c) for c in kinds.get(kind, [])]
    several = f"{path.name}: the {len(records)} cameras of type {kind!r} are read, of {len(cameras)}"
    return Found(records, path, warnings=(several,) if len(kinds) > 1 else ())


def _record(camera: Entry) -> Record:
    size, lens = camera.need("resolution"), camera.get("distCoef")
    width, height = (Entry(v, size.source, size.key).pixels() for v in size.array(2))
    values = [] if lens is None else lens.numbers()
    if len(values) not in (0, 4, 5, 8):
        raise camera.fail(f"distCoef: expected 4, 5 or 8 numbers, got {len(values)}")
    return Record(
        K=camera.need("K").array(3, 3),
        R=read_rotation(camera.need("R")),
        t=camera.need("t").array(3),
        width=width,
        height=height,
        name=camera.need("name").text(),
        distortion=values if any(values) else (),
    )
