"""Sparse points: where things are, before any dense work.

SIFT features are matched along the known epipolar lines and triangulated; the points give each view its depth range, the target its
box, each pair of views its score, and the calibration its health in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..config import SparseConfig
from ..geometry.cameras import Camera
from ..geometry.epipolar import fundamental
from ..types import Image, Report, SparsePoints, Track, no_track
from .calibration_check import calibration_error, check_calibration
from .features import Features, candidate_pairs, detect, match


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
