"""Images onto the mesh: view selection, colour gains, seam levelling, one atlas. Images are taken one at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..config import TextureConfig
from ..errors import require
from ..geometry.cameras import Camera
from ..geometry.linear import solve
from ..types import Image, Track, no_track
from .surface import Surface

Float = NDArray[np.float64]
Mask = NDArray[np.uint8]

COMPARED = 2000
"""Faces a view whose colours are compared: the median of a thousand log ratios with a noise of 0.1 is known to 0.4 %."""
LEAST_COMMON = 50
"""Compared faces below which two views say nothing about each other's exposure."""
LEAST_SCALE = 0.05
"""Share of their size below which images are not reduced to fit the atlas."""


@dataclass(frozen=True)
class TexturedSurface:
    """A mesh whose vertices are split where charts meet, and what texturing found out.

    vertices : (V, 3) float64, world. faces : (F, 3) uint32. uv : (V, 2) float32, origin bottom-left. atlas : (h, w, 3) uint8.
    view : (F,) int32, the view of each face, -1 where none sees it. gains : (N, 3) float32, each view's colour factors. scale : size of
    the atlas' texels against the images' pixels, below 1 where images were reduced to fit. warnings : for the user.
    """

    vertices: Float
    faces: NDArray[np.uint32]
    uv: NDArray[np.float32]
    atlas: Image
    view: NDArray[np.int32]
    gains: NDArray[np.float32]
    scale: float = 1.0
    warnings: tuple[str, ...] = ()

    @property
    def figures(self) -> dict[str, Any]:
        """Plain values for a report."""
        return {
            "atlas": [self.atlas.shape[1], self.atlas.shape[0]],
            "unseen_faces": int((self.view < 0).sum()),
            "views_used": len(np.unique(self.view[self.view >= 0])),
            "scale": self.scale,
            "gains": self.gains.tolist(),
        }


@dataclass(frozen=True)
class TexturePrior:
    """What the frame before settled in a clip, so that the texture does not flicker.

    gains : (N, 3) colour factors of the views. centers : (M, 3) float64, middles of the earlier mesh's faces. views : (M,) int32,
    their views.
    """

    gains: NDArray[np.float32] | None = None
    centers: Float | None = None
    views: NDArray[np.int32] | None = None


@dataclass(frozen=True)
class Candidates:
    """Short lists of the views that see each face best; what they hold does not grow with the number of views.

    views : (F, K) int16, -1 where a slot is free. qualities : (F, K) float32, 0 where it is free. colours : (F, K, 3) uint8, the view's
    mean colour of the face. The views of a face are in no order.
    """

    views: NDArray[np.int16]
    qualities: NDArray[np.float32]
    colours: NDArray[np.uint8]

    @classmethod
    def empty(cls, faces: int, slots: int) -> Candidates:
        """Lists with all slots free."""
        views = np.full((faces, slots), -1, np.int16)
        return cls(views, np.zeros((faces, slots), np.float32), np.zeros((faces, slots, 3), np.uint8))

    def keep_best(self, view: int, quality: NDArray[np.float32], colour: NDArray[np.uint8]) -> None:
        """Lists a view, (F,) and (F, 3), with the faces for which it is better than the worst in their lists."""
        _core.keep_best(view, quality, colour, self.views, self.qualities, self.colours)


def colour_gains(candidates: Candidates, count: int) -> NDArray[np.float32]:
    """Factor a channel that brings each of ``count`` views to common colours, (count, 3).

    Least squares over the median log ratios of pairs of views in the faces' lists, pulled towards 1; dark and saturated faces do not
    count. A sample of the faces is compared: its cost grows with the views alone, linearly.
    """
    pairs, common, ratios = _core.compare_views(candidates.views, candidates.qualities, candidates.colours, count, COMPARED)
    enough = common >= LEAST_COMMON
    (first, second), weight = pairs[enough].T, np.minimum(1.0, common[enough] / 1000)
    matrix, vector = 0.01 * np.eye(count), np.zeros((count, 3))
    for a, b, sign in ((first, first, 1), (second, second, 1), (first, second, -1), (second, first, -1)):
        np.add.at(matrix, (a, b), sign * weight)
    pull = weight[:, None] * ratios[enough]
    np.add.at(vector, first, -pull)
    np.add.at(vector, second, pull)
    logs = solve(matrix, vector)
    return np.exp(logs - logs.mean(0)).clip(0.5, 2.0).astype(np.float32)


