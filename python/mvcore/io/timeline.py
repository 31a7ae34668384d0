"""Which frame each camera took at a moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidInputError, require
from .media import Clip
from .streams import open_stream


def timeline(
    clips: Sequence[Clip], offsets: Mapping[str, float], rates: Mapping[str, float] | float | None, warnings: list[str]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Frame numbers (instants, cameras) and times."""
    names = {c.name for c in clips}
    asked = dict.fromkeys(names, rates) if isinstance(rates, int | float) else dict(rates or {})
    for label, mapping in (("offsets", offsets), ("rates", asked)):
        unknown = sorted(set(mapping) - names)
        require(not unknown, label, f"camera names ({', '.join(sorted(names))})", ", ".join(unknown))
    rate = _rates(clips, asked, warnings)
    shift = np.array([offsets.get(c.name, 0.0) for c in clips], float)
    if (rate == 0).any():
        if rate.any():
            silent = ", ".join(c.name for c, r in zip(clips, rate, strict=True) if r == 0)
            warnings.append(f"no frame rate is known of {silent}: frames are taken one by one")
        require(not shift.any(), "rates", "frames a second of every camera, as offsets are in seconds", None)
        rate = np.ones(len(clips))
        seconds: list[NDArray[np.float64] | None] = [None] * len(clips)
    else:
        seconds = [None if c.name in asked else _varying(c, warnings) for c in clips]
        if np.ptp(rate) > 0.01 * rate.min():
            each = ", ".join(f"{c.name} {r:g}" for c, r in zip(clips, rate, strict=True))
            warnings.append(f"frame rates differ ({each}): the nearest frame of each camera is taken")
    counts = np.array([c.frames for c in clips])
    if len(set(counts.tolist())) > 1:
        each = ", ".join(f"{c.name} {n}" for c, n in zip(clips, counts, strict=True))
        warnings.append(f"frame counts differ ({each}): the common instants are used")
    times = _instants(rate, shift, counts, seconds)
    columns = [_numbers(times + shift[n], rate[n], seconds[n]) for n in range(len(clips))]
    numbers = np.stack(columns, 1)
    inside = ((numbers >= 0) & (numbers < counts)).all(1)
    if not inside.any():
        raise InvalidInputError("offsets: expected clips that overlap in time, got none in common")
    return numbers[inside], times[inside]


def _rates(clips: Sequence[Clip], asked: Mapping[str, float], warnings: list[str]) -> NDArray[np.float64]:
    """Frames a second of each clip: as asked for, else as its file tells."""
    for clip in clips:
        rate = asked.get(clip.name)
        require(rate is None or 0 < rate < np.inf, "rates", "frames a second above 0", rate)
        if rate and clip.rate and abs(rate / clip.rate - 1) > 0.01:
            warnings.append(f"{clip.name}: the file says {clip.rate:g} frames a second, {rate:g} were given and are used")
    return np.array([asked.get(c.name) or c.rate for c in clips], float)


def _varying(clip: Clip, warnings: list[str]) -> NDArray[np.float64] | None:
    """The seconds of each frame where they are not evenly spaced, else None."""
    stream = open_stream(clip.source) if isinstance(clip.source, Path) else None
    if stream is None or stream.steady:
        return None
    warnings.append(f"{clip.name}: the time between frames varies, {clip.rate:.4g} a second in the mean: the nearest frame is taken")
    return stream.times


def _instants(
    rate: NDArray[np.float64], shift: NDArray[np.float64], counts: NDArray[np.int64], seconds: Sequence[NDArray[np.float64] | None]
) -> NDArray[np.float64]:
    """The common times at which the slowest camera has its frames."""
    slowest = int(rate.argmin())
    if (own := seconds[slowest]) is not None:
        return own - shift[slowest]
    ends = [(count - 0.5) / r if s is None else s[-1] + 0.5 / r for count, r, s in zip(counts, rate, seconds, strict=True)]
    first = int(np.ceil(max(0.0, float((-shift).max())) * rate[slowest] - 1e-6))
    last = int(np.floor(float((np.array(ends) - shift).min()) * rate[slowest] + 1e-6))
    return np.arange(first, last + 1) / rate[slowest]


def _numbers(times: NDArray[np.float64], rate: float, seconds: NDArray[np.float64] | None) -> NDArray[np.int64]:
    """The frame nearest to each of a camera's times; -1 or the number of frames where all are more than half a frame away."""
    if seconds is None:
        return np.rint(times * rate).astype(np.int64)
    middles = (seconds[1:] + seconds[:-1]) / 2
    numbers = np.searchsorted(middles, times, side="left")
    numbers[times < seconds[0] - 0.5 / rate] = -1
    numbers[times > seconds[-1] + 0.5 / rate] = len(seconds)
    return numbers.astype(np.int64)
