"""The target in clips: foreground masks from clean plates or from a background learnt over the clip, agreed on by the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..config import BackgroundConfig, CarveConfig
from ..errors import require
from ..geometry.cameras import Camera
from ..io.images import reduce
from ..types import Bounds, Image, Track, no_track
from .visual_hull import large_parts, supported

Mask = NDArray[np.uint8]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Background:
    """What a camera sees without the target.

    plate : (h, w, 3) uint8. known : (h, w) bool, where the plate is sure. region : (h, w) bool, where the target may appear at all.
    """

    plate: Image
    known: Bool
    region: Bool

    @classmethod
    def from_plate(cls, plate: Image) -> Background:
        """From a clean plate: known everywhere."""
        everywhere = np.ones(plate.shape[:2], bool)
        return cls(plate, everywhere, everywhere)


def _disc(side: int) -> Mask:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def _local(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    return np.asarray(cv2.blur(values, (side, side)), np.float32)


@dataclass(frozen=True)
class _Evidence:
    """Per pixel: foreground, surely background."""

    changed: Bool
    background: Bool


def _evidence(image: Image, background: Background, config: BackgroundConfig) -> _Evidence:
    """Compares a frame with the plate; light and shadow change a surface's brightness but not its pattern.

    Where the plate or the frame has a pattern, correlation of logarithms over a window tells a shadow from a thing; elsewhere the usual
    test on brightness and hue does.
    """
    now, plate = image.astype(np.float32), background.plate.astype(np.float32)
    difference = cv2.GaussianBlur(np.abs(now - plate).max(2), (0, 0), 1.0)
    # The quietest quarter of the picture is surely background: about one standard deviation of its noise.
    noise = float(np.quantile(difference[background.known], 0.25)) if background.known.any() else 0.0
    least = max(config.threshold, 3 * noise)
    ratio = (_local(now, 5) + 4) / (_local(plate, 5) + 4)
    brightness = ratio.mean(2)
    hue = np.abs(ratio - brightness[..., None]).max(2) / brightness
    side = config.window
    logs = [np.log(v.mean(2) + 8) for v in (now, plate)]
    means = [_local(v, side) for v in logs]
    spread = [np.maximum(_local(v * v, side) - m * m, 0) for v, m in zip(logs, means, strict=True)]
    common = _local(logs[0] * logs[1], side) - means[0] * means[1]
    correlation = common / np.sqrt(spread[0] * spread[1] + 1e-12)
    # Grey levels of noise are a share of the brightness.
    patterned = np.zeros(correlation.shape, bool)
    for s, m in zip(spread, means, strict=True):
        patterned |= s > 4 * (config.noise / np.exp(m)) ** 2
    lit = (brightness > 0.12) & (brightness < 1.3) & (hue < 0.35)
    plain = (brightness > 0.3) & (brightness < 1.08) & (hue < 0.12)
    relit = lit & np.where(patterned, correlation > config.correlation, plain)
    unchanged = difference < 0.5 * least
    sure = unchanged | (relit & (correlation > 0.75))
    return _Evidence(((difference > least) & ~relit | ~background.known) & background.region, sure & background.known | ~background.region)


def _cleaned(mask: Mask, config: BackgroundConfig) -> Mask:
    """Without specks, closed, parts of some size only."""
    mask = cv2.morphologyEx(cv2.medianBlur(mask, 5), cv2.MORPH_OPEN, _disc(3))
    return large_parts(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(9)), config.least_part)


Models = tuple[NDArray[np.float64], NDArray[np.float64]]
"""GrabCut's colour mixtures, (1, 65) float64 each: of the background and of the target."""


def _cut(image: Image, rough: Mask, background: Bool, unknown: Bool, rounds: int) -> tuple[Mask, Models | None]:
    """GrabCut around a rough mask (0 and 1): its border settles on the image's edges; where nothing is known colours decide.

    Also the colours that it found, None where it had nothing to go by.
    """
    if not rough.any():
        return rough, None
    y, x = np.nonzero(rough)
    pad = 24
    window = np.s_[max(0, y.min() - pad) : y.max() + pad, max(0, x.min() - pad) : x.max() + pad]
    inner, near = cv2.erode(rough, _disc(9)), cv2.dilate(rough, _disc(13))
    labels = np.where(rough > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[background | (near == 0)] = cv2.GC_BGD
    labels[(inner > 0) & ~unknown] = cv2.GC_FGD
    # Colours of the target are those of what surely differs; what is unknown starts as background if that is most of the mask.
    if (unknown & (rough > 0)).sum() > 0.3 * np.count_nonzero(rough):
        labels[unknown & (labels == cv2.GC_PR_FGD)] = cv2.GC_PR_BGD
    labels = np.ascontiguousarray(labels[window])
    # Colour models need both kinds.
    if not ((labels & 1) == 0).any() or not ((labels & 1) == 1).any():
        return rough, None
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)  # its k-means: the same mask each time
    cv2.grabCut(np.ascontiguousarray(image[window]), labels, None, *models, rounds, cv2.GC_INIT_WITH_MASK)
    out = np.zeros_like(rough)
    out[window] = labels & 1
    return out, models


