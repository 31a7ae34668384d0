"""Record3D's export: ``metadata`` (JSON) beside ``EXR_RGBD/rgb`` or ``rgb`` with the images 0, 1, 2 ..

``poses[i]`` is qx qy qz qw x y z, camera to world, camera axes x right, y up, z back (ARKit), metres. ``K`` is in column order;
``perFrameIntrinsicCoeffs[i]`` is fx fy cx cy and comes first. Origin of pixels: the image's top-left corner, so pixel centres are at
halves.

Sources: nerfstudio's record3d_utils.py; record3d's README; Apple's ARCamera.intrinsics.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InvalidInputError
from .poses import OPENGL, from_center, quaternion
from .records import Found, Record
from .values import Entry, Float, head, images_in, known_file, read_json

NAMES = ("metadata", "metadata.json")
FOLDERS = ("EXR_RGBD/rgb", "rgb", "rgbd", "images")


def find(path: Path) -> Path | None:
    """The metadata at the path, or in the folder."""
    if path.is_file():
        start = head(path)
        return path if path.name.lower() in NAMES and start.lstrip().startswith("{") and ('"poses"' in start or '"K"' in start) else None
    return known_file(path, NAMES, find) if path.is_dir() else None


def read(path: Path) -> Found:
    """The frames in the metadata's order."""
    root = read_json(path)
    poses = list(root.need("poses"))
    width, height = root.need("w").pixels(), root.need("h").pixels()
    single, each = root.get("K"), root.get("perFrameIntrinsicCoeffs")
    per_frame = list(each) if each is not None else []
    if per_frame and len(per_frame) != len(poses):
        raise root.fail(f"perFrameIntrinsicCoeffs: expected {len(poses)} as there are poses, got {len(per_frame)}")
    folder = next((f for f in FOLDERS if images_in(path.parent / f)), FOLDERS[0])
    files = images_in(path.parent / folder)
    if len(files) != len(poses):  # some are missing, or all
        files = [Path(str(n)) for n in range(len(poses))]
    records = []
    for n, entry in enumerate(poses):
        k = _matrix(per_frame[n], None) if per_frame else _matrix(None, single if single is not None else root.need("K"))
        records.append(Record(k, *_pose(entry), width, height, Path(folder) / files[n].name, name=files[n].name))
    return Found(records, path)


def _matrix(coefficients: Entry | None, columns: Entry | None) -> Float:
    if coefficients is not None:
        fx, fy, cx, cy = coefficients.array(4)
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    else:
        assert columns is not None
        k = columns.array(3, 3).T.copy()
    k[:2, 2] -= 0.5
    return k


def _pose(entry: Entry) -> tuple[Float, Float]:
    x, y, z, w, *center = entry.array(7)
    try:
        return from_center(OPENGL @ quaternion(w, x, y, z).T, np.array(center))
    except InvalidInputError as error:
        raise entry.fail(str(error)) from None
