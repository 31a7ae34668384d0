"""Which format a path holds: readers are asked in turn, by what files say rather than by their names alone."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...errors import FormatError, InvalidInputError, MvcoreError
from ..scene import Scene
from . import (
    bundler,
    calib_toml,
    colmap,
    easymocap,
    gaussian_splatting,
    idr,
    kalibr,
    kitti,
    llff,
    mccalib,
    meshroom,
    metashape,
    middlebury,
    middlebury_stereo,
    mvsnet,
    native,
    nerf,
    opencv,
    openmvg,
    opensfm,
    panoptic,
    polycam,
    qualisys,
    realitycapture,
    record3d,
    replica,
    ros,
    scannet,
    stereo,
    strecha,
    tum,
    visualsfm,
)
from .records import Found, to_scene
from .values import head


@dataclass(frozen=True)
class Reader:
    """A format: its name, where it is in a path (None: not there), and its views.

    ``lists_images`` says that ``read`` also takes the caller's folder of images, for the format goes by their number or times.
    A ``fallback`` is asked only where no other reader knows the path: what it says is then more than that none does.
    """

    name: str
    find: Callable[[Path], Path | None]
    read: Callable[..., Found]
    lists_images: bool = False
    fallback: bool = False


def _own_json(path: Path) -> Path | None:
    """mvcore's ``cameras.json``, which shares its name or suffix with others."""
    at = native.find(path)
    if at is None or '"views"' not in head(at, 1 << 16):
        return None
    return None if any(other.find(at) for other in (gaussian_splatting, meshroom, openmvg, opensfm, panoptic)) else at


READERS: tuple[Reader, ...] = (
    Reader("mvcore cameras.json", _own_json, native.read),
    Reader("NeRF transforms.json", nerf.find, nerf.read),
    Reader("COLMAP", colmap.find, colmap.read),
    Reader("MVSNet / DTU cam.txt", mvsnet.find, mvsnet.read),
    Reader("IDR / NeuS npz", idr.find, idr.read),
    Reader("Middlebury par.txt", middlebury.find, middlebury.read),
    Reader("Strecha .camera", strecha.find, strecha.read),
    Reader("Qualisys .qca.txt", qualisys.find, qualisys.read),
    Reader("EasyMocap intri.yml and extri.yml", easymocap.find, easymocap.read),
    Reader("Kalibr camchain.yaml", kalibr.find, kalibr.read),
    Reader("Metashape cameras.xml", metashape.find, metashape.read),
    Reader("openMVG sfm_data.json", openmvg.find, openmvg.read),
    Reader("Meshroom .sfm", meshroom.find, meshroom.read),
    Reader("OpenSfM reconstruction.json", opensfm.find, opensfm.read),
    Reader("VisualSFM .nvm", visualsfm.find, visualsfm.read),
    Reader("Bundler .out", bundler.find, bundler.read, True),
    Reader("RealityCapture CSV", realitycapture.find, realitycapture.read),
    Reader("Polycam raw", polycam.find, polycam.read),
    Reader("Record3D metadata", record3d.find, record3d.read),
    Reader("Panoptic Studio JSON", panoptic.find, panoptic.read),
    Reader("aniposelib / Pose2Sim Calib.toml", calib_toml.find, calib_toml.read),
    Reader("MC-Calib", mccalib.find, mccalib.read),
    Reader("ROS camera_info", ros.find, ros.read),
    Reader("OpenCV stereo calibration", stereo.find, stereo.read),
    Reader("KITTI calib.txt", kitti.find, kitti.read),
    Reader("Middlebury stereo calib.txt", middlebury_stereo.find, middlebury_stereo.read),
    Reader("ScanNet", scannet.find, scannet.read),
    Reader("Replica traj.txt", replica.find, replica.read),
    Reader("TUM trajectory", tum.find, tum.read, True),
    Reader("LLFF poses_bounds.npy", llff.find, llff.read, True),
    Reader("3D Gaussian Splatting cameras.json", gaussian_splatting.find, gaussian_splatting.read),
    Reader("OpenCV FileStorage", opencv.find, opencv.read),
    Reader("mvcore cameras.json", native.find, native.read, fallback=True),
)
"""The formats, those that say most about their cameras first; the last takes any FileStorage."""


def load(source: Any, *, images: bool | str | Path = True, allow_outside: bool = False) -> Scene:
    """Read a scene; the format is told from the files.

    Parameters
    ----------
    source : a folder, a calibration file in it, or a `pycolmap.Reconstruction` (whose images need a folder).
    images : False reads the cameras alone; image files may then be missing. A folder is where the images lie, if the
        calibration does not say or is wrong.
    allow_outside : follow paths in the calibration that lead out of the data set's folder; they are refused otherwise.

    Returns
    -------
    Scene
        Frames are paths, in the order of the file (COLMAP: by name). Poses are world-to-camera, pixel centres at integers, world and
        units are those of the file.

    Raises
    ------
    FileNotFoundError
        The path does not exist.
    FormatError
        No known format, or malformed files: the message names path and line or key; where several readers know the path, what each
        of them said.

    Examples
    --------
    >>> scene = mvcore.load("project/cameras.xml", images="project/photos")  # doctest: +SKIP
    """
    folder = None if isinstance(images, bool) else Path(images).absolute()
    if hasattr(source, "write_binary") and hasattr(source, "cameras"):
        return _load_pycolmap(source, images is not False, folder)
    path = Path(source).absolute()
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    found = _read(path, folder)
    return to_scene(found, images is not False, images=folder, allow_outside=allow_outside, given=path)


def _read(path: Path, folder: Path | None) -> Found:
    """What the first reader that knows the path and can read it finds."""
    said: list[tuple[str, FormatError]] = []
    for reader in READERS:
        if reader.fallback and said:
            break
        try:
            at = _guarded(reader, reader.find, path)
            if at is None:
                continue
            found = _guarded(reader, reader.read, at, *([folder] if reader.lists_images else []))
            if not found.records:
                raise FormatError(f"{found.source}: no views")
        except FormatError as error:
            said.append((reader.name, error))
            continue
        passed_over = (f"read as {reader.name}; {_joined(said)}",) if said else ()
        return replace(found, format=reader.name, warnings=(*found.warnings, *passed_over))
    if len(said) == 1:
        raise said[0][1]
    if said:
        raise FormatError(f"{path}: no reader can read it; {_joined(said)}")
    raise FormatError(f"{path}: no calibration found; known formats: {', '.join(r.name for r in READERS if not r.fallback)}")


def _joined(said: list[tuple[str, FormatError]]) -> str:
    return "; ".join(f"as {name}: {error}" for name, error in said)


def _guarded(reader: Reader, step: Callable[..., Any], *arguments: Any) -> Any:
    """A reader's step; whatever else a malformed file makes it raise is a `FormatError` too."""
    try:
        return step(*arguments)
    except (MvcoreError, OSError, MemoryError):
        raise
    except Exception as error:
        raise FormatError(f"{arguments[0]}: not a {reader.name} file: {type(error).__name__}: {error!s:.120}") from error


def _load_pycolmap(reconstruction: Any, need_images: bool, folder: Path | None) -> Scene:
    """The views of a `pycolmap.Reconstruction`, by way of the files that it writes."""
    with tempfile.TemporaryDirectory() as place:
        reconstruction.write_binary(place)
        found = colmap.read(Path(place))
        if need_images and folder is None:
            raise InvalidInputError("images: expected the folder of the reconstruction's images, got none")
        records = [replace(r, image=None, mask=None) for r in found.records]
        return to_scene(replace(found, records=records, format="pycolmap.Reconstruction"), need_images, images=folder)
