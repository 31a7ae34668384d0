"""Sparse points of a scene that is to be written in another format."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..config import SparseConfig
from ..errors import MvcoreError
from ..geometry.cameras import Camera, same_shape
from ..io.images import read_image, reduce, undistort
from ..io.scene import Scene
from ..sparse.points import find_points
from ..types import Frame, Image, Report, SparsePoints, Track, no_track

LARGEST = 1600
"""Longer side, in pixels, at which features are found; larger images have more features than a format needs."""

PARALLAX = 1.5
"""Degrees under which a point must be seen: COLMAP's own limit (filter_min_tri_angle). Depth maps ask for more (`SparseConfig`)."""


def sparse_points(scene: Scene, report: Report | None = None, track: Track = no_track) -> SparsePoints | None:
    """Triangulated features of the views that have an image.

    Returns
    -------
    SparsePoints or None
        (V, N) visible counts all views of the scene; None where fewer than two have an image, or the views share nothing.

    Warns, in the report, where the calibration does not fit the images.
    """
    report = report or Report()
    images: list[Image] = []
    cameras: list[Camera] = []
    numbers: list[int] = []
    for n, (frame, camera) in enumerate(zip(scene.frames, scene.calib, strict=False)):
        if (image := _image(frame, camera, report)) is not None:
            own = camera.resized(image.shape[1], image.shape[0])
            image, own = reduce(undistort(image, own), own.pinhole(), LARGEST)
            images.append(image)
            cameras.append(own)
            numbers.append(n)
    if len(numbers) < 2:
        return None
    try:
        points = find_points(images, cameras, config=SparseConfig(min_parallax=PARALLAX), report=report, track=track)
    except MvcoreError as error:
        report.warn(f"no sparse points: {error}")
        return None
    if not len(points):
        return None
    visible = np.zeros((len(scene), len(points)), bool)
    visible[numbers] = points.visible
    return replace(points, visible=visible)


def _image(frame: Frame | None, camera: Camera, report: Report) -> Image | None:
    """A frame's image, if there is one of the camera's shape."""
    if frame is None:
        return None
    try:
        image = read_image(frame) if isinstance(frame, str | Path) else frame
    except (MvcoreError, OSError) as error:
        report.warn(f"no sparse points from an image: {error}")
        return None
    size = (image.shape[1], image.shape[0])
    if not same_shape(size, (camera.width, camera.height)):
        report.warn(f"camera {camera.name!r}: its image has {size[0]} x {size[1]} pixels and gives no sparse points")
        return None
    return image
