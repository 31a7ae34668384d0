"""Where the images and masks of a calibration lie.

Searched are the calibration's folder and those above it up to the data set's root: the folder that the caller named, or
the one above ``sparse/0``, ``colmap``, ``dense/0``, ``cams`` and the like. In each of them the usual image folders
(``images``, ``images_2``, ``rgb`` ..), then the folder itself, then any other folder in the root. One folder serves all
views: the first that holds all images, else the one that holds most.

A path that a file names is followed where it leads into the data set's root or into a usual image or mask folder beside
that root (``run1/transforms.json`` with ``../images/a.jpg``), judged by its text: links are the caller's own. Any other is
refused unless the caller allows it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from ...errors import FormatError
from ..pairing import natural_order, pair_by_name

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".exr", ".heic", ".heif")
SUFFIXES = (*IMAGE_SUFFIXES, *(s.upper() for s in IMAGE_SUFFIXES))
IMAGE_FOLDERS = ("images", "image", "input", "rgb", "color", "photos", "frames", "blended_images", "undistorted", "undistorted_images")
"""Usual names of folders of images, the surest first."""
MASK_FOLDERS = ("masks", "mask", "silhouettes", "mattes")
INNER = ("sparse", "dense", "colmap", "distorted", "cams", "cams_1", "cameras", "calibration", "bundle", "opensfm")
"""Folders of a calibration inside a data set."""
REDUCED = re.compile(r"images?_\d+")
"""``images_2``: the same images at a half of their size."""
NOT_IMAGES = re.compile(r"mask|depth|label|conf|normal|segment|silhouette|matte|^\.|^out", re.IGNORECASE)
"""Names of folders that hold other maps with the images' names."""
MOST_FILES = 200_000
"""Files of one folder that are looked at."""
DEPTH = 4
"""Levels of folders below an image folder that are searched."""


@dataclass(frozen=True)
class Wanted:
    """An image that a calibration speaks of: the path in the file, if any, and the view's name."""

    path: Path | None
    name: str


@dataclass(frozen=True)
class Places:
    """base : the calibration's folder. root : of the data set. images : the caller's own folder of images."""

    base: Path
    root: Path
    images: Path | None = None
    allow_outside: bool = False

    @property
    def levels(self) -> list[Path]:
        """From the calibration's folder up to the root."""
        levels = [self.base]
        while levels[-1] != self.root and self.root in levels[-1].parents:
            levels.append(levels[-1].parent)
        return levels

    def absolute(self, path: Path | None) -> Path | None:
        """A path of the file as an absolute one."""
        return None if path is None else _plain(self.base / path)

    def inside(self, path: Path) -> bool:
        """Whether a path may be followed."""
        if self.allow_outside:
            return True
        path = _plain(path)
        if any(path.is_relative_to(_plain(p)) for p in (self.root, self.images) if p):
            return True
        beside = _plain(self.root).parent
        first = path.relative_to(beside).parts[:1] if path.is_relative_to(beside) else ()
        return bool(first) and (first[0].lower() in (*IMAGE_FOLDERS, *MASK_FOLDERS) or bool(REDUCED.fullmatch(first[0])))


def places(source: Path, given: Path | None = None, images: Path | None = None, allow_outside: bool = False) -> Places:
    """The places of a calibration (file or folder); ``given`` is the path that the caller named."""
    base = source if source.is_dir() else source.parent
    root = dataset_root(base)
    if given is not None and given.is_dir() and (given == root or given in root.parents):
        root = given
    return Places(base, root, images, allow_outside)


def dataset_root(folder: Path) -> Path:
    """The folder above those that only hold a calibration: ``sparse/0``, ``colmap`` and so on."""
    while True:
        name = folder.name.lower()
        if name in INNER or (name.isdigit() and folder.parent.name.lower() in INNER):
            folder = folder.parent
        else:
            return folder


def find_images(wanted: Sequence[Wanted], at: Places) -> tuple[list[Path | None], list[str]]:
    """The file of each image, None where there is none, and warnings.

    Raises
    ------
    FormatError
        A path that leads out of the data set, or several images for a view.
    """
    if at.images is not None:
        return _in_folder(wanted, at.images)
    direct = [_followed(w, at) for w in wanted]
    if any(direct):
        _refuse_outside(wanted, direct, at)
        return direct, []
    files, warnings = _searched(wanted, at)
    _refuse_outside(wanted, files, at, elsewhere=any(files))
    return files, warnings


