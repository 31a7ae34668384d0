"""mvcore's own ``cameras.json``: ``views[i] = {image, width, height, K, R, t[, dist, fisheye, mask, name]}``.

x ~ K (R X + t), OpenCV axes, pixel centres at integers. In place of K, R and t a view may have its 3x4 projection matrix
``P`` (or ``projection``, ``world_mat``), of any scale and sign. ``bounds`` (or ``bbox``) is [[x0, y0, z0], [x1, y1, z1]];
``roi_sphere`` {centre, radius} is taken for its box.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError, InvalidInputError
from ...geometry.projections import cameras_from_projections
from ...types import Bounds
from ..limits import read_json
from .places import named
from .records import Found, Record

NAME = "cameras.json"
PROJECTIONS = ("P", "projection", "projection_matrix", "world_mat")
MOST_PIXELS = 1_000_000
"""Largest width or height."""


def find(path: Path) -> Path | None:
    """The file, if the path is one or holds one."""
    if path.is_dir():
        return named(path, NAME)
    if path.suffix.lower() != ".json" or path.name.lower().startswith("transforms"):
        return None
    return path


def numbers(where: str, value: Any, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
    """A JSON value as finite numbers of one of the shapes (any without); ``where`` names file and key in the error."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.full((0, 0, 0), np.nan)
    if (shapes and array.shape not in shapes) or array.ndim > 2 or not np.isfinite(array).all():
        expected = " or ".join(" x ".join(map(str, s)) + " numbers" if s else "a number" for s in shapes) or "numbers"
        raise FormatError(f"{where}: expected {expected}, got {value!r:.80}")
    return array


def pixels(where: str, value: Any) -> int:
    """A width or height: a whole number, also as 320.0 or "320"; 0 where there is none."""
    if value is None:
        return 0
    number = float(numbers(where, value, ()))
    if number != int(number) or not 0 <= number <= MOST_PIXELS or isinstance(value, bool):
        raise FormatError(f"{where}: expected a whole number of pixels, got {value!r:.80}")
    return int(number)


def path_in(where: str, value: Any) -> Path | None:
    """A file's path as the calibration names it; None where it names none."""
    if value is None or value == "":
        return None
    if not isinstance(value, str) or "\0" in value:
        raise FormatError(f"{where}: expected a path, got {value!r:.80}")
    return Path(value)


def read(path: Path) -> Found:
    """The views of a ``cameras.json``."""
    data = read_json(path)
    views = data.get("views") if isinstance(data, dict) else None
    if not isinstance(views, list):
        raise FormatError(f"{path}: expected an object with a list 'views'")
    records = [_record(path, n, v) for n, v in enumerate(views)]
    matrices = [_projection(f"{path}: views[{n}]", r, v) for n, (r, v) in enumerate(zip(records, views, strict=True))]
    mirrored = False
    if records and any(_wants_projection(r) for r in records):
        records, mirrored = _decomposed(path, records, matrices)
    return Found(records, path, _bounds(path, data), mirrored=mirrored)


def _record(path: Path, n: int, view: Any) -> Record:
    where = f"{path}: views[{n}]"
    if not isinstance(view, dict):
        raise FormatError(f"{where}: expected an object, got {view!r:.40}")
    missing = {"K", "R", "t"} - set(view)
    bare = any(k in view for k in PROJECTIONS)
    if missing and not bare:
        raise FormatError(f"{where}: {', '.join(sorted(missing))} missing (or P, a 3 x 4 projection matrix)")
    distortion = view.get("dist", view.get("dist_k1k2p1p2", ()))
    image = path_in(f"{where}: image", view.get("image"))
    return Record(
        K=None if missing else numbers(f"{where}: K", view["K"], (3, 3), (9,)).reshape(3, 3),
        R=None if missing else numbers(f"{where}: R", view["R"], (3, 3), (9,)).reshape(3, 3),
        t=None if missing else numbers(f"{where}: t", view["t"], (3,), (3, 1)).reshape(3),
        width=pixels(f"{where}: width", view.get("width")),
        height=pixels(f"{where}: height", view.get("height")),
        image=image,
        mask=path_in(f"{where}: mask", view.get("mask")),
        name=str(view.get("name") or image or ""),
        distortion=() if distortion is None else numbers(f"{where}: dist", distortion).reshape(-1).tolist(),
        fisheye=bool(view.get("fisheye", False)),
    )


def _projection(where: str, record: Record, view: dict[str, Any]) -> NDArray[np.float64]:
    if record.K is not None:
        return record.K @ np.column_stack([record.R, record.t])
    key = next(k for k in PROJECTIONS if k in view)
    return numbers(f"{where}: {key}", view[key], (3, 4), (4, 4))[:3]


def _wants_projection(record: Record) -> bool:
    """No K, R and t, or ones that are a camera only of a mirrored world or image: negative focal lengths, R a reflection."""
    if record.K is None:
        return True
    rotation = np.abs(record.R @ record.R.T - np.eye(3)).max() < 1e-3
    return bool(rotation and (np.linalg.det(record.R) < 0 or record.K[0, 0] < 0 or record.K[1, 1] < 0))


def _decomposed(path: Path, records: list[Record], matrices: list[NDArray[np.float64]]) -> tuple[list[Record], bool]:
    try:
        cameras, mirrored = cameras_from_projections(matrices, [(1, 1)] * len(records), [f"views[{n}]" for n in range(len(records))])
    except InvalidInputError as error:
        raise FormatError(f"{path}: {error}") from None
    return [replace(r, K=c.K, R=c.R, t=c.t) for r, c in zip(records, cameras, strict=True)], mirrored


def _bounds(path: Path, data: dict[str, Any]) -> Bounds | None:
    if sphere := data.get("roi_sphere"):
        if not isinstance(sphere, dict) or not {"centre", "radius"} <= set(sphere):
            raise FormatError(f"{path}: roi_sphere: expected {{centre, radius}}, got {sphere!r:.80}")
        centre = numbers(f"{path}: roi_sphere: centre", sphere["centre"], (3,))
        radius = float(numbers(f"{path}: roi_sphere: radius", sphere["radius"], ()))
        return np.stack([centre - radius, centre + radius])
    box = data.get("bounds", data.get("bbox"))
    if box is None:
        return None
    corners = numbers(f"{path}: bounds", box, (2, 3))
    if not (corners[0] < corners[1]).all():
        raise FormatError(f"{path}: bounds: expected [[x0, y0, z0], [x1, y1, z1]] with x0 < x1 .., got {corners.tolist()}")
    return corners
