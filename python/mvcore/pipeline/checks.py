"""Checks of a run's input, output and machine, each of which says all that it notices; images are opened for their headers alone."""

from __future__ import annotations

import importlib.util
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..config import Config
from ..errors import InvalidInputError, MvcoreError, require
from ..geometry.cameras import Calibration, Camera, same_shape
from ..io.decode import read_header
from ..io.images import find_masks, load_mask, mask_warnings
from ..types import Bounds, Frame

MOST_MASKS = 200
"""Masks that are looked at, spread over all."""
FOCAL = (0.1, 50.0)
"""Focal lengths, in longer image sides, between which lenses lie: fisheyes at 0.2, long telephotos at 20."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong (``error``: a run would be refused) or doubtful (``warning``), and what it is about."""

    level: str
    about: str
    message: str

    def __str__(self) -> str:
        return f"{self.about}: {self.message}"


@dataclass
class Findings:
    """Collects what checks say."""

    items: list[Finding] = field(default_factory=list)

    def error(self, about: str, message: object) -> None:
        """A run would be refused for it."""
        self._add("error", about, message)

    def warn(self, about: str, message: object) -> None:
        """It is doubtful."""
        self._add("warning", about, message)

    def warn_all(self, warnings: Sequence[str]) -> None:
        """Warnings that name what they are about before a colon."""
        for text in warnings:
            about, _, message = text.partition(": ")
            self.warn(about if message else "input", message or text)

    def _add(self, level: str, about: str, message: object) -> None:
        text = " ".join(str(message).split()).removeprefix(f"{about}: ")
        finding = Finding(level, about, text)
        if finding not in self.items:
            self.items.append(finding)


def check_calibration(cameras: Sequence[Camera], notes: Findings) -> None:
    """Baselines, focal lengths, principal points, cameras at one place."""
    try:
        Calibration(tuple(cameras)).check_baselines()
    except InvalidInputError as error:
        notes.error("calib", error)
        return
    for n, c in enumerate(cameras):
        focal = max(c.K[0, 0], c.K[1, 1]) / max(c.width, c.height)
        if not FOCAL[0] <= focal <= FOCAL[1]:
            share = f"{focal:.3g} times the longer image side: expected pixels, between {FOCAL[0]:g} and {FOCAL[1]:g} times"
            notes.warn(view_name(c, n), f"a focal length of {share}")
        if abs(c.K[0, 0] / c.K[1, 1] - 1) > 0.25:
            notes.warn(view_name(c, n), f"focal lengths of {c.K[0, 0]:.1f} and {c.K[1, 1]:.1f} pixels differ by more than a quarter")
        if not (0 <= c.K[0, 2] < c.width and 0 <= c.K[1, 2] < c.height):
            notes.warn(
                view_name(c, n), f"a principal point of ({c.K[0, 2]:.1f}, {c.K[1, 2]:.1f}) outside its {c.width} x {c.height} pixels"
            )
    centers = np.array([c.center for c in cameras])
    extent = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1) + np.diag(np.full(len(centers), np.inf))
    twins = [n for n in range(len(cameras)) if apart[n].min() < 1e-6 * extent]
    if twins:
        notes.warn("calib", f"{len(twins)} cameras stand where another does ({_some(twins)}): they give each other no depth")


def view_name(camera: Camera, number: int) -> str:
    """What messages call a view."""
    return f"view {number} ({camera.name})" if camera.name else f"view {number}"


def _some(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:5])) + (" .." if len(numbers) > 5 else "")


def check_frames(frames: Sequence[Frame], cameras: Sequence[Camera], notes: Findings) -> None:
    """One image a camera, of its size, by the header."""
    if len(frames) != len(cameras):
        notes.error("frames", f"expected {len(cameras)}, one a camera, got {len(frames)}")
        return
    for n, (frame, camera) in enumerate(zip(frames, cameras, strict=True)):
        want = (camera.width, camera.height)
        try:
            if isinstance(frame, str | Path):
                header = read_header(frame)
                size = header.turned if header.turned == want else (header.width, header.height)
            else:
                array = np.asarray(frame)
                good = array.ndim == 3 and array.shape[2] == 3 and array.dtype == np.uint8
                require(good, f"frames[{n}]", "(h, w, 3) of uint8", f"{array.shape} of {array.dtype}")
                size = (array.shape[1], array.shape[0])
            require(size == want, f"frames[{n}]", f"{want[0]} x {want[1]} pixels as its camera", f"{size[0]} x {size[1]}")
        except (MvcoreError, OSError) as error:
            notes.error(view_name(camera, n), error)


