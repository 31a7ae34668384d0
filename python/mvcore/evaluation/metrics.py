"""Figures against truth: meshes and points, depth and disparity, photographs.

Mesh figures follow DTU (accuracy, completeness, overall) and Tanks and Temples (F-score). Surfaces are sampled uniformly by area
with a fixed seed; distances are to the nearest sample of the other surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..errors import require
from ..geometry.cameras import Camera
from ..io.mesh_files import load_mesh
from ..types import Image

Float = NDArray[np.float64]
Geometry = tuple[Float, NDArray[np.uint32] | None]
"""Vertices (V, 3) and faces (F, 3), or points and None."""

CHUNK = 1 << 16


def load_geometry(path: str | Path) -> Geometry:
    """A mesh or a point cloud from any file that trimesh reads (OBJ: by our own reader); node transforms are applied."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if path.suffix.lower() == ".obj":
        vertices, faces = _core.read_obj(str(path))
        return vertices, faces if len(faces) else None
    mesh = load_mesh(path)
    faces = getattr(mesh, "faces", None)
    vertices = np.asarray(mesh.vertices, np.float64)
    return vertices, None if faces is None or not len(faces) else np.asarray(faces, np.uint32)


def sample_surface(geometry: Geometry, count: int, seed: int = 0) -> Float:
    """``count`` points, uniform by area (of a cloud: at most that many of its points)."""
    vertices, faces = geometry
    rng = np.random.default_rng(seed)
    if faces is None:
        return vertices if len(vertices) <= count else vertices[rng.choice(len(vertices), count, replace=False)]
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    require(area.sum() > 0, "mesh", "a surface of positive area", "none")
    pick = corners[np.searchsorted(np.cumsum(area), rng.random(count) * area.sum()).clip(0, len(corners) - 1)]
    r, s = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - r) * pick[:, 0] + r * (1 - s) * pick[:, 1] + r * s * pick[:, 2]


def nearest_distance(points: Float, others: Float) -> Float:
    """Distance of each point (n, 3) to the nearest of ``others`` (m, 3), (n,); infinite if there are none."""
    if not len(others):
        return np.full(len(points), np.inf)
    return _core.nearest(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(others, np.float64))[0]


def mesh_metrics(
    result: Geometry,
    truth: Geometry,
    thresholds: Sequence[float],
    *,
    visible: ArrayLike | None = None,
    samples: int = 1_000_000,
    seed: int = 0,
) -> dict[str, Any]:
    """Accuracy (result to truth), completeness (truth to result), overall (their mean), and F-scores.

    Parameters
    ----------
    thresholds : distances in world units at which precision, recall and F-score are given.
    visible : (N, 3) points of the truth that the views see; samples of the result whose nearest truth is farther from them than
        four times their spacing do not count, and completeness is taken over them.
    """
    require(len(thresholds) and min(thresholds) > 0, "thresholds", "positive distances", list(thresholds))
    found, true = sample_surface(result, samples, seed), sample_surface(truth, samples, seed + 1)
    to_truth = nearest_distance(found, true)
    if visible is not None:
        seen = np.asarray(visible, np.float64)
        spacing = np.median(nearest_distance(seen[::2], seen[1::2]))
        counts = nearest_distance(found, seen) < to_truth + 4 * spacing
        to_truth = to_truth[counts]
        true = seen
    to_result = nearest_distance(true, found)
    out: dict[str, Any] = {"accuracy": float(to_truth.mean()) if len(to_truth) else float("inf")}
    out["completeness"] = float(to_result.mean())
    out["overall"] = 0.5 * (out["accuracy"] + out["completeness"])
    for t in thresholds:
        precision = float((to_truth < t).mean()) if len(to_truth) else 0.0
        recall = float((to_result < t).mean())
        f = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
        out[f"at {t:g}"] = {"precision": precision, "recall": recall, "f_score": f}
    return out


def _maps(result: ArrayLike, truth: ArrayLike, mask: ArrayLike | None) -> tuple[Float, Float, int]:
    a, b = np.asarray(result, np.float64), np.asarray(truth, np.float64)
    require(a.shape == b.shape and a.ndim == 2, "result", f"shape {b.shape}", a.shape)
    known = np.isfinite(b) & (b > 0)
    if mask is not None:
        known &= np.asarray(mask) > 0
    return a[known], b[known], int(known.sum())