def find_masks_of(images: Sequence[Path | None], at: Places) -> list[Path | None]:
    """The mask of each image in a usual folder of masks, None where there is none."""
    names = [_inner(i) if i else PurePath(f"{n}: no image") for n, i in enumerate(images)]
    for level in at.levels:
        for folder in (level / name for name in MASK_FOLDERS):
            try:
                pairs = pair_by_name(names, images_below(folder), "mask", partial=True, exact=True) if folder.is_dir() else []
            except FormatError:
                continue
            if any(pairs):
                return pairs
    return [None] * len(images)


def images_below(folder: Path) -> list[Path]:
    """The images in a folder and, some levels deep, in its folders, in natural order; hidden ones apart."""
    files = []
    for place, folders, names in os.walk(folder, followlinks=True):
        depth = len(Path(place).relative_to(folder).parts)
        folders[:] = [] if depth >= DEPTH else [f for f in folders if not f.startswith(".")]
        files += [Path(place, n) for n in names if n.lower().endswith(IMAGE_SUFFIXES) and not n.startswith(".")]
        if len(files) > MOST_FILES:
            raise FormatError(f"{folder}: expected at most {MOST_FILES} images")
    return sorted(files, key=lambda p: [natural_order(PurePath(part)) for part in p.relative_to(folder).parts])


def no_images(wanted: Sequence[Wanted], at: Places) -> FormatError:
    """What to say where none of the images exists."""
    name = next((str(w.path) for w in wanted if w.path), None)
    what = f"image {name!r} does not exist" if name else "does not say where its images are"
    texts = [p for level in at.levels for n in IMAGE_FOLDERS if (p := level / n).is_file() and p.stat().st_size < 4096]
    if texts:
        target = texts[0].read_text(errors="replace").strip()
        what += f"; {texts[0]} is no folder but a file with the text {target[:200]!r}, a link that was not restored"
    return FormatError(f"{at.base}: {what}; looked in {at.root} and its folders; name the folder with images=DIR (--images DIR)")


def named(folder: Path, *names: str) -> Path | None:
    """The first of the names that is a file in a folder, whatever its case; None where there is none."""
    for name in names:
        if (folder / name).is_file():
            return folder / name
    try:
        there = {n.lower(): folder / n for n in sorted(os.listdir(folder))}
    except OSError:
        return None
    return next((there[n.lower()] for n in names if n.lower() in there and there[n.lower()].is_file()), None)


def _plain(path: Path) -> Path:
    return Path(os.path.normpath(path))


def _text(path: Path | str) -> PurePath:
    """A path as any system writes it, without what leads upwards or to another disk."""
    parts = [p for p in str(path).replace("\\", "/").split("/") if p not in ("", ".", "..") and not p.endswith(":")]
    return PurePath(*parts)


def _inner(image: Path) -> PurePath:
    """An image's path from its image folder on."""
    parts = image.parts
    start = max((n for n, p in enumerate(parts[:-1]) if p.lower() in IMAGE_FOLDERS or REDUCED.fullmatch(p)), default=len(parts) - 2)
    return PurePath(*parts[start + 1 :])


def _followed(wanted: Wanted, at: Places) -> Path | None:
    """The file under the very path that the calibration names; suffixes may be left out, as NeRF does."""
    if wanted.path is None:
        return None
    path = _plain(at.base / wanted.path)
    if not at.inside(path):
        return None
    return with_suffix(path)


def with_suffix(path: Path) -> Path | None:
    """An image's path as it is, or with a usual suffix added; None where there is no such file."""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return path if _is_file(path) else None
    text = str(path)
    return next((Path(text + s) for s in SUFFIXES if os.path.isfile(text + s)), None) if path.name else None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that no file system takes
        return False


