"""Which clip is which camera's, and how its frames fit the calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import FormatError, InvalidInputError, require
from ..geometry.cameras import Camera
from .media import Clip, image_turn
from .pairing import pair_by_name
from .streams import open_stream

CROP = 0.02
"""Share of a side that a codec may have cut off: sides are padded to multiples of 16 or so."""
SAME_SHAPE = 0.005
"""Relative difference of two images' proportions that still is the same picture at another size."""
TURNS = {0: 0, 90: 3, 180: 2, 270: 1}
"""Quarter turns, counter-clockwise, by clockwise degrees."""


def _keys(camera: Camera) -> list[str]:
    """What a camera's clip may be called: the camera's own name, its file's or its folder's."""
    path = Path(camera.name)
    return [camera.name, path.stem, path.parent.name]


def matched(clips: Sequence[Clip], cameras: Sequence[Camera]) -> list[Clip]:
    """The clips in the cameras' order, by name; only cameras without names take them in the clips' order."""
    names = ", ".join(c.name or f"number {n}" for n, c in enumerate(cameras))
    require(len(clips) >= len(cameras), "clips", f"one a camera ({names})", f"{len(clips)} ({', '.join(c.name for c in clips)})")
    if not any(c.name for c in cameras):
        require(len(clips) == len(cameras), "clips", f"one a camera, {len(cameras)}", len(clips))
        return list(clips)
    by_name = {Path(c.name): c for c in clips}
    reason = ""
    for keys in zip(*map(_keys, cameras), strict=True):
        if not all(keys) or len(set(keys)) < len(keys):
            continue
        try:
            return [by_name[Path(str(p))] for p in pair_by_name(keys, list(by_name), "clip", exact=True)]
        except FormatError as error:
            reason = reason or str(error)
    named = ", ".join(c.name for c in clips)
    raise InvalidInputError(f"clips: expected one a camera by name ({names}), got {named}: {reason or 'cameras share names'}")


def turned(
    clips: Sequence[Clip], cameras: Sequence[Camera], rotation: str | int | Mapping[str, str | int], warnings: list[str]
) -> list[Clip]:
    """The clips turned as asked for, or as their files say and the calibration's size allows."""
    asked = dict(rotation) if isinstance(rotation, Mapping) else {c.name: rotation for c in clips}
    unknown = sorted(set(asked) - {c.name for c in clips})
    require(not unknown, "rotation", f"camera names ({', '.join(c.name for c in clips)})", ", ".join(unknown))
    out = []
    for clip, camera in zip(clips, cameras, strict=True):
        degrees = asked.get(clip.name, "auto")
        if degrees != "auto" and str(degrees).isdecimal():
            degrees = int(degrees)
        require(degrees == "auto" or degrees in TURNS, "rotation", "auto, 0, 90, 180 or 270", repr(degrees))
        turn = _upright(clip, camera, warnings) if degrees == "auto" else TURNS[int(degrees)]
        width, height = (clip.height, clip.width) if turn % 2 else (clip.width, clip.height)
        if isinstance(clip.source, np.ndarray):
            out.append(replace(clip, source=np.rot90(clip.source, turn, (1, 2)), width=width, height=height))
        else:
            out.append(replace(clip, turn=turn, width=width, height=height))
    return out


def _upright(clip: Clip, camera: Camera, warnings: list[str]) -> int:
    """The file's turn where the calibration's size is that of the turned frames; a half turn, which no size tells, always."""
    if isinstance(clip.source, np.ndarray):
        return 0
    turn = open_stream(clip.source).turn if isinstance(clip.source, Path) else image_turn(clip.source[0])
    if not turn:
        return 0
    degrees = next(d for d, t in TURNS.items() if t == turn)
    want = (camera.width, camera.height)
    if turn % 2 and not _same_view((clip.height, clip.width), want):
        if _same_view((clip.width, clip.height), want):
            warnings.append(f"{clip.name}: the file asks for a turn by {degrees} degrees, the calibration's size for none: left as stored")
        return 0
    warnings.append(f"{clip.name}: turned clockwise by {degrees} degrees, as the file says; rotation 0 leaves frames as stored")
    return turn


def _same_view(have: tuple[int, int], want: tuple[int, int]) -> bool:
    """Whether a frame's size is a calibration's, but for what a codec cuts off or another scale."""
    return _cut(have, want) or abs(have[0] * want[1] / (have[1] * want[0]) - 1) < SAME_SHAPE


def _cut(have: tuple[int, int], want: tuple[int, int]) -> bool:
    return all(w * (1 - CROP) <= h <= w for h, w in zip(have, want, strict=True))


def fitted(clip: Clip, camera: Camera, warnings: list[str]) -> Camera:
    """The camera of the frames as they decode, with a warning where that is not what was calibrated."""
    camera = replace(camera, name=clip.name)
    have, want = (clip.width, clip.height), (camera.width, camera.height)
    if have == want:
        return camera
    said = f"{clip.name}: frames have {have[0]} x {have[1]} pixels, the calibration {want[0]} x {want[1]}"
    if _cut(have, want):
        warnings.append(f"{said}; taken as cut off at the right and bottom, as codecs do")
        return replace(camera, width=have[0], height=have[1])
    if _same_view(have, want):
        warnings.append(f"{said}; taken as the same picture at another size")
        return camera.resized(*have)
    raise FormatError(f"{said}: neither cut by a few pixels nor at another size")
