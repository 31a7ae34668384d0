"""What every reader returns, and the checks that turn it into a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FormatError, InvalidInputError
from ...geometry.cameras import Calibration, Camera, same_shape
from ...types import Bounds
from ..decode import Header, decode, read_header
from ..limits import read_text
from ..scene import Scene
from .places import IMAGE_SUFFIXES, Places, Wanted, find_images, find_masks_of, no_images, places, with_suffix

__all__ = ["IMAGE_SUFFIXES", "Found", "Lines", "Record", "image_in", "image_size", "to_scene"]

FAR = 0.5
"""Principal points farther from the image's centre, in half its sides, belong to another image size or a mistake."""
FACTORS = (2, 3, 4, 6, 8)
"""Factors by which networks' data sets reduce K but not the images."""
MOST_LINES = 1 << 30
"""Bytes of a text file of lines: COLMAP writes every image's points."""
ALPHAS = 8
"""Images of a set in which transparency is looked for."""


@dataclass(frozen=True)
class Record:
    """One view as a file describes it.

    ``image`` and ``mask`` are paths as the file names them, relative to its folder, or absolute; None where it names none: the
    image is then sought by ``name``. A size of 0 is taken from the image. K and the distortion may be functions of (width, height),
    where they depend on them.
    """

    K: Any
    R: Any
    t: Any
    width: int = 0
    height: int = 0
    image: Path | None = None
    mask: Path | None = None
    name: str = ""
    distortion: Sequence[float] | Callable[[int, int], Sequence[float]] = ()
    fisheye: bool = False
    line: int = 0


@dataclass(frozen=True)
class Found:
    """A file's views, with the box of the target where it names one; ``mirrored``: the world was reflected (`Calibration`)."""

    records: list[Record]
    source: Path
    bounds: Bounds | None = None
    format: str = ""
    warnings: tuple[str, ...] = ()
    mirrored: bool = False


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from an image file's header."""
    header = read_header(path)
    return header.width, header.height


def image_in(folder: Path, stem: str) -> Path | None:
    """The image ``stem`` with any known suffix in a folder, its ``images`` or its ``image`` folder."""
    return next((p for base in (folder, folder / "images", folder / "image") if (p := with_suffix(base / stem))), None)


def to_scene(
    found: Found,
    need_images: bool = True,
    *,
    images: Path | None = None,
    allow_outside: bool = False,
    given: Path | None = None,
) -> Scene:
    """Checked cameras and frames.

    Parameters
    ----------
    need_images : False reads the cameras alone; frames are then the paths that exist, or None.
    images : folder of the images, where the calibration does not say or is wrong.
    allow_outside : follow paths of the file that lead out of the data set (`places`).
    given : the path that the caller named.

    Raises
    ------
    FormatError
        No views, no images, an image of another shape, or values that make no camera; with path and line.
    """
    if not found.records:
        raise FormatError(f"{found.source}: no views")
    at = places(found.source, given, images, allow_outside)
    records, messages = _with_images(found.records, at, need_images)
    fitted = [_fitted(record, _where(found, record), need_images) for record in records]
    cameras = [_camera(record, _where(found, record)) for record, _ in fitted]
    messages += _said(found, fitted)
    masks, alpha = _masks(records, at, messages) if need_images else ([at.absolute(r.mask) for r in records], False)
    if found.mirrored:
        messages.append(MIRRORED)
    return Scene(
        frames=tuple(record.image for record in records),  # type: ignore[arg-type]
        calib=Calibration(tuple(cameras), str(found.source), found.mirrored),
        masks=tuple(masks) if any(masks) else None,
        bounds=found.bounds,
        format=found.format,
        warnings=(*found.warnings, *messages),
        alpha=alpha,
    )


MIRRORED = (
    "the calibration's world is mirrored (left-handed: its projection matrices have negative determinants with the target in "
    "front): its reflection in z is reconstructed, and the result is reflected back"
)


def _where(found: Found, record: Record) -> str:
    return f"{found.source}:{record.line}" if record.line else str(found.source)


