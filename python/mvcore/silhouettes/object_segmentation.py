"""Silhouettes of what stands on the ground amid the cameras, found in photographs without masks.

Where a target has hardly any texture, depth maps measure little of it, but its outline is plain in every photograph. Colours of what
was measured above the ground and colours of the ground tell the rest (GrabCut, one pair of mixtures for all views). Trusted only if the
cameras stand all around, and if the silhouettes agree with each other. After Campbell et al., BMVC 2007.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..config import CarveConfig, StandingConfig
from ..geometry.cameras import Camera
from ..io.images import reduce
from ..types import Bounds, DepthMap, Image, Report
from .visual_hull import MOST_VIEWS, Occupancy, at_most, bounded_hull, carve_silhouettes, large_parts, shadow

Mask = NDArray[np.uint8]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Plane:
    """The ground: normal (3,) towards the cameras, ``height`` of a point p above it is normal · p - offset."""

    normal: NDArray[np.float64]
    offset: float

    def height(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of points (n, 3), world units."""
        return np.asarray(points @ self.normal - self.offset)


HYPOTHESES = 1000
"""Planes through three random points: with a third of the points on the ground 1000 find it but once in 10^16."""


def ground(points: NDArray[np.float64], cameras: Sequence[Camera], tolerance: float, share: float) -> Plane | None:
    """The plane that at least ``share`` of the points (n, 3) lie on and next to none under, all cameras above; None without.

    RANSAC (Fischler and Bolles, CACM 1981) with a fixed seed; ``tolerance`` is in world units.
    """
    if len(points) < 3:
        return None
    random = np.random.default_rng(0)
    centers = np.stack([c.center for c in cameras])
    some = points[random.permutation(len(points))[:5000]]
    a, b, c = (some[i] for i in random.integers(len(some), size=(3, HYPOTHESES)))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    a, normals = a[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
    normals[normals @ centers.mean(0) < (normals * a).sum(1)] *= -1
    offsets = (normals * a).sum(1)
    heights = some @ normals.T - offsets
    score = (np.abs(heights) < tolerance).mean(0) - 2 * (heights < -3 * tolerance).mean(0)
    score[(centers @ normals.T < offsets).any(0)] = -np.inf
    best = int(score.argmax()) if len(score) else 0
    if not len(score) or score[best] < share:
        return None
    near = points[np.abs(points @ normals[best] - offsets[best]) < tolerance]
    middle = near.mean(0)
    normal = np.linalg.svd((near - middle)[:20000], full_matrices=False)[2][2]
    normal = normal if normal @ normals[best] > 0 else -normal
    return Plane(normal, float(normal @ middle))


def widest_gap(cameras: Sequence[Camera], middle: NDArray[np.float64], plane: Plane) -> float:
    """Degrees of the widest gap between neighbouring cameras around ``middle`` (3,) as seen from above the ground."""
    away = np.stack([c.center for c in cameras]) - middle
    across = np.linalg.svd(plane.normal[None])[2][1:]
    angles = np.sort(np.degrees(np.arctan2(*(away @ across.T).T)))
    return float(np.diff(angles, append=angles[0] + 360).max())


@dataclass(frozen=True)
class Standing:
    """What stands on the ground inside a box.

    silhouettes : (h, w) uint8 of 0 and 255, one a camera. plane : the ground. tolerance : world units within which a point is on it.
    """

    silhouettes: list[Mask]
    plane: Plane
    bounds: Bounds
    tolerance: float

    def agreeing(self, depths: Sequence[DepthMap | None], cameras: Sequence[Camera]) -> list[DepthMap | None]:
        """Depth maps without what the silhouettes contradict: standing points beside them, background within."""
        return [self._kept(*v) for v in zip(depths, cameras, self.silhouettes, strict=True)]

    def _kept(self, view: DepthMap | None, camera: Camera, mask: Mask) -> DepthMap | None:
        if view is None:
            return None
        kinds = _kinds(view, camera, self.plane, self.bounds, self.tolerance)
        wrong = kinds == np.where(mask > 0, LIES, STANDS)
        return DepthMap(np.where(wrong, np.float32(0), view.depth), np.where(wrong, np.float32(0), view.confidence))


STANDS, LIES, BETWEEN = 1, 2, 3
"""What a pixel with depth shows: surely what stands inside the bounds, surely something else, either."""


def _kinds(view: DepthMap | None, camera: Camera, plane: Plane, bounds: Bounds, tolerance: float) -> Mask:
    """Of each pixel, (h, w) uint8; 0 without depth."""
    kinds = np.zeros((camera.height, camera.width), np.uint8)
    pixels, points = _points(view, camera, 1)
    height = plane.height(points)
    inside = ((points > bounds[0]) & (points < bounds[1])).all(1)
    found = np.where(inside & (height > 2 * tolerance), STANDS, np.where(~inside | (height < tolerance), LIES, BETWEEN))
    kinds[pixels[:, 1], pixels[:, 0]] = found
    return kinds


def find_standing(
    images: Sequence[Image],
    cameras: Sequence[Camera],
    depths: Sequence[DepthMap | None],
    bounds: Bounds,
    config: StandingConfig | None = None,
    carving: CarveConfig | None = None,
    report: Report | None = None,
) -> Standing | None:
    """Silhouettes of what stands on the ground inside ``bounds``, where depth maps leave most of it open.

    Parameters
    ----------
    images : undistorted (h, w, 3) uint8, one a camera. depths : filtered, one a camera or None. bounds : (2, 3) world.

    Returns
    -------
    Standing
        With the silhouettes; None where there is no ground, the cameras do not stand all around, the silhouettes do not agree, or the
        depth maps do without. ``report.values["standing"]`` says which.
    """
    config, carving, report = config or StandingConfig(), carving or CarveConfig(), report or Report()
    said = report.values["standing"] = {"silhouettes": False}
    size = float((bounds[1] - bounds[0]).max())
    tolerance = config.ground_tolerance * size
    measured = [_points(d, c, config.step) for d, c in zip(depths, cameras, strict=True)]
    near = [p[((p > bounds[0] - 0.5 * size) & (p < bounds[1] + 0.5 * size)).all(1)] for _, p in measured]
    plane = ground(np.concatenate(near), cameras, tolerance, config.ground_share)
    if plane is None:
        said["why"] = "no ground"
        return None
    said["widest_gap"] = round(widest_gap(cameras, bounds.mean(0), plane), 1)
    if said["widest_gap"] > config.max_gap:
        said["why"] = "the cameras do not stand all around"
        return None
    kinds = [_kinds(d, c, plane, bounds, tolerance) for d, c in zip(depths, cameras, strict=True)]
    cut = _cut_views(images, cameras, kinds, bounds, config, carving, said)
    if cut is None:
        return None
    masks, small = cut
    hull = _common_hull(masks, small, bounds, carving)
    shadows = _shadows(hull, small)
    said["agreement"] = round(_agreement(masks, shadows), 3)
    if said["agreement"] < config.min_agreement:
        said["why"] = "the silhouettes disagree"
        return None
    # What the others rule out is not the target; a view that shows nothing takes what they have.
    masks = [m & w if m.any() else s for m, s, w in zip(masks, shadows, _shadows(hull, small, 2.0), strict=True)]
    said["silhouettes"] = True
    return Standing([_enlarged(m, c) for m, c in zip(masks, cameras, strict=True)], plane, bounds, tolerance)


def _cut_views(
    images: Sequence[Image],
    cameras: Sequence[Camera],
    kinds: Sequence[Mask],
    bounds: Bounds,
    config: StandingConfig,
    carving: CarveConfig,
    said: dict[str, Any],
) -> tuple[list[Mask], list[Camera]] | None:
    """Silhouettes of reduced views with their cameras; None, and why, where depth maps do without or nothing is shown.

    The smaller size is a quick look: what most views show there tells the others where to look.
    """
    masks: list[Mask] = []
    small: list[Camera] = []
    for side in (config.look_size, config.max_size):
        views = [_seeds(*v, side) for v in zip(images, cameras, kinds, strict=True)]
        looks = _looks(masks, _shadows(_common_hull(masks, small, bounds, carving), small)) if masks else []
        if not all(look.any() for look in looks):
            said["why"] = "the silhouettes disagree"
            return None
        masks, small = _cut_in_groups(views, looks), [v.camera for v in views]
        shown = [v.known[m > 0].mean() for v, m in zip(views, masks, strict=True) if m.any()]
        if len(shown) < max(1.0, config.min_shown * len(views)):
            said["why"] = "too few views show anything that stands"
            return None
        said["measured"] = round(float(np.mean(shown)), 3)
        if said["measured"] > config.max_measured:
            said["why"] = "the depth maps show most of it"
            return None
    return masks, small


def _points(view: DepthMap | None, camera: Camera, step: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pixels (n, 2) that have a depth, every ``step``-th, and their points (n, 3) in the world."""
    if view is None:
        return np.zeros((0, 2), np.int64), np.zeros((0, 3))
    y, x = np.nonzero(view.depth[::step, ::step])
    pixels = np.column_stack([x, y]) * step
    return pixels, camera.unproject(pixels, view.depth[pixels[:, 1], pixels[:, 0]])


@dataclass(frozen=True)
class _Seeds:
    """A reduced view: what surely stands, what surely does not, and where depth is known at all."""

    image: Image
    camera: Camera
    target: Bool
    background: Bool
    known: Bool


def _seeds(image: Image, camera: Camera, kinds: Mask, side: int) -> _Seeds:
    """A view with its longer side at most ``side`` pixels."""
    small, reduced = reduce(image, camera, side)

    def shown(kind: Bool) -> Mask:
        share = cv2.resize(kind.astype(np.uint8) * np.uint8(255), (reduced.width, reduced.height), interpolation=cv2.INTER_AREA)
        return (share > 127).astype(np.uint8)

    kernel = np.ones((3, 3), np.uint8)
    target, background = (cv2.erode(shown(kinds == k), kernel) > 0 for k in (STANDS, LIES))
    return _Seeds(small, reduced, target, background, shown(kinds > 0) > 0)


CUT_ROUNDS = 2
"""Rounds of GrabCut, as for clips: the first learns from the seeds, the second from what it found."""
GROUP = 16
"""Views that are cut together: enough to know the colours, few enough for memory."""


def _cut_in_groups(views: Sequence[_Seeds], looks: Sequence[Mask]) -> list[Mask]:
    """`_cut` of views spread over the rig, so that each group has seen all sides."""
    groups = -(-len(views) // GROUP)
    masks: list[Mask] = [np.zeros(0, np.uint8)] * len(views)
    for n in range(groups):
        masks[n::groups] = _cut(views[n::groups], looks[n::groups])
    return masks


def _cut(views: Sequence[_Seeds], looks: Sequence[Mask]) -> list[Mask]:
    """GrabCut over all views as one picture, so that they share their colours; parts of some size only. 0 and 1.

    ``looks`` are of smaller images (`_looks`), if any: only what is around them is cut.
    """
    shapes = [v.image.shape[:2] for v in views]
    windows = [_around(*v) for v in zip(looks, shapes, strict=True)] if looks else [np.s_[0:h, 0:w] for h, w in shapes]
    width = max(x.stop - x.start for _, x in windows)
    pictures, labels = [], []
    for n, (v, w) in enumerate(zip(views, windows, strict=True)):
        likely = np.full(v.image.shape[:2], cv2.GC_PR_BGD)
        if looks:
            likely[cv2.resize(looks[n], likely.shape[::-1], interpolation=cv2.INTER_NEAREST) == LIKELY] = cv2.GC_PR_FGD
        label = np.where(v.target, cv2.GC_FGD, np.where(v.background, cv2.GC_BGD, likely)).astype(np.uint8)[w]
        # A row and a column between the pictures belong to none.
        fill = ((0, 1), (0, width + 1 - label.shape[1]))
        labels.append(np.pad(label, fill, constant_values=cv2.GC_BGD))
        pictures.append(np.pad(v.image[w], (*fill, (0, 0)), mode="edge"))
    label = np.concatenate(labels)
    masks = [np.zeros(v.image.shape[:2], np.uint8) for v in views]
    if not (label & 1).any() or (label & 1).all():
        return masks
    cv2.setRNGSeed(0)  # its k-means: the same masks each time
    cv2.grabCut(np.concatenate(pictures), label, None, np.zeros((1, 65)), np.zeros((1, 65)), CUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    for mask, window, part in zip(masks, windows, np.split(label, np.cumsum([len(part) for part in labels])[:-1]), strict=True):
        inside = mask[window]
        inside[:] = part[:-1, : inside.shape[1]] & 1
    return [large_parts(m, LEAST_PART) for m in masks]


MARGIN = 0.15
"""Share of a target's size that is looked at around it; background there is what its colours must be told from."""


def _around(look: Mask, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an image of ``shape`` around what a smaller mask shows."""
    ends = []
    for axis in (0, 1):
        found = np.nonzero(look.any(1 - axis))[0]
        margin = 2 + MARGIN * (found[-1] - found[0])
        ratio = shape[axis] / look.shape[axis]
        ends.append(slice(max(0, int((found[0] - margin) * ratio)), min(shape[axis], int((found[-1] + 1 + margin) * ratio))))
    return ends[0], ends[1]


LEAST_PART = 0.05
"""Share of the largest part's pixels below which a part is dropped."""


def _common_hull(masks: Sequence[Mask], cameras: Sequence[Camera], bounds: Bounds, config: CarveConfig) -> Occupancy:
    """The hull of the views that show something; empty where they have nothing in common."""
    seen = [n for n, m in enumerate(masks) if m.any()]
    masks, cameras = at_most(MOST_VIEWS, [masks[n] for n in seen], [cameras[n] for n in seen])
    around = bounded_hull(masks, cameras, bounds, config)
    if not around.occupied.any():
        return around
    return carve_silhouettes(masks, cameras, around.box(), tolerance=0.5 * config.tolerance)


def _shadows(hull: Occupancy, cameras: Sequence[Camera], grow: float = 0.5) -> list[Mask]:
    """What each view shows of it, 0 and 1. A voxel's cube reaches as far as its diagonal: half of it is the hull's own outline."""
    return [(shadow(hull, c, grow) > 0).astype(np.uint8) for c in cameras]


AROUND, LIKELY = 1, 2
"""What a pixel of a look shows: the common hull, its inside; 0 is neither."""
RIM = 3
"""Pixels at a look's border: the hull of coarse voxels is fat, and what is around the target would teach its colours."""


def _looks(masks: Sequence[Mask], shadows: Sequence[Mask]) -> list[Mask]:
    """Where each view shows the common hull; a view whose own mask is empty has only that to learn the target's colours from."""
    kernel = np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)
    inner = [cv2.erode(s, kernel) if m.any() else s for m, s in zip(masks, shadows, strict=True)]
    return [np.where(i > 0, LIKELY, np.where(s > 0, AROUND, 0)).astype(np.uint8) for i, s in zip(inner, shadows, strict=True)]


def _agreement(masks: Sequence[Mask], shadows: Sequence[Mask]) -> float:
    """Median over the views that show something of intersection over union of a mask and the common hull's shadow."""
    return float(np.median([(s & m).sum() / (s | m).sum() for s, m in zip(shadows, masks, strict=True) if m.any()]))


def _enlarged(mask: Mask, camera: Camera) -> Mask:
    smooth = cv2.resize(mask * np.uint8(255), (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    return np.where(cv2.GaussianBlur(smooth, (0, 0), 1.0) > 127, 255, 0).astype(np.uint8)
