"""Agisoft Metashape and PhotoScan: ``cameras.xml`` (File, Export, Export Cameras).

Camera-to-chunk 4 x 4 with axes x right, y down, z forward; the chunk's (or its component's) transform (rotation, translation,
scale) leads on to the world. The centre of the top-left pixel is (0.5, 0.5); cx and cy are offsets from the image's centre:

    x' = x (1 + K1 r² + K2 r⁴ + K3 r⁶ + K4 r⁸) + P1 (r² + 2 x²) + 2 P2 x y
    y' = y (1 + ..) + P2 (r² + 2 y²) + 2 P1 x y
    u = w / 2 + cx + x' f + x' B1 + y' B2,   v = h / 2 + cy + y' f

so P1 and P2 are OpenCV's p2 and p1. Fisheye cameras take x and y times atan(r) / r first, which is OpenCV's fisheye model where
P1 = P2 = 0. Cameras without a transform were not aligned and are left out.

Source: Agisoft Metashape User Manual, Professional Edition, appendix "Camera models" and "Coordinate systems".
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ...errors import FormatError, InvalidInputError
from ...geometry.cameras import rotation_from
from .filestorage import read_xml
from .lens import brown, corner_radius, polynomial
from .poses import from_camera_to_world
from .records import Found, Record
from .values import Entry, Float, files_in, head

PINHOLE = ("frame",)
FISHEYE = ("fisheye", "equidistant_fisheye")


def find(path: Path) -> Path | None:
    """An XML file of Metashape, or the first in a folder."""
    if path.is_file():
        start = head(path)
        return path if path.suffix.lower() == ".xml" and "<document" in start and "<chunk" in start else None
    return next((f for f in files_in(path, ".xml") if find(f)), None)


def read(path: Path) -> Found:
    """The aligned cameras of the first chunk that has some."""
    root = read_xml(path)
    chunks = [c for c in root.iter("chunk") if c.find("cameras") is not None]
    if not chunks:
        raise FormatError(f"{path}: expected <chunk> with <sensors> and <cameras>")
    for chunk in chunks:
        records, left_out = _chunk(path, chunk)
        if records:
            more = len(chunks) > 1
            warnings = [f"{path.name}: only chunk {chunk.get('label', '')!r} of {len(chunks)} is read"] if more else []
            if left_out:
                warnings.append(f"{path.name}: {left_out} cameras that are not aligned, or disabled, left out")
            return Found(records, path, warnings=tuple(warnings))
    raise FormatError(f"{path}: no camera has a <transform>: align the photos first")


def _chunk(path: Path, chunk: Element) -> tuple[list[Record], int]:
    sensors = {s.get("id", ""): s for s in chunk.iter("sensor")}
    worlds = {c.get("id", ""): _similarity(path, c.find("transform")) for c in chunk.iter("component")}
    world = _similarity(path, chunk.find("transform"))
    cameras = list(chunk.find("cameras").iter("camera"))  # type: ignore[union-attr]
    usable = [c for c in cameras if c.find("transform") is not None and c.get("enabled", "1").lower() in ("1", "true")]
    own = {c.get("component_id", "") for c in usable}
    if len(own) > 1 and not all(worlds.get(c) for c in own):
        counts = {c: sum(u.get("component_id", "") == c for u in usable) for c in own}
        largest = max(counts, key=lambda c: counts[c])
        usable = [c for c in usable if c.get("component_id", "") == largest]  # components share no frame
    lenses: dict[str, tuple[Float, list[float], bool, int, int]] = {}
    records = []
    for camera in usable:
        where = f"camera {camera.get('label') or camera.get('id')!r}"
        number = camera.get("sensor_id", "")
        if number not in sensors:
            raise FormatError(f"{path}: {where}: sensor {number!r} missing")
        if number not in lenses:
            lenses[number] = _sensor(path, sensors[number])
        k, distortion, fisheye, width, height = lenses[number]
        r, t = _pose(path, where, camera, worlds.get(camera.get("component_id", "")) or world)
        name = camera.get("label") or camera.get("id") or ""
        records.append(Record(k, r, t, width, height, Path(name), name=name, distortion=distortion, fisheye=fisheye))
    return records, len(cameras) - len(usable)


def _numbers(path: Path, where: str, element: Element, count: int) -> Float:
    return Entry((element.text or "").split(), path, f"{where}: <{element.tag}>").array(count)


def _similarity(path: Path, element: Element | None) -> tuple[Float, Float, float] | None:
    """(R, T, s) of a chunk: X_world = s R X + T."""
    if element is None or element.find("rotation") is None:
        return None
    r, t, s = (element.find(tag) for tag in ("rotation", "translation", "scale"))
    try:
        matrix = rotation_from(_numbers(path, "chunk transform", r, 9).reshape(3, 3))  # type: ignore[arg-type]
    except InvalidInputError as error:
        raise FormatError(f"{path}: chunk transform: {error}") from None
    shift = np.zeros(3) if t is None else _numbers(path, "chunk transform", t, 3)
    scale = 1.0 if s is None else float(_numbers(path, "chunk transform", s, 1)[0])
    if scale <= 0:
        raise FormatError(f"{path}: chunk transform: <scale>: expected a positive number, got {scale:g}")
    return matrix, shift, scale


def _pose(path: Path, where: str, camera: Element, world: tuple[Float, Float, float] | None) -> tuple[Float, Float]:
    pose = _numbers(path, where, camera.find("transform"), 16).reshape(4, 4)[:3]  # type: ignore[arg-type]
    if world is not None:
        r, t, s = world
        pose = np.column_stack([r @ pose[:, :3], s * r @ pose[:, 3] + t])
    try:
        return from_camera_to_world(pose)
    except InvalidInputError as error:
        raise FormatError(f"{path}: {where}: <transform>: {error}") from None


def _sensor(path: Path, sensor: Element) -> tuple[Float, list[float], bool, int, int]:
    """K, distortion, fisheye, width and height."""
    where = f"sensor {sensor.get('label') or sensor.get('id')!r}"
    found = sensor.findall("calibration")
    if not found:
        raise FormatError(f"{path}: {where}: <calibration> missing")
    calibration = next((c for c in found if c.get("class") == "adjusted"), found[-1])
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in PINHOLE + FISHEYE:
        raise FormatError(f"{path}: {where}: the camera type {kind!r} cannot be read; frame and fisheye can: undistort in Metashape first")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise FormatError(f"{path}: {where}: <resolution> missing")
    width, height = (Entry(size.get(a), path, f"{where}: {a}").pixels() for a in ("width", "height"))
    values = {e.tag: Entry(e.text, path, f"{where}: <{e.tag}>").number() for e in calibration if (e.text or "").strip()}
    k = _matrix(path, where, values, width, height)
    return k, _distortion(path, where, values, k, kind in FISHEYE, width, height), kind in FISHEYE, width, height


def _matrix(path: Path, where: str, values: dict[str, float], width: int, height: int) -> Float:
    def v(name: str) -> float:
        return values.get(name, 0.0)

    if "f" in values:
        fx, fy, skew = v("f") + v("b1"), v("f"), v("b2")
        x, y = width / 2 + v("cx"), height / 2 + v("cy")
    elif "fx" in values:  # PhotoScan before 1.2: pixels from the corner
        fx, fy, skew = v("fx"), values.get("fy", v("fx")), v("skew")
        x, y = values.get("cx", width / 2), values.get("cy", height / 2)
    else:
        raise FormatError(f"{path}: {where}: <f> missing")
    return np.array([[fx, skew, x - 0.5], [0, fy, y - 0.5], [0, 0, 1]])


def _distortion(path: Path, where: str, values: dict[str, float], k: Float, fisheye: bool, width: int, height: int) -> list[float]:
    radial = [values.get(f"k{n}", 0.0) for n in range(1, 5)]
    p2, p1 = values.get("p1", 0.0), values.get("p2", 0.0)
    if values.get("p3") or values.get("p4"):
        raise FormatError(f"{path}: {where}: the terms p3 and p4 of the distortion cannot be read: undistort in Metashape first")
    if fisheye:
        if p1 or p2:
            raise FormatError(f"{path}: {where}: fisheye cameras with p1, p2 cannot be read: undistort in Metashape first")
        return radial
    if not radial[3]:
        return brown(*radial[:2], p1, p2, radial[2])
    fitted = polynomial(radial, p1, p2, k[1, 1], corner_radius(k, width, height))
    if fitted is None:
        raise FormatError(f"{path}: {where}: the distortion with k4 = {radial[3]:g} turns back within the image")
    return fitted
