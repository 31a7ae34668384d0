"""EasyMocap and EasyVolcap: ``intri.yml`` and ``extri.yml`` with ``K_CAM``, ``dist_CAM``, ``R_CAM`` or ``Rot_CAM`` and ``T_CAM``.

Image sizes come from ``H_CAM`` and ``W_CAM`` where they are given, else from ``images/CAM`` or ``videos/CAM`` beside the files.
"""

from __future__ import annotations

from pathlib import Path

import cv2

from ...errors import FormatError
from ..media import media_size
from .opencv import open_storage, storage_value
from .records import Found, Record

INTRINSIC, EXTRINSIC = "intri.yml", "extri.yml"


def find(path: Path) -> Path | None:
    """The folder that holds both files, or either file."""
    folder = path if path.is_dir() else path.parent
    named = path.is_dir() or path.name in (INTRINSIC, EXTRINSIC)
    return folder if named and all((folder / n).is_file() for n in (INTRINSIC, EXTRINSIC)) else None


def read(path: Path) -> Found:
    """The cameras in the order of the file's ``names``."""
    with open_storage(path / INTRINSIC) as intrinsic, open_storage(path / EXTRINSIC) as extrinsic:
        names = intrinsic.getNode("names")
        if names.empty() or not names.isSeq():
            raise FormatError(f"{path / INTRINSIC}: expected a list 'names'")
        cameras = [_name(names.at(n)) for n in range(names.size())]
        return Found([_record(path, c, intrinsic, extrinsic) for c in cameras], path)


def _name(node: cv2.FileNode) -> str:
    # Unquoted digits are read as a number.
    return node.string() if node.isString() else f"{node.real():g}"


def _record(path: Path, name: str, intrinsic: cv2.FileStorage, extrinsic: cv2.FileStorage) -> Record:
    inside, outside = path / INTRINSIC, path / EXTRINSIC
    matrix = storage_value(inside, intrinsic, (f"K_{name}",))
    t = storage_value(outside, extrinsic, (f"T_{name}",))
    rotation = storage_value(outside, extrinsic, (f"Rot_{name}",))
    if rotation is None and (vector := storage_value(outside, extrinsic, (f"R_{name}",))) is not None:
        rotation = cv2.Rodrigues(vector.reshape(3, 1))[0]
    for file, key, value in ((inside, f"K_{name}", matrix), (outside, f"R_{name}", rotation), (outside, f"T_{name}", t)):
        if value is None:
            raise FormatError(f"{file}: {key} missing")
    distortion = storage_value(inside, intrinsic, (f"dist_{name}", f"D_{name}"))
    width, height = (storage_value(inside, intrinsic, (f"{a}_{name}",)) for a in "WH")
    size = (int(width), int(height)) if width and height else media_size(path, name)
    values = [] if distortion is None else distortion.reshape(-1).tolist()
    return Record(K=matrix, R=rotation, t=t.reshape(-1), width=size[0], height=size[1], name=name, distortion=values if any(values) else ())
