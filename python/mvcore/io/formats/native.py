"""mvcore's own ``cameras.json``: ``views[i] = {image, width, height, K, R, t[, dist, fisheye, mask, name]}``.

x ~ K (R X + t), OpenCV axes, pixel centres at integers. ``bounds`` (or ``bbox``) is [[x0, y0, z0], [x1, y1, z1]];
``roi_sphere`` {centre, radius} is taken for its box.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FormatError
from ...types import Bounds
from .records import Found, Record

NAME = "cameras.json"


def find(path: Path) -> Path | None:
    """The file, if the path is one or holds one."""
    if path.is_dir():
        return path / NAME if (path / NAME).is_file() else None
    if path.suffix != ".json" or path.name.startswith("transforms"):
        return None
    return path


def parse_json(path: Path) -> Any:
    """A JSON file's content; errors name path and line."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise FormatError(f"{path}:{error.lineno}: {error.msg}") from None
    except UnicodeDecodeError:
        raise FormatError(f"{path}:1: not a text file") from None


def read(path: Path) -> Found:
    """The views of a ``cameras.json``."""
    data = parse_json(path)
    views = data.get("views") if isinstance(data, dict) else None
    if not isinstance(views, list):
        raise FormatError(f"{path}: expected an object with a list 'views'")
    return Found([_record(path, n, v) for n, v in enumerate(views)], path, _bounds(path, data))


def _record(path: Path, n: int, view: Any) -> Record:
    missing = {"K", "R", "t"} - set(view) if isinstance(view, dict) else {"K", "R", "t"}
    if missing:
        raise FormatError(f"{path}: views[{n}]: {', '.join(sorted(missing))} missing")
    size = view.get("width", 0), view.get("height", 0)
    if not all(isinstance(s, int) for s in size):
        raise FormatError(f"{path}: views[{n}]: width and height must be integers, got {size}")
    image, mask = view.get("image"), view.get("mask")
    return Record(
        K=view["K"],
        R=view["R"],
        t=view["t"],
        width=size[0],
        height=size[1],
        image=path.parent / image if image else None,
        mask=path.parent / mask if mask else None,
        name=str(view.get("name") or image or ""),
        distortion=view.get("dist", view.get("dist_k1k2p1p2", ())),
        fisheye=bool(view.get("fisheye", False)),
    )


def _bounds(path: Path, data: dict[str, Any]) -> Bounds | None:
    if sphere := data.get("roi_sphere"):
        centre, radius = np.asarray(sphere["centre"], float), float(sphere["radius"])
        return np.stack([centre - radius, centre + radius])
    box = data.get("bounds", data.get("bbox"))
    if box is None:
        return None
    box = np.asarray(box, np.float64)
    if box.shape != (2, 3) or not (box[0] < box[1]).all():
        raise FormatError(f"{path}: bounds: expected [[x0, y0, z0], [x1, y1, z1]] with x0 < x1 .., got {box.tolist()}")
    return box