def texture(
    surface: Surface,
    images: Sequence[Image],
    cameras: Sequence[Camera],
    masks: Sequence[Mask] | None = None,
    voxel: float | None = None,
    config: TextureConfig | None = None,
    track: Track = no_track,
    prior: TexturePrior | None = None,
) -> TexturedSurface:
    """Texture a mesh from its images (after Waechter, Moehrle and Goesele, ECCV 2014).

    Each image is asked for twice, by its number, and let go before the next: a sequence that decodes ``images[n]`` when it is asked for
    keeps one image in memory.

    Parameters
    ----------
    images : undistorted, (h, w, 3) uint8, one a camera.
    masks : (h, w) uint8, non-zero on the target; nothing outside is copied.
    voxel : scale of the mesh's detail in world units, for visibility; by default its median edge.
    prior : of an earlier frame: its gains are taken, and faces where its surface was keep their view if they can.

    Raises
    ------
    InvalidInputError
        Images, masks or the prior do not fit the cameras, or the atlas cannot be made small enough.
    """
    config, prior = config or TextureConfig(), prior or TexturePrior()
    _check(images, cameras, masks, config, prior)
    vertices = np.ascontiguousarray(surface.vertices, np.float64)
    faces = np.ascontiguousarray(surface.faces, np.uint32)
    if voxel is None:
        edge = vertices[faces[:, 0]] - vertices[faces[:, 1]]
        voxel = float(np.median(np.linalg.norm(edge, axis=1))) if len(faces) else 1.0
    preferred = _preferred(vertices, faces, prior, voxel)
    candidates = Candidates.empty(len(faces), max(1, min(config.candidates, len(cameras))))
    for n in track(range(len(cameras)), "view ratings", len(cameras)):
        quality, colour = _rate(vertices, faces, images[n], None if masks is None else masks[n], cameras[n], voxel, config)
        if preferred is not None:
            quality[preferred == n] *= np.float32(1 + config.loyalty)
        candidates.keep_best(n, quality, colour)
    gains = prior.gains if prior.gains is not None else colour_gains(candidates, len(cameras))
    gains = np.ascontiguousarray(gains, np.float32)
    lists = candidates.views, candidates.qualities, candidates.colours
    labels = _core.select_views(vertices, faces, *lists, gains, voxel, config.seam, config.outlier, config.least_patch)
    del candidates, lists, preferred
    return _painted(vertices, faces, labels, images, cameras, gains, config, track)


def _check(
    images: Sequence[Image], cameras: Sequence[Camera], masks: Sequence[Mask] | None, config: TextureConfig, prior: TexturePrior
) -> None:
    count = len(cameras)
    require(len(images) == count, "images", f"{count}, one a camera", len(images))
    require(masks is None or len(masks) == count, "masks", f"{count}, one a camera", 0 if masks is None else len(masks))
    require(count < 2**15, "cameras", f"fewer than {2**15}", count)
    require(config.candidates > 0, "texture.candidates", "1 or more", config.candidates)
    if prior.gains is not None:
        require(prior.gains.shape == (count, 3), "prior.gains", f"shape ({count}, 3)", prior.gains.shape)
    if prior.centers is not None and prior.views is not None:
        same = prior.centers.shape == (len(prior.views), 3)
        require(same, "prior.centers", f"shape ({len(prior.views)}, 3), one a view", prior.centers.shape)


