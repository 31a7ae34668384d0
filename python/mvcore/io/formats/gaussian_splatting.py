"""3D Gaussian Splatting's ``cameras.json``: the cameras that a training saw.

``rotation`` (rows) is camera to world, ``position`` the centre, OpenCV axes; fx and fy are in pixels and the principal point is the
image's middle, as the training takes it: where the COLMAP model lies beside it, that one is read, for it also holds the principal
point. ``img_name`` is a name without its suffix.

Source: graphdeco-inria/gaussian-splatting, utils/camera_utils.py (camera_to_JSON).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InvalidInputError
from .places import named
from .poses import from_center
from .records import Found, Record
from .values import Entry, head, read_json

NAME = "cameras.json"


def find(path: Path) -> Path | None:
    """The file at the path, or in the folder."""
    if path.is_dir():
        path = named(path, NAME) or path / NAME
    start = head(path)
    return path if path.suffix.lower() == ".json" and start.lstrip().startswith("[") and '"img_name"' in start else None


def read(path: Path) -> Found:
    """The cameras in the file's order."""
    return Found([_record(view) for view in read_json(path)], path)


def _record(view: Entry) -> Record:
    matrix = view.need("rotation")
    try:
        r, t = from_center(matrix.array(3, 3).T, view.need("position").array(3))
    except InvalidInputError as error:
        raise matrix.fail(str(error)) from None
    width, height = view.need("width").pixels(), view.need("height").pixels()
    k = np.array([[view.need("fx").number(), 0, (width - 1) / 2], [0, view.need("fy").number(), (height - 1) / 2], [0, 0, 1]])
    name = view.need("img_name").text()
    return Record(k, r, t, width, height, Path(name), name=name)