def check_masks(
    masks: Sequence[Frame | None] | str | Path, frames: Sequence[Frame], cameras: Sequence[Camera], notes: Findings, decode: bool = True
) -> None:
    """One mask a frame, of its shape; with ``decode`` empty and inverted ones."""
    try:
        each = find_masks(masks, frames) if isinstance(masks, str | Path) else list(masks)
        require(len(each) == len(cameras), "masks", f"{len(cameras)}, one a frame", len(each))
    except (MvcoreError, OSError) as error:
        notes.error("masks", error)
        return
    looked: list[NDArray[np.uint8] | None] = []
    for n in sorted({int(n) for n in np.linspace(0, len(each) - 1, min(len(each), MOST_MASKS)).round()}):
        try:
            if isinstance(path := each[n], str | Path):
                header = read_header(path)
                size, want = (header.width, header.height), (cameras[n].width, cameras[n].height)
                fits = same_shape(size, want) or header.turned == want
                require(fits, f"masks[{n}]", f"{want[0]} x {want[1]} pixels as its camera", f"{size[0]} x {size[1]}")
            if decode:
                looked.append(None if each[n] is None else load_mask(each[n], cameras[n], n))
        except (MvcoreError, OSError) as error:
            notes.error(view_name(cameras[n], n), error)
    notes.warn_all(mask_warnings(looked))
    if looked and all(m is not None and not m.any() for m in looked):
        notes.error("masks", "all are empty: expected bright pixels where the target is")


def as_box(bounds: ArrayLike | None) -> Bounds | None:
    """A caller's box as (2, 3), or None.

    Raises
    ------
    InvalidInputError
        Not six finite numbers, the lesser corner first.
    """
    if bounds is None:
        return None
    try:
        box = np.asarray(bounds, np.float64)
    except (ValueError, TypeError):
        raise InvalidInputError(f"bounds: expected ((x0, y0, z0), (x1, y1, z1)), got {str(bounds)[:60]!r}") from None
    require(box.size == 6, "bounds", "((x0, y0, z0), (x1, y1, z1))", f"{box.size} values")
    box = box.reshape(2, 3)
    require(np.isfinite(box).all() and (box[0] < box[1]).all(), "bounds", "x0 < x1, y0 < y1, z0 < z1", box.tolist())
    return box


def check_bounds(bounds: ArrayLike | None, cameras: Sequence[Camera], notes: Findings) -> None:
    """A box in the world that a camera sees."""
    try:
        box = as_box(bounds)
    except InvalidInputError as error:
        notes.error("bounds", error)
        return
    if box is None:
        return
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3)
    if len(cameras) and not any(_sees(c, corners) for c in cameras):
        notes.error("bounds", f"no camera sees the box {box.tolist()}: expected the world's units and axes")


def _sees(camera: Camera, corners: NDArray[np.float64]) -> bool:
    """Whether a camera may see a box: no side of its view has all corners outside. Sure where it says no."""
    local = camera.to_camera(corners)
    x = local @ camera.K.T
    inside = (local[:, 2], x[:, 0], camera.width * x[:, 2] - x[:, 0], x[:, 1], camera.height * x[:, 2] - x[:, 1])
    return all(bool((side > 0).any()) for side in inside)


def check_places(outputs: Sequence[str | Path], folders: Sequence[str | Path], notes: Findings) -> None:
    """Files and folders that are to be written."""
    for place, is_folder in [*((p, False) for p in outputs), *((p, True) for p in folders)]:
        try:
            check_writable(place, folder=is_folder)
        except InvalidInputError as error:
            notes.error(str(place), error)


def check_writable(path: str | Path, *, folder: bool = False) -> None:
    """Whether a file can be made or replaced, or files in a folder be made, which need not exist; nothing of the trial stays.

    Raises
    ------
    InvalidInputError
        It cannot; the message says why.
    """
    path = Path(path).absolute()
    kind = "a folder that can be written" if folder else "a file that can be written"
    if folder and path.exists() and not path.is_dir():
        raise InvalidInputError(f"{path}: expected {kind}, got a file")
    if not folder and path.is_dir():
        raise InvalidInputError(f"{path}: expected {kind}, got a folder")
    place = path if folder else path.parent
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise InvalidInputError(f"{path}: expected {kind}, got {place}, which is no folder")
    trial = place / f".mvcore-{uuid.uuid4().hex}"
    try:
        trial.mkdir()  # as writing does: beside the file, then moved
        try:
            (trial / "trial").touch()
            (trial / "trial").unlink()
        finally:
            trial.rmdir()
    except OSError as error:
        raise InvalidInputError(f"{path}: expected {kind}, got {error.strerror or error} in {place}") from None


def check_device(config: Config, notes: Findings) -> None:
    """Only what the settings ask for is looked at: importing torch takes seconds."""
    needs = config.matcher == "dcnn" or config.device == "cuda"
    if needs and importlib.util.find_spec("torch") is None:
        notes.error("device", f"expected torch to be installed for matcher={config.matcher}, device={config.device}")
    elif config.device == "cuda":
        from ..network.devices import cuda_available

        if not cuda_available():
            notes.error("device", "expected a CUDA device that torch finds, got none; device cpu works everywhere")


def check_installation(notes: Findings) -> None:
    """Two packages of OpenCV, which overwrite each other."""
    packages = sorted({d.metadata["Name"].lower() for d in metadata.distributions() if "opencv" in (d.metadata["Name"] or "").lower()})
    rivals = [p for p in packages if p.startswith("opencv-") and "python" in p]
    if len(rivals) > 1:
        text = "share the module cv2 and overwrite each other's files; keep one, and reinstall it"
        notes.warn("installation", f"{', '.join(rivals)} {text}")


def available_memory() -> int | None:
    """Bytes that processes can still take without swapping; None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration, ValueError):
        return None