def _refuse_outside(wanted: Sequence[Wanted], files: Sequence[Path | None], at: Places, elsewhere: bool = False) -> None:
    """Only absolute paths of another machine are passed over, where images were found ``elsewhere`` under their names."""
    for w, file in zip(wanted, files, strict=True):
        if file is not None or w.path is None or at.inside(at.base / w.path) or (elsewhere and ".." not in w.path.parts):
            continue
        raise FormatError(
            f"{at.base}: image {str(w.path)!r} lies outside {at.root}; allow it with allow_outside=True (--allow-outside), "
            "or name the folder of the images with images=DIR (--images DIR)"
        )


def _names(wanted: Sequence[Wanted]) -> list[PurePath]:
    return [_text(w.path or w.name or f"view {n}") for n, w in enumerate(wanted)]


def _in_folder(wanted: Sequence[Wanted], folder: Path) -> tuple[list[Path | None], list[str]]:
    """In the caller's folder: by name, by number, or, where the file names no images, in natural order or by cameras' folders."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of images")
    if pairs := _camera_folders(wanted, folder):
        return pairs, []
    files = images_below(folder)
    if not files:
        raise FormatError(f"{folder}: no images")
    unnamed = all(w.path is None for w in wanted)
    try:
        pairs = pair_by_name(_names(wanted), files, "image", partial=True, in_order=unnamed)
    except FormatError as error:
        raise FormatError(f"{folder}: {error}") from None
    return pairs, _in_order(wanted, pairs)


def _searched(wanted: Sequence[Wanted], at: Places) -> tuple[list[Path | None], list[str]]:
    best: list[Path | None] = [None] * len(wanted)
    names = _names(wanted)
    for folder in _folders(at):
        if pairs := _camera_folders(wanted, folder):
            return pairs, []
        try:
            files = images_below(folder) if folder not in at.levels else _images_in(folder)
            pairs = pair_by_name(names, files, "image", partial=True, exact=True) if files else []
        except FormatError:
            continue
        if all(pairs) and pairs:
            return pairs, []
        if sum(p is not None for p in pairs) > sum(p is not None for p in best):
            best = pairs
    if not any(best) and all(w.path is None for w in wanted):
        for folder in _folders(at):
            files = _images_in(folder)
            if len(files) == len(wanted):
                pairs = pair_by_name(names, files, "image")
                return pairs, _in_order(wanted, pairs)
    return best, []


def _folders(at: Places) -> list[Path]:
    """Folders that may hold the images, the surest first."""
    usual, rest = [], []
    for level in at.levels:
        inner = {p.name.lower(): p for p in sorted(level.iterdir()) if p.is_dir()}
        usual += [inner[n] for n in IMAGE_FOLDERS if n in inner]
        usual += sorted((p for n, p in inner.items() if REDUCED.fullmatch(n)), key=natural_order)
        usual.append(level)
        rest += [p for n, p in inner.items() if p not in usual and p not in at.levels and not NOT_IMAGES.search(n)]
    return usual + rest


def _images_in(folder: Path) -> list[Path]:
    names = [f for f in folder.iterdir() if f.name.lower().endswith(IMAGE_SUFFIXES) and not f.name.startswith(".")]
    return sorted(names, key=natural_order)


def _camera_folders(wanted: Sequence[Wanted], folder: Path) -> list[Path | None]:
    """The one image in each camera's folder; empty where not every camera has a folder."""
    if any(w.path is not None or not w.name or _text(w.name) == PurePath() for w in wanted):
        return []
    folders = [folder / _text(w.name) for w in wanted]
    if not all(f.is_dir() for f in folders):
        return []
    files = [images_below(f) for f in folders]
    if not all(files):
        return []
    for f, inside in zip(folders, files, strict=True):
        if len(inside) > 1:
            raise FormatError(f"{f}: expected one image of a camera, got {len(inside)}; several instants are a clip (mvcore video)")
    return [f[0] for f in files]


def _in_order(wanted: Sequence[Wanted], pairs: Sequence[Path | None]) -> list[str]:
    """A warning where a pair's names have nothing in common."""
    names = _names(wanted)
    strange = [(n, p) for n, p in zip(names, pairs, strict=True) if p and n.stem.casefold() not in p.name.casefold()]
    if not strange:
        return []
    shown = ", ".join(f"{n.name}: {p.name}" for n, p in strange[:3])
    return [f"images paired by number or in order, as their names differ from the cameras' ({shown}{' ..' if len(strange) > 3 else ''})"]
