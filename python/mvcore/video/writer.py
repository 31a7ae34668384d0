"""A reconstructed clip on disk: a folder of GLB files, pictures of the depth maps and a JSON index."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..io.files import atomically
from ..io.limits import read_json
from ..io.maps import colourise
from ..io.meshes import animated
from ..pipeline.result import Reconstruction

INDEX = "index.json"
MOST_INDEX = 1 << 30
"""Bytes of an index."""
PICTURE = 480
"""Pixels of the longer side of depth pictures."""
_TIMED = ("seconds", "tasks", "peak_memory_mib")
"""What differs from run to run stays out of the files: equal input gives equal bytes."""


class SequenceWriter:
    """Writes a clip's reconstructions as they come; the index is written last, so a folder with one is complete."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / INDEX).unlink(missing_ok=True)
        self.instants: list[dict[str, Any]] = []

    def add(self, result: Reconstruction, parts: Sequence[Reconstruction], names: Sequence[str]) -> None:
        """One instant: ``parts`` are its targets, one or more; ``names`` those of the cameras."""
        number = int(result.report["instant"])
        files = []
        for part in parts if len(result.faces) else ():
            target = int(part.report.get("target", 0))
            # A target keeps its number through the clip; a clip of one target does not bother anybody with it.
            name = f"instant{number:04d}.glb" if len(parts) == 1 and target == 0 else f"instant{number:04d}_target{target}.glb"
            part.save(self.folder / name)
            files.append(name)
        pictures = {}
        for name, view in zip(names, result.depths, strict=True):
            if view is not None:
                pictures[name] = f"depth/instant{number:04d}_{name}.jpg"
                _save_picture(self.folder / pictures[name], view.depth)
        report = {k: v for k, v in result.report.items() if k not in _TIMED}
        entry = {"instant": number, "time": report.get("time"), "files": files, "depth": pictures}
        self.instants.append(entry | {"bounds": np.asarray(result.bounds).tolist(), "report": report})

    def finish(self, warnings: Sequence[str], model: Reconstruction | None, trajectory: NDArray[np.float64] | None) -> None:
        """The model of a rigid target, still and animated, and the index."""
        index: dict[str, Any] = {"format": "mvcore sequence", "version": 1, "warnings": list(warnings), "instants": self.instants}
        if model is not None and trajectory is not None:
            model.save(self.folder / "model.glb")
            seen = [n for n, pose in enumerate(trajectory) if np.isfinite(pose).all()]
            times = np.array([self.instants[n]["time"] for n in seen], np.float64)
            data = animated((self.folder / "model.glb").read_bytes(), times, trajectory[seen])
            atomically(self.folder / "animated.glb", lambda p: p.write_bytes(data) and None)
            poses = [pose.tolist() if np.isfinite(pose).all() else None for pose in trajectory]
            report = {k: v for k, v in model.report.items() if k not in _TIMED}
            index["rigid"] = {"model": "model.glb", "animated": "animated.glb", "poses": poses, "report": report}
        text = json.dumps(index, indent=1, sort_keys=True) + "\n"
        atomically(self.folder / INDEX, lambda p: p.write_text(text, encoding="utf-8") and None)


def read_index(folder: str | Path) -> dict[str, Any]:
    """The index of a finished folder.

    Raises
    ------
    FileNotFoundError, FormatError
        No index (no run, or one that was interrupted), or another file.
    """
    path = Path(folder) / INDEX
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such index; is this the output of a finished 'mvcore video'?")
    index = read_json(path, MOST_INDEX)
    if not isinstance(index, dict) or index.get("format") != "mvcore sequence":
        raise FormatError(f"{path}: not the index of a sequence")
    return index


def _save_picture(path: Path, depth: NDArray[np.float32]) -> None:
    picture = colourise(depth)
    scale = PICTURE / max(picture.shape[:2])
    if scale < 1:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])
    if not done:
        raise OSError(f"{path}: the picture cannot be encoded")
    atomically(path, lambda p: p.write_bytes(data.tobytes()) and None)
