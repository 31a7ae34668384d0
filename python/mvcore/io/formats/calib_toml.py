"""``Calib.toml`` of aniposelib, Pose2Sim, FreeMoCap and Caliscope: one table a camera.

World-to-camera, OpenCV axes and OpenCV's pixel centres (integers), as these tools calibrate and project with OpenCV. ``rotation`` is
a Rodrigues vector (aniposelib, `Camera.get_dict`) or a matrix (Caliscope's ``camera_array.toml``, whose tables lie in ``cameras``);
``distortions`` are k1 k2 p1 p2 (k3 ..), with ``fisheye = true`` the four of OpenCV's fisheye model. Units are the tool's: metres for
Pose2Sim, those of the board for the others.

Sources: aniposelib/cameras.py (Camera, FisheyeCamera, CameraGroup.load), Pose2Sim's calibration.py, caliscope's camera_array.py.
"""

from __future__ import annotations

from pathlib import Path

from .poses import read_rotation
from .records import Found, Record
from .values import Entry, files_in, head, read_toml

LENGTHS = (0, 1, 2, 3, 4, 5, 8, 12, 14)
"""Numbers of OpenCV's coefficients; aniposelib writes fewer where it estimated fewer."""


def find(path: Path) -> Path | None:
    """A TOML file with a camera matrix, or the only one in a folder or its ``calibration`` folder."""
    if path.is_file():
        return path if path.suffix.lower() == ".toml" else None
    for folder in (path, path / "calibration"):
        files = [f for f in files_in(folder, ".toml") if "matrix" in head(f)]
        named = [f for f in files if "calib" in f.name.lower() or f.name.lower() == "camera_array.toml"]
        if len(named or files) == 1:
            return (named or files)[0]
    return None


def read(path: Path) -> Found:
    """The cameras in the file's order."""
    root = read_toml(path)
    tables = root.get("cameras") or root
    cameras = [(n, t) for n, t in tables.items() if isinstance(t.value, dict) and n != "metadata" and t.get("matrix")]
    if not cameras:
        raise root.fail("expected one table a camera, with matrix, rotation and translation")
    if all(n.isdecimal() for n, _ in cameras):
        cameras.sort(key=lambda c: int(c[0]))
    placed = [(n, t) for n, t in cameras if t.get("rotation") and t.get("translation") and not _ignored(t)]
    missing = [n for n, _ in cameras if n not in dict(placed)]
    if not placed:
        raise root.fail("no camera has a rotation and a translation: calibrate the extrinsics first")
    warnings = (f"{path.name}: {len(missing)} cameras without a pose left out: {', '.join(missing[:5])}",) if missing else ()
    return Found([_record(n, t) for n, t in placed], path, warnings=warnings)


def _ignored(camera: Entry) -> bool:
    ignore = camera.get("ignore")
    return ignore is not None and ignore.flag()


def _record(table: str, camera: Entry) -> Record:
    name = camera.get("name")
    size = camera.get("size")
    width, height = (0, 0) if size is None else [s.pixels() for s in size][:2] if len(size.numbers()) == 2 else (0, 0)
    fisheye = camera.get("fisheye")
    lens = camera.get("distortions", "distortion")
    values = [] if lens is None else lens.numbers()
    is_fisheye = fisheye is not None and fisheye.flag()
    if lens is not None and len(values) not in ((0, 4) if is_fisheye else LENGTHS):
        raise lens.fail(f"expected {'4' if is_fisheye else ', '.join(map(str, LENGTHS))} coefficients, got {len(values)}")
    if not is_fisheye:
        values = (values + [0.0] * 4)[: max(4, len(values))] if any(values) else []
    return Record(
        K=camera.need("matrix").array(3, 3),
        R=read_rotation(camera.need("rotation")),
        t=camera.need("translation").array(3),
        width=width,
        height=height,
        name=name.text() if name is not None else table,
        distortion=values or ([0.0] * 4 if is_fisheye else ()),
        fisheye=is_fisheye,
    )
