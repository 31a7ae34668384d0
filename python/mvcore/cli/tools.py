"""``mvcore info``, ``convert``, ``disparity`` and ``eval``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ..errors import require
from . import options
from .app import DOUBTFUL, app, shown

Matcher = Annotated[str, typer.Option(help="sgm (classical), or dcnn (with the network).")]
Device = Annotated[str, typer.Option(help="Where the network runs: cpu or cuda.")]


@app.command()
def disparity(
    left: Annotated[Path, typer.Argument(help="Left image of a rectified pair.")],
    right: Annotated[Path, typer.Argument(help="Right image.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Disparity map to write: .pfm, or .png (a picture).")],
    max_disparity: Annotated[int, typer.Option(help="Largest disparity in pixels.")],
    min_disparity: Annotated[int, typer.Option(help="Smallest disparity in pixels.")] = 0,
    matcher: Matcher = "sgm",
    device: Device = "cpu",
) -> None:
    """Disparity of the left image of a rectified pair."""
    import numpy as np

    from .. import _core
    from ..depth import disparity as match
    from ..io.files import atomically
    from ..io.images import read_image
    from ..io.maps import colourise, write_pfm
    from ..pipeline.checks import check_writable

    suffix = output.suffix.lower()
    require(suffix in (".pfm", ".png"), "--output", "a name ending in .pfm or .png", repr(str(output)))
    check_writable(output)
    ends = {"max_disparity": max_disparity, "min_disparity": min_disparity}
    values, _ = match(read_image(left), read_image(right), **ends, matcher=matcher, device=device)
    if suffix == ".pfm":
        write_pfm(output, values)
    else:
        picture = _core.encode_png(colourise(1 / values.clip(1e-3)))
        atomically(output, lambda p: p.write_bytes(picture) and None)
    shown().done(f"{output}: {values.shape[1]} x {values.shape[0]}, median {float(np.median(values)):.2f} px")


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A folder or calibration file.")],
    images: options.Images = None,
    allow_outside: options.Outside = False,
) -> None:
    """What was read, and how well the calibration fits the images."""
    from ..errors import ReconstructionError
    from ..io import load
    from ..io.images import load_frame, undistort
    from ..sparse.points import find_points
    from ..sparse.view_selection import search_box
    from ..types import Report

    scene = load(path, images=True if images is None else images, allow_outside=allow_outside)
    shown().warn(scene.warnings)
    sizes = sorted({(c.width, c.height) for c in scene.calib})
    print(f"{path}: {scene.format}, {len(scene)} views of {', '.join(f'{w} x {h}' for w, h in sizes)}")
    print(f"distortion: {'yes' if any(c.distortion.size for c in scene.calib) else 'no'}; masks: {'yes' if scene.masks else 'no'}")
    scene.calib.check_baselines()
    report = Report()
    images = [undistort(load_frame(f, c, n), c) for n, (f, c) in enumerate(zip(scene.frames, scene.calib, strict=True))]
    cameras = [c.pinhole() for c in scene.calib]
    try:
        points = find_points(images, cameras, report=report, track=shown().track())
    except ReconstructionError as error:
        print(f"calibration: {error}")
        raise typer.Exit(DOUBTFUL) from None
    error_px = report.values["calibration"]["median_epipolar_error_px"]
    fit = "unknown (too few matches)" if error_px is None else f"median epipolar error {error_px:.2f} px"
    print(f"calibration: {fit}; {len(points)} sparse points")
    box = scene.bounds if scene.bounds is not None else search_box(cameras, points)
    print(f"target box: {box.round(4).tolist()}{' (given)' if scene.bounds is not None else ''}")
    shown().warn(report.warnings)
    shown().end()


@app.command()
def convert(
    path: Annotated[Path, typer.Argument(help="A folder or calibration file of any known format.")],
    output: Annotated[Path, typer.Argument(help="cameras.json, or a folder for COLMAP, nerfstudio or MVSNet files.")],
    to: Annotated[str | None, typer.Option(help="mvcore, colmap, nerfstudio or mvsnet; by default mvcore for .json, else colmap.")] = None,
    images: options.Images = None,
    allow_outside: options.Outside = False,
) -> None:
    """Calibrations from one format to another; with sparse points where the images are."""
    from ..io import load, save_calibration
    from ..pipeline.checks import check_writable
    from ..pipeline.convert import sparse_points
    from ..types import Report

    is_json = output.suffix.lower() == ".json"
    format = to or ("mvcore" if is_json else "colmap")
    scene = load(path, images=False if images is None else images, allow_outside=allow_outside)
    shown().warn(scene.warnings)
    if scene.mirrored and format != "mvcore":
        shown().warn([f"{format} holds no mirrored world: the cameras written are those of its reflection in z"])
    check_writable(output, folder=format != "mvcore" and not is_json)
    report = Report()
    points = None if format == "mvcore" else sparse_points(scene, report, shown().track())
    shown().warn(report.warnings)
    save_calibration(output, scene, format, points=points)
    counted = f" and {len(points)} points" if points is not None else ""
    shown().done(f"{output}: {len(scene)} views{counted} as {format}")


@app.command(name="eval")
def evaluate(
    result: Annotated[Path, typer.Argument(help="Mesh or points to judge.")],
    truth: Annotated[Path, typer.Argument(help="True mesh or points.")],
    thresholds: Annotated[str, typer.Option(help="Distances for the F-score, world units.")],
    visible: Annotated[Path | None, typer.Option(help="Points of the truth that the views see.")] = None,
    samples: Annotated[int, typer.Option(help="Samples of each surface.")] = 1_000_000,
) -> None:
    """Accuracy, completeness, overall and F-score of a mesh, as JSON."""
    from ..evaluation.metrics import load_geometry, mesh_metrics

    distances = options.parse_numbers("--thresholds", thresholds) or []
    seen = load_geometry(visible)[0] if visible is not None else None
    figures = mesh_metrics(load_geometry(result), load_geometry(truth), distances, visible=seen, samples=samples)
    print(json.dumps(figures, indent=1))
