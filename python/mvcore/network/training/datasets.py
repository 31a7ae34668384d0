"""Published training sets for those who have them, in their own layouts: MVSNet/DTU, BlendedMVS, Scene Flow, KITTI, Middlebury.

Each becomes a list of items; an item loads as a `Sample`, the same as the procedural scenes make.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError, require
from ...geometry.cameras import Camera
from ...io.formats import mvsnet
from ...io.images import read_image
from ...io.maps import read_pfm
from ..procedural.scenes import Sample

Item = Callable[[], Sample]
VIEWS = 3
"""Views of a sample of the posed sets, the reference among them."""


@dataclass(frozen=True)
class _Pair:
    """A rectified pair on disk: images, the file of its truth, and the true disparity's divisor."""

    left: Path
    right: Path
    truth: Path
    divisor: float = 1.0

    def __call__(self) -> Sample:
        left, right = read_image(self.left), read_image(self.right)
        d = _disparity(self.truth, self.divisor)
        require(d.shape == left.shape[:2] == right.shape[:2], str(self.truth), f"the size of its image {left.shape[:2]}", d.shape)
        return rectified_sample(left, right, d)


def rectified_sample(left: NDArray[np.uint8], right: NDArray[np.uint8], disparity: NDArray[np.float32]) -> Sample:
    """A rectified pair with true disparity (0 = unknown) as a sample: inverse depth is disparity in pixels."""
    h, w = disparity.shape
    K = np.array([[float(w), 0, (w - 1) / 2], [0, float(w), (h - 1) / 2], [0, 0, 1]])
    cameras = tuple(Camera(K, np.eye(3), -np.array([x, 0.0, 0.0]), w, h) for x in (0.0, 1 / w))
    top = float(disparity.max(initial=1.0))
    return Sample(np.stack([left, right]), cameras, disparity, (disparity > 0)[None], (0.0, 1.2 * top))


def _disparity(path: Path, divisor: float) -> NDArray[np.float32]:
    if path.suffix == ".pfm":
        d = read_pfm(path)
        return np.where(np.isfinite(d) & (d > 0), d, 0).astype(np.float32)
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise FormatError(f"{path}: not an image")
    return (values if values.ndim == 2 else values[..., 0]).astype(np.float32) / np.float32(divisor)


def scene_flow(folder: Path) -> list[Item]:
    """FlyingThings3D, Driving, Monkaa: ``frames_*pass/**/left/N.png``, the same under ``right``, ``disparity/**/left/N.pfm``."""
    items: list[Item] = []
    for passes in sorted(folder.glob("frames_*pass")):
        for left in sorted(passes.rglob("left/*.png")):
            inner = left.relative_to(passes)
            right = passes / inner.parent.parent / "right" / left.name
            truth = (folder / "disparity" / inner).with_suffix(".pfm")
            if right.is_file() and truth.is_file():
                items.append(_Pair(left, right, truth))
    return items


def kitti(folder: Path) -> list[Item]:
    """KITTI 2012 or 2015: ``training/image_2|colored_0``, ``image_3|colored_1``, ``disp_occ_0|disp_occ`` of 16-bit PNGs in 1/256 pixel."""
    base = folder / "training" if (folder / "training").is_dir() else folder
    items: list[Item] = []
    for one, two, truth in (("image_2", "image_3", "disp_occ_0"), ("colored_0", "colored_1", "disp_occ")):
        for left in sorted((base / one).glob("*_10.png")):
            if (base / two / left.name).is_file() and (base / truth / left.name).is_file():
                items.append(_Pair(left, base / two / left.name, base / truth / left.name, 256.0))
    return items


_MIDDLEBURY = (
    ("im0.png", "im1.png", "disp0.pfm", 1.0),
    ("im0.png", "im1.png", "disp0GT.pfm", 1.0),
    ("im2.png", "im6.png", "disp2.png", 4.0),
    ("view1.png", "view5.png", "disp1.png", 2.0),
)
"""Images, truth and its divisor: 2014 and 2021 sets, the evaluation's training set, 2003 at quarter size, 2005-2006 at half size."""