def depth_metrics(result: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> dict[str, float]:
    """Depth maps (h, w), 0 or non-finite = none: coverage, abs-rel, and shares within 1 % and 2 % (missing counts as wrong)."""
    a, b, n = _maps(result, truth, mask)
    have = np.isfinite(a) & (a > 0)
    relative = np.abs(a[have] - b[have]) / b[have]
    share = lambda x: float(x / n) if n else float("nan")  # noqa: E731
    return {
        "pixels": n,
        "coverage": share(have.sum()),
        "abs_rel": float(relative.mean()) if len(relative) else float("nan"),
        "within_1_percent": share((relative < 0.01).sum()),
        "within_2_percent": share((relative < 0.02).sum()),
    }


def disparity_metrics(
    result: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None, thresholds: Sequence[float] = (0.5, 1, 2, 4)
) -> dict[str, float]:
    """Disparity maps (h, w), 0 = none: coverage, EPE and median error where there is one, bad-x (missing counts as bad)."""
    a, b, n = _maps(result, truth, mask)
    have = np.isfinite(a) & (a > 0)
    error = np.abs(a[have] - b[have])
    out = {
        "pixels": n,
        "coverage": float(have.sum() / n) if n else float("nan"),
        "epe": float(error.mean()) if len(error) else float("nan"),
        "median": float(np.median(error)) if len(error) else float("nan"),
    }
    return out | {f"bad_{t:g}": 1 - float((error <= t).sum() / n) if n else float("nan") for t in thresholds}


def ssim(a: Image, b: Image) -> Float:
    """Structural similarity of two pictures, (h, w): Gaussian window of sigma 1.5, mean over the channels."""
    x, y = a.astype(np.float64), b.astype(np.float64)

    def blur(v: Float) -> Float:
        return cv2.GaussianBlur(v, (11, 11), 1.5)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    value = ((2 * mx * my + 6.5025) * (2 * cov + 58.5225)) / ((mx * mx + my * my + 6.5025) * (vx + vy + 58.5225))
    return value.mean(-1) if value.ndim == 3 else value


def render(mesh: Any, camera: Camera) -> tuple[Image, NDArray[np.bool_]]:
    """A textured mesh (anything with vertices, faces, uv, texture) in a view: (h, w, 3) uint8 with grey holes, and where it hits."""
    vertices, faces = np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.uint32)
    depth, face = _core.rasterize(vertices, faces, np.ascontiguousarray(camera.projection), camera.width, camera.height)
    hit = face >= 0
    picture = np.full((camera.height, camera.width, 3), 127, np.uint8)
    if not hit.any():
        return picture, hit
    y, x = np.nonzero(hit)
    corners = faces[face[hit]]
    points = camera.unproject(np.column_stack([x, y]), depth[hit])
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    ab, ac, ap = b - a, c - a, points - a
    d = np.stack([(p * q).sum(1) for p, q in ((ab, ab), (ab, ac), (ac, ac), (ap, ab), (ap, ac))])
    scale = np.maximum(d[0] * d[2] - d[1] ** 2, 1e-300)
    v, w = (d[2] * d[3] - d[1] * d[4]) / scale, (d[0] * d[4] - d[1] * d[3]) / scale
    weights = np.stack([1 - v - w, v, w], 1)
    uv = (np.asarray(mesh.uv)[corners] * weights[..., None]).sum(1)
    h, width = mesh.texture.shape[:2]
    rows = -(-len(uv) // 4096)
    at = np.zeros((2, rows * 4096), np.float32)
    at[0, : len(uv)], at[1, : len(uv)] = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * h - 0.5
    colours = cv2.remap(mesh.texture, *at.reshape(2, rows, 4096), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    picture[hit] = colours.reshape(-1, 3)[: len(uv)]
    return picture, hit


def photo_metrics(mesh: Any, photo: Image, camera: Camera, mask: ArrayLike | None = None) -> dict[str, float]:
    """A textured mesh rendered into a left-out view: coverage, PSNR (hit pixels; all, holes grey) and SSIM.

    A gain per channel is fitted, so that exposure differences cost nothing.
    """
    picture, hit = render(mesh, camera)
    scored = np.ones(hit.shape, bool) if mask is None else np.asarray(mask) > 0
    both = hit & scored
    shown = picture.astype(np.float64)
    for k in range(3):
        if both.any():
            p = shown[..., k][both]
            shown[..., k][hit] *= (photo[..., k][both] * p).sum() / max((p * p).sum(), 1)
    shown = shown.clip(0, 255)
    error = ((shown - photo) ** 2).mean(-1)

    def psnr(where: NDArray[np.bool_]) -> float:
        return float(10 * np.log10(255**2 / max(error[where].mean(), 1e-12))) if where.any() else float("nan")

    return {
        "coverage": float(both.sum() / max(scored.sum(), 1)),
        "psnr_hit": psnr(both),
        "psnr": psnr(scored),
        "ssim": float(ssim(shown.astype(np.uint8), photo)[scored].mean()),
    }
