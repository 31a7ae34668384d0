"""Photographs onto the mesh: view selection, colour gains, seam levelling, one atlas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import TextureConfig
from ..errors import InvalidInputError, require
from ..geometry.cameras import Camera
from ..geometry.linear import solve
from ..types import Image, Report, Track, no_track
from .surface import Surface

Float = NDArray[np.float64]


@dataclass(frozen=True)
class TexturedSurface:
    """A mesh whose vertices are split where charts meet.

    vertices : (V, 3) float64, world. faces : (F, 3) uint32. uv : (V, 2) float32, origin bottom-left. atlas : (h, w, 3) uint8.
    view : (F,) int32, the photograph of each face, -1 where none sees it. gains : (V, 3) float32, each photograph's colour factors.
    """

    vertices: Float
    faces: NDArray[np.uint32]
    uv: NDArray[np.float32]
    atlas: Image
    view: NDArray[np.int32]
    gains: NDArray[np.float32]


@dataclass(frozen=True)
class Given:
    """What an earlier instant of a clip settled, so that the texture does not flicker.

    gains : (V, 3) colour factors. centers : (N, 3) float64, middles of the earlier mesh's faces. views : (N,) int32, their photographs.
    """

    gains: NDArray[np.float32] | None = None
    centers: Float | None = None
    views: NDArray[np.int32] | None = None


def _detail(image: Image, mask: NDArray[np.uint8] | None, erosion: int) -> NDArray[np.float32]:
    """Gradient magnitude in grey levels a pixel; -1 where the photograph must not be used."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    dx, dy = (cv2.Sobel(grey, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1)))
    detail = cv2.magnitude(dx, dy)
    if mask is not None:
        kernel = np.ones((2 * erosion + 1, 2 * erosion + 1), np.uint8)
        inside = cv2.erode((mask > 0).astype(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE)
        detail[inside == 0] = -1
    return detail


def _within(colours: NDArray[np.uint8], low: int, high: int) -> NDArray[np.bool_]:
    """Where all channels lie between two levels; a channel at a time, for NumPy reduces a short axis slowly."""
    inside = [(colours[:, k] > low) & (colours[:, k] < high) for k in range(3)]
    return np.asarray(inside[0] & inside[1] & inside[2])


def colour_gains(qualities: Sequence[NDArray[np.float32]], colours: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Factor a channel that brings each photograph to common colours, (V, 3).

    Least squares over log ratios of the faces that two views see, pulled towards 1; dark and saturated faces do not count.
    """
    n = len(qualities)
    matrix, vector = 0.01 * np.eye(n), np.zeros((n, 3))
    usable = [(q > 0) & _within(c, 12, 245) for q, c in zip(qualities, colours, strict=True)]
    for i in range(n):
        for j in range(i + 1, n):
            both = np.flatnonzero(usable[i] & usable[j])
            if len(both) < 50:
                continue
            both = both[:: max(1, len(both) // 5000)]
            ratio = np.median(np.log(colours[i][both].astype(np.float32)) - np.log(colours[j][both].astype(np.float32)), 0)
            weight = min(1.0, len(both) / 1000)
            matrix[i, i] += weight
            matrix[j, j] += weight
            matrix[i, j] -= weight
            matrix[j, i] -= weight
            vector[i] -= weight * ratio
            vector[j] += weight * ratio
    gains = np.exp(solve(matrix, vector))
    return np.clip(gains / np.exp(np.log(gains).mean(0)), 0.5, 2.0).astype(np.float32)


def texture(
    surface: Surface,
    images: Sequence[Image],
    cameras: Sequence[Camera],
    masks: Sequence[NDArray[np.uint8]] | None = None,
    voxel: float | None = None,
    config: TextureConfig | None = None,
    report: Report | None = None,
    track: Track = no_track,
    given: Given | None = None,
) -> TexturedSurface:
    """Texture a mesh from its photographs (after Waechter, Moehrle and Goesele, ECCV 2014).

    Parameters
    ----------
    images : undistorted, (h, w, 3) uint8, one a camera.
    masks : (h, w) uint8, non-zero on the target; nothing outside is copied.
    voxel : scale of the mesh's detail in world units, for visibility; by default its median edge.
    given : of an earlier instant: its gains are taken, and faces where its surface was keep their photograph if they can.
    """
    config, report, given = config or TextureConfig(), report or Report(), given or Given()
    require(len(images) == len(cameras), "images", f"{len(cameras)}, one a camera", len(images))
    vertices = np.ascontiguousarray(surface.vertices, np.float64)
    faces = np.ascontiguousarray(surface.faces, np.uint32)
    if voxel is None:
        edge = vertices[faces[:, 0]] - vertices[faces[:, 1]]
        voxel = float(np.median(np.linalg.norm(edge, axis=1))) if len(faces) else 1.0
    qualities, colours = [], []
    for n in track(range(len(images)), "view ratings", len(images)):
        camera = cameras[n]
        p = np.ascontiguousarray(camera.projection)
        depth, _ = _core.rasterize(vertices, faces, p, camera.width, camera.height)
        detail = _detail(images[n], None if masks is None else masks[n], config.mask_erosion)
        image = np.ascontiguousarray(images[n])
        tolerance = config.padding_depth * voxel
        quality, colour = _core.rate_faces(vertices, faces, image, detail, depth, p, camera.center.tolist(), tolerance)
        qualities.append(quality)
        colours.append(colour)
    gains = given.gains if given.gains is not None else colour_gains(qualities, colours)
    if given.centers is not None and given.views is not None:
        _prefer(qualities, vertices[faces].mean(1), given.centers, given.views, voxel, config.loyalty)
    labels = _core.select_views(vertices, faces, qualities, colours, config.seam, config.outlier, config.least_patch)
    return _build(vertices, faces, labels, images, cameras, gains, config, report)


def _prefer(
    qualities: list[NDArray[np.float32]], centers: Float, before: Float, views: NDArray[np.int32], voxel: float, loyalty: float
) -> None:
    """Raises the quality of the photograph that the nearest earlier face had, within two voxels."""
    if not len(centers) or not len(before):
        return
    _, number = _core.nearest(np.ascontiguousarray(centers), np.ascontiguousarray(before), 2 * voxel)
    kept = np.where(number >= 0, views[number], -1)
    for n, quality in enumerate(qualities):
        quality[kept == n] *= np.float32(1 + loyalty)


def _build(
    vertices: Float,
    faces: NDArray[np.uint32],
    labels: NDArray[np.int32],
    images: Sequence[Image],
    cameras: Sequence[Camera],
    gains: NDArray[np.float32],
    config: TextureConfig,
    report: Report,
) -> TexturedSurface:
    scale = 1.0
    while True:
        pictures, scaled = [], []
        for image, camera in zip(images, cameras, strict=True):
            if scale < 1:
                size = (max(2, round(camera.width * scale)), max(2, round(camera.height * scale)))
                image, camera = cv2.resize(image, size, interpolation=cv2.INTER_AREA), camera.resized(*size)
            pictures.append(np.ascontiguousarray(image))
            scaled.append(np.ascontiguousarray(camera.projection))
        try:
            origin, texel, new_faces, atlas = _core.build_atlas(vertices, faces, labels, pictures, scaled, gains.tolist(), config.max_size)
            break
        except InvalidInputError:
            if scale < 0.05:
                raise
            scale *= 0.8
    if scale < 1:
        report.warn(f"the texture was reduced to {100 * scale:.0f} % to fit {config.max_size} texels a side")
    height, width = atlas.shape[:2]
    uv = np.column_stack([(texel[:, 0] + 0.5) / width, 1 - (texel[:, 1] + 0.5) / height]).astype(np.float32)
    report.values["texture"] = {
        "atlas": [width, height],
        "unseen_faces": int((labels < 0).sum()),
        "views_used": len(np.unique(labels[labels >= 0])),
        "scale": scale,
    }
    return TexturedSurface(vertices[origin], new_faces, uv, atlas, labels, gains)