def _with_images(records: Sequence[Record], at: Places, need: bool) -> tuple[list[Record], list[str]]:
    """The records whose image exists, with its path; with ``need`` False all records."""
    wanted = [Wanted(r.image, r.name) for r in records]
    try:
        files, messages = find_images(wanted, at)
    except (FormatError, FileNotFoundError):
        if need or at.images is not None:
            raise
        files, messages = [None] * len(records), []
    if not need:
        return [replace(r, image=f or at.absolute(r.image)) for r, f in zip(records, files, strict=True)], messages
    if not any(files):
        raise no_images(wanted, at)
    if gone := [str(w.path or w.name) for w, f in zip(wanted, files, strict=True) if f is None]:
        shown = ", ".join(gone[:5]) + (" .." if len(gone) > 5 else "")
        messages.append(f"{len(gone)} of {len(records)} views left out, as their images do not exist: {shown}")
    return [replace(r, image=f) for r, f in zip(records, files, strict=True) if f is not None], messages


def _fitted(record: Record, where: str, need_images: bool) -> tuple[Record, str]:
    """A record at the size of its image, and what was done to it: ``"scaled 1280x852 320x213"``."""
    if record.width:
        record = _of_size(record, record.width, record.height)
    if record.image is None or not record.image.is_file():
        if not record.width:
            raise FormatError(f"{where}: the image size is not in the file, and image {str(record.image or record.name)!r} does not exist")
        return record, ""
    if record.width and not need_images:
        return record, ""
    header = read_header(record.image)
    size, want = (header.width, header.height), (record.width, record.height)
    if callable(record.K):
        return _of_size(record, *size), ""
    if not record.width:
        k, done = _scaled_principal_point(record.K, size)
        return replace(record, K=k, width=size[0], height=size[1]), done
    if size == want:
        return record, "EXIF stored" if header.orientation != 1 else ""
    if header.turned == want:
        return record, f"EXIF turned {header.orientation}"
    if same_shape(size, want):
        return _resized(record, where, size), f"scaled {want[0]}x{want[1]} {size[0]}x{size[1]}"
    raise FormatError(_other_shape(record, where, header))


def _of_size(record: Record, width: int, height: int) -> Record:
    """A record whose K and distortion, where they are functions, are those of a size."""
    k = record.K(width, height) if callable(record.K) else record.K
    distortion = record.distortion(width, height) if callable(record.distortion) else record.distortion
    return replace(record, K=k, distortion=distortion, width=width, height=height)


def _other_shape(record: Record, where: str, header: Header) -> str:
    turned = (
        " (turned by its EXIF orientation)" if header.orientation >= 5 and same_shape(header.turned, (record.width, record.height)) else ""
    )
    return (
        f"{where}: image {record.image.name if record.image else record.name} has {header.width} x {header.height} pixels{turned}, "
        f"its camera {record.width} x {record.height}"
    )


def _resized(record: Record, where: str, size: tuple[int, int]) -> Record:
    camera = _camera(record, where).resized(*size)
    return replace(record, K=camera.K, width=size[0], height=size[1])


def _scaled_principal_point(k: Any, size: tuple[int, int]) -> tuple[Any, str]:
    """K at the size of its image, where its principal point says that it is of one smaller by a whole factor."""
    try:
        matrix = np.array(k, np.float64)
        share = (2 * matrix[:2, 2] + 1) / size
    except (TypeError, ValueError, IndexError):
        return k, ""  # the camera's own check names it
    if not np.isfinite(share).all() or (np.abs(share - 1) <= FAR).all():
        return k, ""
    factor = next((f for f in FACTORS if (np.abs(share * f - 1) < 0.1).all()), 0)
    if not factor:
        return k, f"principal {matrix[0, 2]:.1f} {matrix[1, 2]:.1f}"
    scale = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
    return scale @ matrix, f"enlarged {factor}"