def _detail(image: Image, mask: Mask | None, erosion: int) -> NDArray[np.float32]:
    """Gradient magnitude in grey levels a pixel; -1 where the image must not be used."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    dx, dy = (cv2.Sobel(grey, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1)))
    detail = cv2.magnitude(dx, dy)
    if mask is not None:
        kernel = np.ones((2 * erosion + 1, 2 * erosion + 1), np.uint8)
        inside = cv2.erode((mask > 0).astype(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE)
        detail[inside == 0] = -1
    return detail


def _rate(
    vertices: Float,
    faces: NDArray[np.uint32],
    image: Image,
    mask: Mask | None,
    camera: Camera,
    voxel: float,
    config: TextureConfig,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Quality, 0 where it cannot be used, and mean colour of each face in a view."""
    size = (camera.height, camera.width)
    require(image.shape == (*size, 3), "images", f"shape {(*size, 3)} as the camera says", image.shape)
    require(mask is None or mask.shape == size, "masks", f"shape {size} as the camera says", None if mask is None else mask.shape)
    p = np.ascontiguousarray(camera.projection)
    depth, _ = _core.rasterize(vertices, faces, p, camera.width, camera.height)
    detail, image = _detail(image, mask, config.mask_erosion), np.ascontiguousarray(image)
    tolerance = config.padding_depth * voxel
    return _core.rate_faces(vertices, faces, image, detail, depth, p, camera.center.tolist(), tolerance)


def _preferred(vertices: Float, faces: NDArray[np.uint32], prior: TexturePrior, voxel: float) -> NDArray[np.int32] | None:
    """The view that the nearest earlier face had, -1 where that is more than two voxels and a face's size away."""
    if prior.centers is None or prior.views is None or not len(prior.centers) or not len(faces):
        return None
    corners = vertices[faces]
    size = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1)
    distance, number = _core.nearest(corners.mean(1), np.ascontiguousarray(prior.centers, np.float64))
    return np.where(distance <= 2 * voxel + size, prior.views[number], -1).astype(np.int32)


def _painted(
    vertices: Float,
    faces: NDArray[np.uint32],
    labels: NDArray[np.int32],
    images: Sequence[Image],
    cameras: Sequence[Camera],
    gains: NDArray[np.float32],
    config: TextureConfig,
    track: Track,
) -> TexturedSurface:
    """Charts of the labels, each image's painted in its turn."""
    atlas, scale = _planned(vertices, faces, labels, cameras, config.max_size)
    for n in track(atlas.views, "texture", len(atlas.views)):
        atlas.add_view(n, _reduced(images[n], scale))
    origin, texel, new_faces, pixels = atlas.finish(gains)
    uv = ((texel + 0.5) / np.float32([pixels.shape[1], pixels.shape[0]])).astype(np.float32)
    uv[:, 1] = 1 - uv[:, 1]
    reduced = f"the texture was reduced to {100 * scale:.0f} % to fit {config.max_size} texels a side"
    warnings = (reduced,) if scale < 1 else ()
    return TexturedSurface(vertices[origin], new_faces, uv, pixels, labels, gains, scale, warnings)


def _planned(
    vertices: Float, faces: NDArray[np.uint32], labels: NDArray[np.int32], cameras: Sequence[Camera], most: int
) -> tuple[_core.Atlas, float]:
    """An atlas of at most so many texels a side, and the scale of the images at which it is that."""
    scale = 1.0
    while True:
        scaled = [c.resized(*_size(c.width, c.height, scale)) if scale < 1 else c for c in cameras]
        matrices = np.array([c.projection for c in scaled], np.float64).reshape(-1, 3, 4)
        atlas = _core.Atlas(vertices, faces, labels, matrices)
        side = max(atlas.size)
        if side <= most:
            return atlas, scale
        require(scale > LEAST_SCALE, "texture.max_size", f"at least {side} for this mesh", most)
        # The padding does not shrink: a little less than what would do without it.
        scale *= max(0.5, 0.97 * most / side)


def _size(width: int, height: int, scale: float) -> tuple[int, int]:
    return max(2, round(width * scale)), max(2, round(height * scale))


def _reduced(image: Image, scale: float) -> Image:
    if scale < 1:
        image = np.asarray(cv2.resize(image, _size(image.shape[1], image.shape[0], scale), interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(image)
