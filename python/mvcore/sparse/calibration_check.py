"""How well a calibration fits its images, in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..config import SparseConfig
from ..errors import ReconstructionError
from ..geometry.cameras import Camera
from ..geometry.epipolar import Float, epipolar_errors, fundamental
from ..types import Report, SparsePoints
from .features import Features, match


@dataclass(frozen=True)
class CalibrationError:
    """Epipolar errors in pixels of matches found *without* the calibration.

    overall, by_view : medians; None where fewer than 20 such matches exist. errors : (n,) of each match.
    """

    overall: float | None
    by_view: list[float | None]
    errors: Float


def calibration_error(cameras: Sequence[Camera], features: Sequence[Features], pairs: Sequence[tuple[int, int]]) -> CalibrationError:
    """How far the calibration is from the images. Only the surest matches count: mutual, with a ratio below 0.7."""
    by_view: list[list[Float]] = [[] for _ in cameras]
    everything = []
    nearest = sorted(pairs, key=lambda p: np.arccos(np.clip(cameras[p[0]].axis @ cameras[p[1]].axis, -1, 1)))
    for i, j in nearest[: max(2 * len(cameras), 8)]:
        found = match(features[i], features[j], fundamental(cameras[i], cameras[j]), np.inf, 0.7)
        x_i, x_j = features[i].positions[found[:, 0]], features[j].positions[found[:, 1]]
        if len(found) < 16:
            continue
        # Wrong matches obey no epipolar geometry at all, not even an unknown one.
        _, inlier = cv2.findFundamentalMat(x_i, x_j, cv2.FM_RANSAC, 1.5, 0.999, 1000)
        good = inlier.ravel() > 0 if inlier is not None else np.zeros(len(found), bool)
        if good.sum() < 25 or good.mean() < 0.5:  # too few, or a geometry that chance matches share
            continue
        errors = epipolar_errors(cameras[i], cameras[j], x_i[good].astype(float), x_j[good].astype(float))
        everything.append(errors)
        by_view[i].append(errors)
        by_view[j].append(errors)

    def median(parts: list[Float]) -> float | None:
        values = np.concatenate(parts) if parts else np.zeros(0)
        return float(np.median(values)) if len(values) >= 20 else None

    errors = np.concatenate(everything) if everything else np.zeros(0)
    return CalibrationError(median(everything), [median(parts) for parts in by_view], errors)


SUPPORT = 1.5
"""Observations of points of three and more views, for each match that contradicts the calibration, at which the match is not believed."""


def check_calibration(
    found: CalibrationError, points: SparsePoints, cameras: Sequence[Camera], config: SparseConfig, report: Report
) -> None:
    """Warn above ``warn_error`` pixels, raise above ``fail_error``, naming the views that are off.

    A pattern that repeats, on a tiled floor say, matches itself a few tiles off, and all such matches of two views fit some wrong geometry.
    Points that three and more views agree on, found with the calibration, come by chance where it is wrong: where there are many it stands.
    """
    overall, by_view = found.overall, found.by_view
    report.values["calibration"] = {"median_epipolar_error_px": overall, "by_view_px": list(by_view)}
    if overall is None:
        report.warn("too few sure matches to check the calibration")
        return
    off = [(e, n) for n, e in enumerate(by_view) if e is not None and e > config.warn_error]
    worst = ", ".join(f"view {n} ({cameras[n].name or 'unnamed'}) {e:.1f} px" for e, n in sorted(off, reverse=True)[:5])
    if overall > config.fail_error:
        views = points.visible.sum(0)
        if views[views >= 3].sum() >= SUPPORT * (found.errors > config.fail_error).sum():
            report.warn(
                f"matches found without the calibration miss it by {overall:.1f} px, yet {(views >= 3).sum()} points of three and more "
                f"views fit it: the images seem to repeat a pattern, or these views are off: {worst}"
            )
            return
        some = len(off) < 0.7 * len(by_view)
        why = (
            "the poses of these views"
            if some
            else "the pose convention (world-to-camera or camera-to-world, axes), the intrinsics or the image order"
        )
        raise ReconstructionError(
            f"the calibration does not fit the images: the median epipolar error is {overall:.1f} px (at most "
            f"{config.fail_error:g} px); look at {why}: {worst}"
        )
    if overall > config.warn_error:
        report.warn(f"the calibration is doubtful: median epipolar error {overall:.2f} px; worst: {worst}")
    elif off:
        report.warn(f"the calibration of some views is doubtful: {worst}")
