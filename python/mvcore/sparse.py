"""Sparse points: where things are, before any dense work.

SIFT features are matched along the known epipolar lines and triangulated; the points give each view its depth range, the target its
box, each pair of views its score, and the calibration its health in pixels.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from . import _core
from .cameras import Camera
from .config import DepthConfig, SparseConfig
from .errors import ReconstructionError
from .types import Bounds, Image, Report, SparsePoints, Track, no_track

Float = NDArray[np.float64]

SURROUND = 0.8
"""Length of the mean viewing direction below which cameras look at a target from around it (about 75 degrees to either side)."""
COMMON = 0.6
"""Share of the cameras that must see a place for it to belong to a surrounded target's volume."""
LEAST_POINTS = 30
"""Points below which their distribution says nothing."""


def fundamental(a: Camera, b: Camera) -> Float:
    """F with ``x_bᵀ F x_a = 0``, shape (3, 3)."""
    rotation = b.R @ a.R.T
    x, y, z = b.t - rotation @ a.t
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(b.K).T @ cross @ rotation @ np.linalg.inv(a.K)


@dataclass(frozen=True)
class Features:
    """positions : (n, 2) float32 pixels. descriptors : (n, 128) uint8."""

    positions: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def detect(image: Image, mask: NDArray[np.uint8] | None, limit: int) -> Features:
    """SIFT features of an image, inside the mask (non-zero) if there is one."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    found, descriptors = cv2.SIFT_create(nfeatures=limit, contrastThreshold=0.02).detectAndCompute(grey, mask)
    if descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    positions = np.array([k.pt for k in found], np.float32).reshape(-1, 2)
    # A corner with two orientations is one place.
    _, first = np.unique(positions, axis=0, return_index=True)
    first.sort()
    return Features(np.ascontiguousarray(positions[first]), np.ascontiguousarray(descriptors[first].astype(np.uint8)))


def convergence(cameras: Sequence[Camera]) -> Float:
    """The point nearest to all optical axes: what the cameras look at. Shape (3,)."""
    matrix, vector = np.zeros((3, 3)), np.zeros(3)
    for c in cameras:
        across = np.eye(3) - np.outer(c.axis, c.axis)
        matrix += across
        vector += across @ c.center
    center = np.mean([c.center for c in cameras], 0)
    # Parallel axes meet nowhere: a little damping keeps the solution finite.
    return np.linalg.solve(matrix + 1e-6 * len(cameras) * np.eye(3), vector + 1e-6 * len(cameras) * center)


def candidate_pairs(cameras: Sequence[Camera], neighbours: int) -> list[tuple[int, int]]:
    """Pairs worth matching: each view with those nearest in direction and position that look the same way."""
    centers = np.array([c.center for c in cameras])
    axes = np.array([c.axis for c in cameras])
    spread = np.median(np.linalg.norm(centers - centers.mean(0), axis=1))
    pairs = set()
    for i in range(len(cameras)):
        turn = np.degrees(np.arccos(np.clip(axes @ axes[i], -1, 1)))
        away = np.linalg.norm(centers - centers[i], axis=1) / max(spread, 1e-12)
        rank = turn / 30 + away
        rank[i] = np.inf
        near = [int(j) for j in np.argsort(rank, kind="stable") if j != i and turn[j] < 90 and away[j] > 1e-9]
        pairs |= {(min(i, j), max(i, j)) for j in near[:neighbours]}
    return sorted(pairs)


def epipolar_errors(a: Camera, b: Camera, x_a: Float, x_b: Float) -> Float:
    """Distance in pixels of each x_b from the epipolar line of x_a, (n,)."""
    lines = np.column_stack([x_a, np.ones(len(x_a))]) @ fundamental(a, b).T
    distance = np.abs((np.column_stack([x_b, np.ones(len(x_b))]) * lines).sum(1))
    return distance / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-300)


def match(a: Features, b: Features, f: Float, band: float, ratio: float) -> NDArray[np.uint32]:
    """Mutual matches within ``band`` pixels of the epipolar lines, (m, 2) indices."""
    return _core.match_epipolar(a.positions, a.descriptors, b.positions, b.descriptors, f, band, ratio)


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


def _tracks(links: list[tuple[int, int, NDArray[np.uint32]]], counts: Sequence[int]) -> NDArray[np.int64]:
    """Union of pairwise matches: rows (track, view, feature), tracks with two features of one view left out."""
    start = np.concatenate([[0], np.cumsum(counts)])
    parent = np.arange(start[-1])
    a = np.concatenate([start[i] + m[:, 0].astype(np.int64) for i, _, m in links] or [np.zeros(0, np.int64)])
    b = np.concatenate([start[j] + m[:, 1].astype(np.int64) for _, j, m in links] or [np.zeros(0, np.int64)])
    while True:  # hook every root to the smallest root it is linked with, then flatten
        root_a, root_b = parent[a], parent[b]
        if (root_a == root_b).all():
            break
        low, high = np.minimum(root_a, root_b), np.maximum(root_a, root_b)
        np.minimum.at(parent, high, low)
        while (parent[parent] != parent).any():
            parent = parent[parent]
    used = np.unique(np.concatenate([a, b]))
    view = np.searchsorted(start, used, side="right") - 1
    rows = np.column_stack([parent[used], view, used - start[view]])
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    twice = (np.diff(rows[:, 0]) == 0) & (np.diff(rows[:, 1]) == 0)
    bad = np.unique(rows[1:][twice, 0])
    return rows[~np.isin(rows[:, 0], bad)]


def triangulate(cameras: Sequence[Camera], features: Sequence[Features], rows: NDArray[np.int64], config: SparseConfig) -> SparsePoints:
    """Points nearest to the rays of each track, kept if they reproject well under enough parallax.

    ``rows`` is (m, 3): track, view, feature, ascending.
    """
    _, track = np.unique(rows[:, 0], return_inverse=True)
    n = int(track.max()) + 1 if len(track) else 0
    pixels, rays = np.zeros((len(rows), 2)), np.zeros((len(rows), 3))
    for v, c in enumerate(cameras):
        of = rows[:, 1] == v
        pixels[of] = features[v].positions[rows[of, 2]]
        rays[of] = np.column_stack([pixels[of], np.ones(of.sum())]) @ np.linalg.inv(c.K).T @ c.R
    rays /= np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-300)
    centers = np.array([c.center for c in cameras])[rows[:, 1]]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    matrix, vector = np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(matrix, track, across)
    np.add.at(vector, track, np.einsum("nij,nj->ni", across, centers))
    solvable = np.linalg.det(matrix) > 1e-9
    matrix[~solvable] = np.eye(3)
    points = np.linalg.solve(matrix, vector[..., None])[..., 0]
    errors = np.full(len(rows), np.inf)
    for v, c in enumerate(cameras):
        of = rows[:, 1] == v
        errors[of] = np.nan_to_num(np.linalg.norm(c.project(points[track[of]]) - pixels[of], axis=1), nan=np.inf)
    worst, mean = np.zeros(n), np.zeros(n)
    np.maximum.at(worst, track, errors)
    np.add.at(mean, track, errors)
    count = np.bincount(track, minlength=n)
    # Parallax: the widest angle of a ray to the track's mean ray, doubled, bounds the widest between two rays.
    axis = np.zeros((n, 3))
    np.add.at(axis, track, rays)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True).clip(1e-300)
    widest = np.zeros(n)
    np.maximum.at(widest, track, np.degrees(np.arccos(np.clip((rays * axis[track]).sum(1), -1, 1))))
    keep = solvable & (worst <= config.max_error) & (count >= 2) & (2 * widest >= config.min_parallax)
    visible = np.zeros((len(cameras), n), bool)
    visible[rows[:, 1], track] = True
    with np.errstate(invalid="ignore"):
        mean /= np.maximum(count, 1)
    return SparsePoints(points[keep], visible[:, keep], mean[keep].astype(np.float32))


def match_and_triangulate(
    cameras: Sequence[Camera],
    features: Sequence[Features],
    pairs: Sequence[tuple[int, int]],
    band: float,
    config: SparseConfig,
    track: Track = no_track,
) -> SparsePoints:
    """Points of the features that match within ``band`` pixels of the epipolar lines."""
    links = []
    for i, j in track(pairs, "matches", len(pairs)):
        links.append((i, j, match(features[i], features[j], fundamental(cameras[i], cameras[j]), band, config.ratio)))
    return triangulate(cameras, features, _tracks(links, [len(f.positions) for f in features]), config)


def find_points(
    images: Sequence[Image],
    cameras: Sequence[Camera],
    masks: Sequence[NDArray[np.uint8]] | None = None,
    config: SparseConfig | None = None,
    report: Report | None = None,
    track: Track = no_track,
) -> SparsePoints:
    """SIFT points of undistorted images, matched along the epipolar lines and triangulated.

    Raises
    ------
    ReconstructionError
        The calibration misses the images by more than ``config.fail_error`` pixels, and few points fit it.
    """
    config, report = config or SparseConfig(), report or Report()
    features = [
        detect(image, None if masks is None else masks[n], config.max_features)
        for n, image in enumerate(track(images, "features", len(images)))
    ]
    pairs = candidate_pairs(cameras, config.neighbours)
    found = calibration_error(cameras, features, pairs)
    # An error of a few pixels is worth a wider band; a larger one means that the matches or the calibration are wrong.
    error = found.overall or 0.0
    band = max(config.band, 2.0 * error) if error <= config.fail_error else config.band
    points = match_and_triangulate(cameras, features, pairs, band, config, track)
    check_calibration(found, points, cameras, config, report)
    report.values["sparse"] = {
        "features": sum(len(f.positions) for f in features),
        "pairs": len(pairs),
        "points": len(points),
        "mean_error_px": float(points.errors.mean()) if len(points) else None,
    }
    return points


def in_view(camera: Camera, points: Float) -> NDArray[np.bool_]:
    """Which points (n, 3) fall on the image, (n,)."""
    x = camera.project(points)
    with np.errstate(invalid="ignore"):
        return (x[:, 0] >= -0.5) & (x[:, 1] >= -0.5) & (x[:, 0] <= camera.width - 0.5) & (x[:, 1] <= camera.height - 0.5)


def surrounds(cameras: Sequence[Camera]) -> bool:
    """Whether the cameras stand around the target rather than on one side of it."""
    return float(np.linalg.norm(np.mean([c.axis for c in cameras], 0))) < SURROUND


def common_volume(cameras: Sequence[Camera], samples: int = 64) -> Bounds | None:
    """Box of the places that most cameras see around the point they look at; None where they look at no common place."""
    target = convergence(cameras)
    distances = np.array([(target - c.center) @ c.axis for c in cameras])
    if np.median(distances) <= 0:
        return None
    reach = np.median(distances)
    steps = np.linspace(-reach, reach, samples)
    grid = target + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    seen = np.zeros(len(grid), np.int32)
    for c in cameras:
        near = (grid - c.center) @ c.axis > 0.2 * reach
        seen += in_view(c, grid) & near
    inside = grid[seen >= max(2, COMMON * len(cameras))]
    if not len(inside):
        return None
    half = 0.5 * (steps[1] - steps[0])
    return np.stack([inside.min(0) - half, inside.max(0) + half])


def _robust_box(points: Float, share: float, margin: float) -> Bounds:
    low, high = np.quantile(points, share, axis=0), np.quantile(points, 1 - share, axis=0)
    pad = margin * (high - low) + 1e-6 * np.abs(high - low).max()
    return np.stack([low - pad, high + pad])


def target_box(cameras: Sequence[Camera], points: SparsePoints) -> Bounds:
    """Box of the target, (2, 3).

    Cameras around a target: the volume that most of them see, so that the background drops out. Cameras on one side: the
    points themselves, robustly. Textureless scenes fall back to the common volume.

    Raises
    ------
    ReconstructionError
        Neither points nor a common volume exist.
    """
    common = common_volume(cameras)
    if surrounds(cameras) and common is not None:
        return common
    if len(points) >= LEAST_POINTS:
        return _robust_box(points.positions, 0.002, 0.15)
    if common is None:
        raise ReconstructionError("the views share neither features nor a common volume: give bounds, or check the poses")
    return common


def depth_ranges(cameras: Sequence[Camera], points: SparsePoints, box: Bounds, stretch: float, bounded: bool) -> list[tuple[float, float]]:
    """(nearest, farthest) z-depth of each view.

    The 1 % and 99 % depths of the points in view, stretched, and the box where points are few. With bounds given by the caller
    (``bounded``) the box alone.
    """
    corners = np.array(list(itertools.product(*box.T)))
    ranges = []
    for c in cameras:
        z_box = c.to_camera(corners)[:, 2]
        far_box = max(float(z_box.max()), 1e-9)
        near_box = max(float(z_box.min()), 0.02 * far_box)
        # All points in the picture, also those matched elsewhere: far background is rarely matched in every view.
        seen = points.positions[in_view(c, points.positions)]
        if bounded or len(seen) < LEAST_POINTS:
            ranges.append((near_box, far_box))
            continue
        z = c.to_camera(seen)[:, 2]
        low, high = np.quantile(z, [0.01, 0.99])
        ranges.append((float(low / (1 + stretch)), float(high * (1 + stretch))))
    return ranges


def _weight(angle: Float, config: DepthConfig) -> Float:
    sigma = np.where(angle < config.best_angle, 1.0, 10.0) if config.best_angle else 10.0
    weight = np.exp(-((angle - config.best_angle) ** 2) / (2 * sigma**2))
    return np.where((angle >= 0.5) & (angle <= config.max_angle), weight, 0.0)


def view_scores(cameras: Sequence[Camera], points: SparsePoints, box: Bounds, config: DepthConfig) -> Float:
    """How well each view serves another as source, (V, V): Σ exp(-(θ - θ0)² / 2σ²) over the points that both show.

    Where views share few points, the angle under which they see the target's middle decides instead.
    """
    n = len(cameras)
    centers = np.array([c.center for c in cameras])
    scores = np.zeros((n, n))
    middle = np.median(points.positions, 0) if len(points) >= LEAST_POINTS and not surrounds(cameras) else box.mean(0)
    for i in range(n):
        to_i = points.positions - centers[i]
        to_i /= np.linalg.norm(to_i, axis=1, keepdims=True).clip(1e-300)
        for j in range(i + 1, n):
            both = points.visible[i] & points.visible[j]
            shared = 0.0
            if both.any():
                to_j = points.positions[both] - centers[j]
                to_j /= np.linalg.norm(to_j, axis=1, keepdims=True).clip(1e-300)
                angles = np.degrees(np.arccos(np.clip((to_i[both] * to_j).sum(1), -1, 1)))
                shared = float(_weight(angles, config).sum())
            a, b = middle - centers[i], middle - centers[j]
            angle = np.degrees(np.arccos(np.clip(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300), -1, 1)))
            # A prior worth a few points; it must still rank wide angles, where the Gaussian has vanished.
            wide = max(float(_weight(np.array([angle]), config)[0]), 1e-3 * max(0.0, 1 - angle / config.max_angle))
            turn = np.degrees(np.arccos(np.clip(cameras[i].axis @ cameras[j].axis, -1, 1)))
            apart = np.linalg.norm(centers[i] - centers[j]) > 1e-9 * max(np.abs(centers).max(), 1e-300)
            facing = angle <= config.max_angle and turn <= 90 and apart
            scores[i, j] = scores[j, i] = shared + 5.0 * wide if facing else 0.0
    return scores


def choose_sources(scores: Float, count: int) -> list[list[int]]:
    """The best sources of each view, best first; views that share nothing have none."""
    return [[int(j) for j in np.argsort(-row, kind="stable")[:count] if row[j] > 0] for row in scores]