def _said(found: Found, fitted: Sequence[tuple[Record, str]]) -> list[str]:
    """Warnings, one a kind of adjustment."""
    kinds: dict[str, list[str]] = {}
    for record, done in fitted:
        if done:
            kinds.setdefault(done, []).append(record.image.name if record.image else record.name)
    messages = []
    for done, names in kinds.items():
        kind, *values = done.split()
        first = f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}"
        if kind == "scaled":
            messages.append(
                f"{first}: images have {values[1]} pixels, the calibration {values[0]}; taken as the same images at another size"
            )
        elif kind == "enlarged":
            messages.append(f"{first}: K is of images smaller by {values[0]}, as its principal point shows; scaled to the images")
        elif kind == "principal":
            messages.append(
                f"{first}: principal point ({values[0]}, {values[1]}) is far from the image's centre: is K of another image size?"
            )
        elif values[0] == "turned":
            messages.append(f"{first}: turned by the EXIF orientation {values[1]}, as the calibration's size is that of the turned image")
        else:
            messages.append(f"{first}: the EXIF orientation is not applied, as the calibration's size is that of the stored image")
    return messages


def _camera(record: Record, where: str) -> Camera:
    try:
        return Camera(
            K=record.K,
            R=record.R,
            t=record.t,
            width=record.width,
            height=record.height,
            distortion=np.asarray(record.distortion, np.float64),
            fisheye=record.fisheye,
            name=record.name or (record.image.name if record.image else ""),
        )
    except InvalidInputError as error:
        raise FormatError(f"{where}: {error}") from None
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{where}: camera {record.name!r}: {error}") from None


def _masks(records: Sequence[Record], at: Places, messages: list[str]) -> tuple[list[Path | None], bool]:
    """The masks that the file names or that lie in a usual folder, else the images' alpha; and whether it is alpha."""
    masks: list[Path | None] = []
    for record in records:
        path = None if record.mask is None else Path(at.base / record.mask)
        if path is not None and not at.inside(path):
            raise FormatError(f"{at.base}: mask {str(record.mask)!r} lies outside {at.root}; allow it with allow_outside=True")
        masks.append(path if path is None else with_suffix(path))
    gone = [str(r.mask) for r, m in zip(records, masks, strict=True) if r.mask is not None and m is None]
    if gone:
        messages.append(f"{len(gone)} masks do not exist: {gone[0]}{' ..' if len(gone) > 1 else ''}")
    if not any(masks):
        masks = find_masks_of([r.image for r in records], at)
    if any(masks):
        return masks, False
    clear = [r.image for r in records if r.image and read_header(r.image).alpha]
    chosen = [clear[n] for n in np.unique(np.linspace(0, len(clear) - 1, min(ALPHAS, len(clear))).astype(int))] if clear else []
    if not any(_transparent(p) for p in chosen):
        return masks, False
    messages.append(f"{len(clear)} of {len(records)} images have an alpha channel, which is taken for their mask")
    return [r.image if r.image in set(clear) else None for r in records], True


def _transparent(path: Path) -> bool:
    array = decode(path)
    return array.ndim == 3 and array.shape[2] == 4 and bool((array[..., 3] < array[..., 3].max()).any())


class Lines:
    """A text file's lines, with errors that name path and line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = read_text(path, MOST_LINES).splitlines()

    def fail(self, number: int, message: str) -> FormatError:
        """An error at a line (counted from 1)."""
        return FormatError(f"{self.path}:{number}: {message}")

    def numbers(self, number: int, count: int | None = None, text: str | None = None) -> list[float]:
        """The numbers of a line, ``count`` of them; of ``text`` where only a part of the line is numbers."""
        if number > len(self.lines):
            raise self.fail(len(self.lines), f"the file ends before line {number}")
        words = (self.lines[number - 1] if text is None else text).split()
        try:
            values = [float(w) for w in words]
        except ValueError as error:
            raise self.fail(number, f"expected numbers: {error!s:.80}") from None
        if count is not None and len(values) != count:
            raise self.fail(number, f"expected {count} numbers, got {len(values)}")
        if not np.isfinite(values).all():
            raise self.fail(number, "NaN or infinity")
        return values
