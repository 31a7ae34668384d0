"""A stereo calibration of OpenCV's `stereoCalibrate` in FileStorage files: K1 D1 K2 D2 R T in one file or in two.

X_2 = R X_1 + T; the first camera is the world; OpenCV axes, pixel centres at integers, the board's units. Names differ between samples
and tools, so their letters alone count: K1, M1, cameraMatrix1, camera_matrix_left, mtxL ..; D1, dist_coeffs_1, ..; R, T as matrix, vector
or list. OpenCV's samples/cpp/stereo_calib.cpp writes M1 D1 M2 D2 to intrinsics.yml and R T (and rectifications) to extrinsics.yml.
``fisheye_model`` (or ``fisheye``) other than 0 says that D are the coefficients of the fisheye model.

Source: OpenCV documentation, calib3d, stereoCalibrate and fisheye::stereoCalibrate.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .filestorage import read_filestorage
from .poses import read_rotation
from .records import Found, Record, image_in
from .values import Entry, files_in, head

SUFFIXES = (".yml", ".yaml", ".xml", ".json")
SNIFF = 1 << 16
"""Bytes that are searched for the names of the two matrices."""
NUMBER = r"[ \t]*[-+.]?[\d.]+(?:[eE][-+]?\d+)?[ \t]*(?:$|<)"
KEY = re.compile(rf"""^[ \t]*["<]?([A-Za-z]\w*)"?(?:[ \t]*:(?!{NUMBER})|[ \t]+\w|>(?!{NUMBER}))""", re.MULTILINE)
"""A name that does not stand before a single number: k1 may be a coefficient."""
MATRIX = ("k", "m", "cm", "mtx", "cameramatrix", "cammatrix", "intrinsic", "intrinsics", "intrinsicmatrix")
LENS = ("d", "dist", "dc", "distcoeffs", "distcoeff", "distcoef", "distortion", "distortioncoefficients", "distortioncoeffs")
SIDES = (("1", "left", "l"), ("2", "right", "r"))
FROM_ZERO = (("0",), ("1",))
"""Where there is no second camera 2, cameras may count from 0."""
ROTATION = ("r", "rotation", "rotationmatrix", "rot", "rvec", "om")
SHIFT = ("t", "translation", "translationvector", "trans", "tvec")
IMAGES = (("left", "im0", "view1", "cam0", "l", "0", "1"), ("right", "im1", "view5", "cam1", "r", "1", "2"))


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _pick(names: dict[str, str], bases: tuple[str, ...], sides: tuple[str, ...]) -> str | None:
    """The file's name for a value of one side."""
    return next((names[k] for b in bases for s in sides for k in (b + s, s + b) if k in names), None)


def _sides(names: dict[str, str]) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """How the file numbers its two cameras; None where it has no two camera matrices."""
    return next((sides for sides in (SIDES, FROM_ZERO) if all(_pick(names, MATRIX, s) for s in sides)), None)


def find(path: Path) -> Path | None:
    """A file with two camera matrices, in the folder or beside a file with R and T."""
    if path.is_dir():
        return next((f for f in files_in(path, *SUFFIXES) if _is_stereo(f)), None)
    if path.suffix.lower() not in SUFFIXES:
        return None
    if _is_stereo(path):
        return path
    keys = {_plain(k) for k in KEY.findall(head(path, SNIFF))}
    if keys & set(ROTATION) and keys & set(SHIFT) and not keys & set(MATRIX):
        return next((f for f in files_in(path.parent, *SUFFIXES) if _is_stereo(f)), None)
    return None


def _is_stereo(path: Path) -> bool:
    return _sides({_plain(k): k for k in KEY.findall(head(path, SNIFF))}) is not None


def read(path: Path) -> Found:
    """The first and the second view."""
    root = Entry(read_filestorage(path), path)
    names = {_plain(n): n for n, _ in root.items()}
    sides = _sides(names)
    if sides is None:
        raise root.fail("expected two camera matrices, such as K1 and K2")
    r, t = _motion(path, root)
    fisheye = next((root.need(n) for k, n in names.items() if k in ("fisheyemodel", "fisheye", "isfisheye")), None)
    is_fisheye = fisheye is not None and fisheye.flag()
    records = []
    for n, (rotation, shift) in enumerate(((np.eye(3), np.zeros(3)), (read_rotation(r), t.array(3)))):
        lens = _pick(names, LENS, sides[n])
        values = [] if lens is None or root.get(lens) is None else root.need(lens).numbers()
        if is_fisheye and len(values) != 4:
            raise root.fail(f"{lens or 'D'}: expected 4 coefficients of the fisheye model, got {len(values)}")
        matrix = root.need(_pick(names, MATRIX, sides[n]) or "").array(3, 3)
        image = _image(path.parent, n)
        name = image.name if image is not None else ("left", "right")[n]
        lens_values = values if is_fisheye or any(values) else ()
        records.append(Record(matrix, rotation, shift, *_size(root, names), image, name=name, distortion=lens_values, fisheye=is_fisheye))
    return Found(records, path)


def _image(folder: Path, side: int) -> Path | None:
    return next((i for name in IMAGES[side] if (i := image_in(folder, name)) is not None), None)


def _motion(path: Path, root: Entry) -> tuple[Entry, Entry]:
    """R and T, from the file itself or another beside it."""
    for file in [path, *(f for f in files_in(path.parent, *SUFFIXES) if f != path)]:
        keys = {_plain(k): k for k in KEY.findall(head(file, SNIFF))} if file != path else {}
        if file != path and not (set(keys) & set(ROTATION) and set(keys) & set(SHIFT)):
            continue
        entry = root if file == path else Entry(read_filestorage(file), file)
        names = {_plain(n): n for n, v in entry.items() if v.value is not None}
        r, t = (next((entry.need(names[k]) for k in keys if k in names), None) for keys in (ROTATION, SHIFT))
        if r is not None and t is not None:
            return r, t
    raise root.fail("R and T of the second camera missing, here and in the files beside it")


def _size(root: Entry, names: dict[str, str]) -> tuple[int, int]:
    both = next((root.need(names[k]) for k in ("imagesize", "size", "imgsize", "resolution") if k in names), None)
    if both is not None and len(both.numbers()) == 2:
        width, height = (Entry(v, both.source, both.key).pixels() for v in both.numbers())
        return width, height
    width, height = (root.get(*(names[k] for k in ks if k in names)) for ks in (("imagewidth", "width"), ("imageheight", "height")))
    return (width.pixels(), height.pixels()) if width is not None and height is not None else (0, 0)