def middlebury(folder: Path) -> list[Item]:
    """Middlebury scenes, a folder each, of 2003 to 2021: the names of the images tell the year and the truth's scale."""
    items: list[Item] = []
    for scene in sorted(p for p in [folder, *folder.rglob("*")] if p.is_dir()):
        for left, right, truth, divisor in _MIDDLEBURY:
            if all((scene / name).is_file() for name in (left, right, truth)):
                items.append(_Pair(scene / left, scene / right, scene / truth, divisor))
    return items


@dataclass(frozen=True)
class _Views:
    """A reference view with its sources: camera files, images, the reference's depth map (PFM, 0 = none)."""

    cameras: tuple[Path, ...]
    images: tuple[Path, ...]
    depth: Path

    def __call__(self) -> Sample:
        depth = read_pfm(self.depth)
        images = [read_image(p) for p in self.images]
        h, w = depth.shape
        cameras = []
        for n, (path, image) in enumerate(zip(self.cameras, images, strict=True)):
            record = mvsnet.read_camera(path)
            ih, iw = image.shape[:2]
            # DTU's cameras are those of depth maps a quarter of the photographs' first size; a camera is its image's, or its depth map's.
            natural = (iw, ih) if record.K[0, 2] > 0.3 * iw else (w, h)
            cameras.append(Camera(record.K, record.R, record.t, *natural).resized(w, h))
            images[n] = image if (ih, iw) == (h, w) else cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA)
        inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0).astype(np.float32)
        known = inverse[inverse > 0]
        require(len(known) > 0, str(self.depth), "some depth", "none")
        low, high = (float(np.quantile(known, q)) for q in (0.005, 0.995))
        seen = np.repeat((inverse > 0)[None], len(images) - 1, 0)
        return Sample(np.stack(images), tuple(cameras), inverse, seen, (low * 0.8, high * 1.2))


def dtu(folder: Path, light: int = 3) -> list[Item]:
    """DTU as MVSNet prepared it: ``Cameras/[train/]*_cam.txt``, ``Cameras/pair.txt``, ``Rectified/SCAN[_train]/rect_NNN_L_*.png``,
    ``Depths/SCAN[_train]/depth_map_NNNN.pfm``; ``light`` is L, 0 to 6.
    """
    cams = folder / "Cameras" / "train" if (folder / "Cameras" / "train").is_dir() else folder / "Cameras"
    pairs = mvsnet.read_pairs(folder / "Cameras" / "pair.txt")
    items: list[Item] = []
    for scan in sorted((folder / "Rectified").glob("*")):
        pictures = {int(m[1]) - 1: p for p in sorted(scan.glob("*.png")) if (m := re.match(rf"rect_(\d+)_{light}_", p.name))}
        depths = folder / "Depths" / scan.name
        items += _posed(pairs, pictures, lambda n, d=depths: d / f"depth_map_{n:04d}.pfm", cams)  # type: ignore[misc]
    return items


def blended_mvs(folder: Path) -> list[Item]:
    """BlendedMVS: in each project ``blended_images/N.jpg``, ``cams/N_cam.txt``, ``cams/pair.txt``, ``rendered_depth_maps/N.pfm``."""
    items: list[Item] = []
    for cams in sorted(folder.rglob("cams")):
        project = cams.parent
        pictures = {int(p.stem): p for p in sorted((project / "blended_images").glob("*.jpg")) if p.stem.isdigit()}
        if pictures and (cams / "pair.txt").is_file():
            depths = project / "rendered_depth_maps"
            items += _posed(mvsnet.read_pairs(cams / "pair.txt"), pictures, lambda n, d=depths: d / f"{n:08d}.pfm", cams)  # type: ignore[misc]
    return items


def _posed(pairs: list[list[tuple[int, float]]], images: dict[int, Path], depth: Callable[[int], Path], cams: Path) -> list[Item]:
    items: list[Item] = []
    for n, sources in enumerate(pairs):
        views = [n, *[j for j, _ in sources if j in images][: VIEWS - 1]]
        cameras = [cams / f"{v:08d}_cam.txt" for v in views]
        if n in images and len(views) == VIEWS and depth(n).is_file() and all(c.is_file() for c in cameras):
            items.append(_Views(tuple(cameras), tuple(images[v] for v in views), depth(n)))
    return items