def _likelihood(pixels: NDArray[np.float64], model: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithm of a mixture's density at colours (n, 3)."""
    weights, means, spreads = model[0, :5], model[0, 5:20].reshape(5, 3), model[0, 20:].reshape(5, 3, 3)
    total = np.zeros(len(pixels))
    for weight, mean, spread in zip(weights, means, spreads, strict=True):
        if weight <= 0:
            continue
        spread = spread + NOISE_FLOOR * np.eye(3)
        away = pixels - mean
        distance = np.einsum("ni,ij,nj->n", away, np.linalg.inv(spread), away)
        total += weight * np.exp(-0.5 * distance) / np.sqrt(np.linalg.det(spread))
    return np.log(total + 1e-30)


NOISE_FLOOR = 4.0
"""Squared grey levels: mixtures of few pixels are narrower than a camera's noise."""


def _agreed(image: Image, cut: Mask, seen: Mask, open_: Bool, models: Models | None) -> Mask:
    """The mask with what all other cameras have for target, where this one cannot know and the colour is rather the target's."""
    doubtful = (seen > 0) & open_ & (cut == 0)
    if models is None or not doubtful.any():
        return cut
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    pixels = smooth[doubtful].astype(np.float64)
    likely = np.zeros_like(cut)
    likely[doubtful] = _likelihood(pixels, models[1]) - _likelihood(pixels, models[0]) > 0
    likely = cv2.morphologyEx(cut | likely, cv2.MORPH_OPEN, _disc(7))
    return cut | likely


def _at(background: Background, size: tuple[int, int]) -> Background:
    if background.plate.shape[1::-1] == size:
        return background
    known, region = (
        cv2.resize(m.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for m in (background.known, background.region)
    )
    return Background(cv2.resize(background.plate, size, interpolation=cv2.INTER_AREA), known, region)


def foreground(
    images: Sequence[Image],
    cameras: Sequence[Camera],
    backgrounds: Sequence[Background],
    bounds: Bounds | None = None,
    config: BackgroundConfig | None = None,
    carving: CarveConfig | None = None,
) -> list[Mask]:
    """The target's masks at one instant.

    Parameters
    ----------
    images : undistorted (h, w, 3) uint8, one a camera, with its background.
    bounds : (2, 3) world: where targets are; foreground whose ray meets nothing there that the other cameras support is noise.

    Returns
    -------
    (h, w) uint8 of 0 and 255, one a camera.
    """
    config, carving = config or BackgroundConfig(), carving or CarveConfig()
    require(len(images) == len(cameras) == len(backgrounds), "backgrounds", f"{len(images)}, one an image", len(backgrounds))
    small, reduced, found, unknown = [], [], [], []
    for n, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        picture, at = reduce(image, camera, config.max_size)
        small.append(picture)
        reduced.append(at)
        background = _at(backgrounds[n], (at.width, at.height))
        found.append(_evidence(picture, background, config))
        unknown.append(~background.known)
    rough = [_cleaned(e.changed.astype(np.uint8), config) for e in found]
    outside = [e.background for e in found]
    if bounds is not None and len(images) > 2:
        # Masks grow a little first: what one camera misses by a pixel must not cost the others theirs.
        seen = supported([cv2.dilate(r, _disc(7)) for r in rough], reduced, bounds, carving, carving.tolerance)
        rough = [large_parts(r & (s > 0), config.least_part) for r, s in zip(rough, seen, strict=True)]
        outside = [o | (s == 0) for o, s in zip(outside, seen, strict=True)]
    found_cuts = [_cut(p, r, o, u, config.cut_rounds) for p, r, o, u in zip(small, rough, outside, unknown, strict=True)]
    cuts = [large_parts(c, config.least_part) for c, _ in found_cuts]
    if bounds is not None and len(images) > 2 and any(u.any() for u in unknown):
        seen = supported([cv2.dilate(c, _disc(3)) for c in cuts], reduced, bounds, carving, 0.0, len(images) - 1)
        sure = [s if (s == 0).any() else np.zeros_like(s) for s in seen]  # the others have nothing in common
        told = zip(small, cuts, sure, found, unknown, found_cuts, strict=True)
        cuts = [large_parts(_agreed(p, c, s, u & ~e.background, m), config.least_part) for p, c, s, e, u, (_, m) in told]
    masks = []
    for cut, image in zip(cuts, images, strict=True):
        h, w = image.shape[:2]
        mask = cut * np.uint8(255)
        if mask.shape != (h, w):
            mask = np.where(cv2.resize(mask, (w, h), interpolation=cv2.INTER_LINEAR) > 127, 255, 0).astype(np.uint8)
        masks.append(mask)
    return masks


def learn_backgrounds(
    frames: Sequence[Sequence[Image]],
    cameras: Sequence[Camera],
    bounds: Bounds | None = None,
    config: BackgroundConfig | None = None,
    carving: CarveConfig | None = None,
    track: Track = no_track,
) -> list[Background]:
    """What stands behind a moving target, from samples of the clip without a clean plate.

    The plate is each pixel's most frequent colour. Where the target stays for most of the clip, that is the target itself: colours
    learnt from what moves (GrabCut's mixtures) tell these places, and the cameras must agree on them; they become unknown and count as
    target. OpenCV's MOG2 has a say in what moves; it drops shadows.

    Parameters
    ----------
    frames : (cameras, samples): undistorted (h, w, 3) uint8, spread over the clip.
    bounds : (2, 3) world: where targets are.

    Returns
    -------
    One a camera, with the longer side at most ``config.max_size`` pixels.
    """
    config, carving = config or BackgroundConfig(), carving or CarveConfig()
    require(all(len(f) >= 3 for f in frames), "frames", "at least 3 samples a camera", min(map(len, frames)))
    plates, regions, ghosts, still, usual, reduced = [], [], [], [], [], []
    for samples, camera in track(zip(frames, cameras, strict=True), "background", len(cameras)):
        pairs = [reduce(f, camera, config.learn_size) for f in samples]
        small = np.stack([p[0] for p in pairs])
        plate, region = _commonest(small, config), _moving(small, config)
        changed = np.stack([cv2.absdiff(s, plate).max(2) > 2 * config.threshold for s in small]).mean(0)
        ghosts.append(_ghost(small, plate, region, config))
        usual.append(((ghosts[-1] > 0) | (changed > 0.4)).astype(np.uint8))
        still.append((changed < 0.4) & (_widened(region) > 0))
        regions.append(_widened(region))
        reduced.append(pairs[0][1])
        plates.append(_commonest(np.stack([reduce(f, camera, config.max_size)[0] for f in samples]), config))
    if bounds is not None and len(cameras) > 2:
        # A place where the target usually is looks so to every camera; one that took it for background is overruled by all the others.
        seen = supported([cv2.dilate(u, _disc(5)) for u in usual], reduced, bounds, carving, 0.0, len(cameras) - 1)
        sure = [(s > 0) & s.any() & ~(s > 0).all() for s in seen]
        ghosts = [((g > 0) | t) & s if s.any() else g > 0 for g, t, s in zip(ghosts, still, sure, strict=True)]
    found = []
    for plate, region, ghost in zip(plates, regions, ghosts, strict=True):
        h, w = plate.shape[:2]
        hidden, around = (cv2.resize(np.asarray(m, np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0 for m in (ghost, region))
        found.append(Background(plate, ~hidden, around | hidden))
    if bounds is None or len(cameras) < 3 or all(f.known.all() for f in found):
        return found
    return _uncovered(frames, cameras, found, bounds, config, carving)


def _uncovered(
    frames: Sequence[Sequence[Image]],
    cameras: Sequence[Camera],
    backgrounds: Sequence[Background],
    bounds: Bounds,
    config: BackgroundConfig,
    carving: CarveConfig,
) -> list[Background]:
    """Backgrounds with what is seen behind the target at the samples at which, as the other cameras have it, it is elsewhere."""
    quick = replace(config, max_size=config.learn_size)
    free: list[list[Bool]] = [[] for _ in cameras]
    for sample in zip(*frames, strict=True):
        pairs = [reduce(f, c, config.learn_size) for f, c in zip(sample, cameras, strict=True)]
        small, reduced = [p[0] for p in pairs], [p[1] for p in pairs]
        masks = foreground(small, reduced, backgrounds, bounds, quick, carving)
        seen = supported([cv2.dilate(m, _disc(5)) for m in masks], reduced, bounds, carving, 0.0, len(cameras) - 1)
        for n, (m, s) in enumerate(zip(masks, seen, strict=True)):
            free[n].append(cv2.dilate(m | s, _disc(5)) == 0)
    found = []
    for own, camera, background, places in zip(frames, cameras, backgrounds, free, strict=True):
        samples = np.stack([reduce(f, camera, config.max_size)[0] for f in own])
        h, w = background.known.shape
        open_ = np.stack([cv2.resize(p.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0 for p in places])
        learnt = ~background.known & (open_.sum(0) >= LEAST_SAMPLES)
        plate = np.where(learnt[..., None], _commonest(samples, config, open_), background.plate)
        found.append(Background(np.ascontiguousarray(plate, np.uint8), background.known | learnt, background.region))
    return found


LEAST_SAMPLES = 3
"""Samples that must show a place without the target before its background counts as known."""


def _commonest(samples: NDArray[np.uint8], config: BackgroundConfig, valid: Bool | None = None) -> Image:
    """The colour of each pixel that the most samples are near to: their mean. Samples that are not ``valid`` there do not count."""
    plate = np.empty(samples.shape[1:], np.uint8)
    for y in range(len(plate)):  # a row at a time: all pairs of samples would be large
        row = samples[:, y].astype(np.int16)
        near = np.abs(row[:, None] - row[None]).max(-1) < config.threshold
        if valid is not None:
            near &= valid[:, None, y] & valid[None, :, y]
            near |= np.eye(len(row), dtype=bool)[..., None]  # of itself a sample is always near
        best = near.sum(1).argmax(0)
        mine = np.take_along_axis(near, best[None, None], 0)[0]
        plate[y] = np.rint((row * mine[..., None]).sum(0) / mine.sum(0)[:, None])
    return plate


def _moving(samples: NDArray[np.uint8], config: BackgroundConfig) -> Mask:
    """Where the target is at some time: what changes over the samples, closed and filled; 0 and 1."""
    smooth = np.stack([cv2.GaussianBlur(s, (0, 0), 1.2) for s in samples])
    low, high = np.quantile(smooth, [0.04, 0.96], axis=0)
    mog = cv2.createBackgroundSubtractorMOG2(history=len(samples), detectShadows=True)
    for s in smooth:
        mog.apply(s)
    often = sum((mog.apply(s, learningRate=0) == 255).astype(int) for s in smooth)
    changes = ((high - low).max(-1) > 1.8 * config.threshold) | (often > 0.1 * len(samples))
    region = cv2.morphologyEx(changes.astype(np.uint8), cv2.MORPH_OPEN, _disc(3))
    region = large_parts(cv2.morphologyEx(region, cv2.MORPH_CLOSE, _disc(21)), 0.1)
    outer = np.pad(region, 1)
    cv2.floodFill(outer, None, (0, 0), 2)
    return cv2.dilate((outer[1:-1, 1:-1] != 2).astype(np.uint8), _disc(5))


def _widened(region: Mask) -> Mask:
    """The region with what adjoins it: parts of a target may stand still."""
    return cv2.dilate(region, _disc(2 * round(0.03 * max(region.shape)) + 1))


def _ghost(samples: NDArray[np.uint8], plate: Image, region: Mask, config: BackgroundConfig) -> Mask:
    """Where the plate shows the target, 0 and 1: by the colours of what differs from it in the samples."""
    wide = _widened(region)
    chosen = samples[:: max(1, len(samples) // GHOST_SAMPLES)]
    frames, labels = [], []
    for sample in chosen:
        difference = cv2.GaussianBlur(cv2.absdiff(sample, plate).max(2), (0, 0), 0.8)
        label = np.where(wide > 0, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
        label[(region > 0) & (difference > 2.5 * config.threshold)] = cv2.GC_PR_FGD
        frames.append(sample)
        labels.append(label)
    together = np.concatenate(labels)
    if not (together & 1).any() or (together & 1).all():
        return np.zeros_like(region)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)
    # One image of all samples has one mixture a kind; a single round, as more of them drift from what was seen to move.
    cv2.grabCut(np.concatenate(frames), together, None, *models, 1, cv2.GC_INIT_WITH_MASK)
    label = np.where(wide > 0, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    cv2.grabCut(plate, label, None, *models, 1, cv2.GC_EVAL_FREEZE_MODEL)
    return cv2.dilate(label & 1, _disc(5))


GHOST_SAMPLES = 10
"""Samples from which the target's colours are learnt."""
