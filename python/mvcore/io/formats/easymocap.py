"""EasyMocap and EasyVolcap: ``intri.yml`` and ``extri.yml`` with ``K_CAM``, ``dist_CAM``, ``R_CAM`` or ``Rot_CAM`` and ``T_CAM``.

Image sizes come from ``H_CAM`` and ``W_CAM`` where they are given, else from ``images/CAM`` or ``videos/CAM`` beside the files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...errors import FormatError
from ..media import media_size
from .filestorage import read_filestorage
from .opencv import rotation_of, storage_distortion, storage_matrix, storage_size
from .places import named
from .records import Found, Record

INTRINSIC, EXTRINSIC = "intri.yml", "extri.yml"


def find(path: Path) -> Path | None:
    """The folder that holds both files, or either file."""
    folder = path if path.is_dir() else path.parent
    meant = path.is_dir() or path.name.lower() in (INTRINSIC, EXTRINSIC)
    return folder if meant and all(named(folder, n) for n in (INTRINSIC, EXTRINSIC)) else None


def read(path: Path) -> Found:
    """The cameras in the order of the file's ``names``."""
    inside, outside = (named(path, n) or path / n for n in (INTRINSIC, EXTRINSIC))
    intrinsic, extrinsic = read_filestorage(inside), read_filestorage(outside)
    names = intrinsic.get("names")
    if not isinstance(names, list) or not all(isinstance(n, str | int | float) and _is_plain(str(n)) for n in names):
        raise FormatError(f"{path / INTRINSIC}: expected a list 'names' of cameras")
    return Found([_record(path, str(n), intrinsic, extrinsic) for n in names], path)


def _is_plain(name: str) -> bool:
    """Whether a camera's name can be a file's or folder's name in a folder, and leads nowhere else."""
    return bool(name) and name not in (".", "..") and not any(c in name for c in "/\\\0")


def _record(path: Path, name: str, intrinsic: dict[str, Any], extrinsic: dict[str, Any]) -> Record:
    inside, outside = path / INTRINSIC, path / EXTRINSIC
    matrix = storage_matrix(inside, intrinsic, (f"K_{name}",), (9,))
    t = storage_matrix(outside, extrinsic, (f"T_{name}",), (3,))
    rotation = storage_matrix(outside, extrinsic, (f"Rot_{name}", f"R_{name}"), (3, 9))
    for file, key, value in ((inside, f"K_{name}", matrix), (outside, f"R_{name}", rotation), (outside, f"T_{name}", t)):
        if value is None:
            raise FormatError(f"{file}: {key} missing")
    width, height = storage_size(inside, intrinsic, (f"W_{name}",), (f"H_{name}",))
    if not width:
        width, height = media_size(path, name)
    return Record(
        K=matrix.reshape(3, 3),
        R=rotation_of(rotation),
        t=t.reshape(-1),
        width=width,
        height=height,
        name=name,
        distortion=storage_distortion(inside, intrinsic, (f"dist_{name}", f"D_{name}")),
    )