LAYOUTS: dict[str, Callable[[Path], list[Item]]] = {
    "dtu": dtu,
    "blendedmvs": blended_mvs,
    "sceneflow": scene_flow,
    "kitti": kitti,
    "middlebury": middlebury,
}


def find_items(source: str) -> list[Item]:
    """Items of ``LAYOUT:FOLDER``. Raises `InvalidInputError` for an unknown layout and `FormatError` where a folder holds no sample."""
    layout, _, folder = source.partition(":")
    require(layout in LAYOUTS and folder, "data", f"LAYOUT:FOLDER with a layout of {', '.join(LAYOUTS)}", repr(source))
    items = LAYOUTS[layout](Path(folder))
    if not items:
        raise FormatError(f"{folder}: no sample in the layout of {layout}")
    return items


def cropped(sample: Sample, width: int, height: int, random: np.random.Generator) -> Sample:
    """A random window of the reference, and of each source the same window: cameras follow. Smaller images are enlarged first."""
    h, w = sample.inverse.shape
    if w < width or h < height:
        share = max(width / w, height / h)
        sample = _resized(sample, max(width, round(w * share)), max(height, round(h * share)))
        h, w = sample.inverse.shape
    x, y = int(random.integers(0, w - width + 1)), int(random.integers(0, h - height + 1))
    rows, columns = slice(y, y + height), slice(x, x + width)
    shift = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
    # Posed sources keep their whole image; rectified ones lose only rows, for their columns hold what the window shows.
    if _is_rectified(sample):
        cameras = tuple(Camera(shift @ c.K, c.R, c.t, width, height) for c in sample.cameras)
        return Sample(sample.images[:, rows, columns], cameras, sample.inverse[rows, columns], sample.seen[:, rows, columns], sample.span)
    first = sample.cameras[0]
    reference = Camera(shift @ first.K, first.R, first.t, width, height)
    views, cameras_out = [sample.images[0][rows, columns]], [reference]
    middle = (
        np.median(1 / sample.inverse[rows, columns][sample.inverse[rows, columns] > 0])
        if (sample.inverse[rows, columns] > 0).any()
        else 1.0
    )
    corner = reference.unproject(np.array([[width / 2, height / 2]]), np.array([middle]))
    for image, camera in zip(sample.images[1:], sample.cameras[1:], strict=True):
        u, v = camera.project(corner)[0]
        sx = int(np.clip(round(u - width / 2), 0, w - width)) if np.isfinite(u) else 0
        sy = int(np.clip(round(v - height / 2), 0, h - height)) if np.isfinite(v) else 0
        move = np.array([[1, 0, -sx], [0, 1, -sy], [0, 0, 1.0]])
        views.append(image[sy : sy + height, sx : sx + width])
        cameras_out.append(Camera(move @ camera.K, camera.R, camera.t, width, height))
    return Sample(np.stack(views), tuple(cameras_out), sample.inverse[rows, columns], sample.seen[:, rows, columns], sample.span)


def _is_rectified(sample: Sample) -> bool:
    return sample.span[0] == 0.0


def _resized(sample: Sample, width: int, height: int) -> Sample:
    _h, w = sample.inverse.shape
    images = np.stack([cv2.resize(i, (width, height), interpolation=cv2.INTER_LINEAR) for i in sample.images])
    inverse = cv2.resize(sample.inverse, (width, height), interpolation=cv2.INTER_NEAREST)
    seen = np.stack([cv2.resize(s.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0 for s in sample.seen])
    if _is_rectified(sample):
        grown = inverse * np.float32(width / w)
        span = (0.0, sample.span[1] * width / w)
        return Sample(images, rectified_sample(images[0], images[1], grown).cameras, grown, seen, span)
    return Sample(images, tuple(c.resized(width, height) for c in sample.cameras), inverse, seen, sample.span)
