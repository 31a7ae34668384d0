"""``mvcore reconstruct``, ``check`` and ``demo``: calibrated images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import FormatError, InvalidInputError
from . import options
from .app import BAD_INPUT, app, shown

if TYPE_CHECKING:
    from ..io.scene import Scene
    from ..pipeline.preflight import Preflight


@app.command()
def reconstruct(
    path: Annotated[Path, typer.Argument(help="A folder or calibration file; the format is found by itself.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Mesh to write: .glb, .obj or .ply.", rich_help_panel=options.OUTPUT)],
    images: options.Images = None,
    allow_outside: options.Outside = False,
    only: options.Only = None,
    exclude: options.Exclude = None,
    masks: options.Masks = None,
    bounds: options.Bounds = None,
    report: Annotated[Path | None, typer.Option(help="Write figures and warnings as JSON.", rich_help_panel=options.OUTPUT)] = None,
    save_depth: Annotated[Path | None, typer.Option(help="Folder for the depth maps.", rich_help_panel=options.OUTPUT)] = None,
    config: options.Settings = None,
    max_image_size: options.MaxImageSize = None,
    max_faces: options.MaxFaces = None,
    closed: options.Closed = False,
    matcher: options.Matcher = None,
    device: options.Device = None,
    workdir: options.Workdir = None,
    scheduler: options.Scheduler = None,
    tls_ca: options.TlsCa = None,
    tls_cert: options.TlsCert = None,
    tls_key: options.TlsKey = None,
    max_memory: options.MaxMemory = None,
    jobs: options.Jobs = None,
) -> None:
    """Calibrated images in, a textured mesh out."""
    from ..io.meshes import check_mesh_name

    check_mesh_name(output, "--output")
    box = options.parse_box(bounds)
    settings = options.settings_of(config, matcher, device, max_image_size, max_faces, closed)
    how = options.running(workdir, scheduler, max_memory, jobs, (tls_ca, tls_cert, tls_key))
    scene, numbers = options.chosen(_scene(path, images, allow_outside), only, exclude)
    targets = _masks(scene, masks)
    from ..pipeline.preflight import preflight

    places = {"outputs": [p for p in (output, report) if p], "folders": [save_depth] if save_depth else [], "workdir": workdir}
    box = box if box is not None else scene.bounds
    before = preflight(scene.frames, scene.calib, targets, box, settings, **places, max_memory=how.get("max_memory"))
    before.require_good()
    shown().warn(before.warnings)
    _run(path, scene, numbers, targets, box, settings, how, (output, report, save_depth))


def _run(
    path: Path, scene: Scene, numbers: list[int], targets: Any, box: Any, settings: Any, how: dict[str, Any], places: tuple[Any, ...]
) -> None:
    from ..pipeline import reconstruct as pipeline

    output, report, save_depth = places
    result = pipeline.reconstruct(scene.frames, scene.calib, masks=targets, bounds=box, config=settings, track=shown().track(), **how)
    result.report |= {"input": str(path), "format": scene.format, "view_numbers": numbers}
    result.report["warnings"] = list(dict.fromkeys([*shown().warnings, *result.warnings]))
    result.save(output)
    if save_depth is not None:
        result.save_depth(save_depth)
    if report is not None:
        result.save_report(report)
    shown().warn(result.warnings)
    for stage, spent in result.report["seconds"].items():
        shown().detail(f"{stage}: {spent['wall']:.1f} s ({spent['cpu']:.1f} CPU seconds)")
    cpu, wall = (sum(s[kind] for s in result.report["seconds"].values()) for kind in ("cpu", "wall"))
    views = len(scene.frames)
    shown().done(f"{output}: {len(result.faces)} faces from {views} views, {wall:.0f} s ({cpu:.0f} CPU seconds)")


def _scene(path: Path, images: Path | None, allow_outside: bool) -> Scene:
    """The scene at a path, its warnings shown; a folder of clips is named as what it is."""
    from ..io import load

    try:
        scene = load(path, images=True if images is None else images, allow_outside=allow_outside)
    except (FormatError, FileNotFoundError):
        from ..pipeline.preflight import has_clips

        if has_clips(path) and _calibrated(path):
            raise InvalidInputError(f"{path}: expected images of one moment, got clips: use 'mvcore video'") from None
        raise
    shown().warn(scene.warnings)
    return scene


def _calibrated(path: Path) -> bool:
    """Whether a calibration is there, whatever the images are."""
    from ..io import load

    try:
        return len(load(path, images=False)) > 0
    except (FormatError, OSError):
        return False


def _masks(scene: Scene, folder: Path | None) -> Any:
    """The masks to use: those asked for, else the images' alpha."""
    if folder is not None:
        from ..io.images import find_masks

        return find_masks(folder, scene.frames)
    if scene.alpha:
        shown().note("masks: the alpha channel of the images")
        return scene.masks
    if scene.masks is not None:
        shown().note("masks lie beside the images; pass --masks to use them")
    return None


@app.command()
def check(
    path: Annotated[Path, typer.Argument(help="A folder of images or clips, or a calibration file.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Mesh or folder that is to be written.", rich_help_panel=options.OUTPUT)
    ] = None,
    images: options.Images = None,
    allow_outside: options.Outside = False,
    only: options.Only = None,
    exclude: options.Exclude = None,
    masks: options.Masks = None,
    bounds: options.Bounds = None,
    config: options.Settings = None,
    max_image_size: options.MaxImageSize = None,
    max_faces: options.MaxFaces = None,
    closed: options.Closed = False,
    matcher: options.Matcher = None,
    device: options.Device = None,
    workdir: options.Workdir = None,
    max_memory: options.MaxMemory = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.", rich_help_panel=options.OUTPUT)] = False,
) -> None:
    """What a run would be refused for, what is doubtful, and what it would take; nothing is reconstructed."""
    from ..io.meshes import FORMATS
    from ..pipeline.preflight import check as look

    settings = options.settings_of(config, matcher, device, max_image_size, max_faces, closed)
    is_mesh = output is not None and output.suffix.lower() in FORMATS
    done = look(
        path,
        masks=masks,
        bounds=options.parse_box(bounds),
        config=settings,
        only=only,
        exclude=exclude,
        images=images,
        allow_outside=allow_outside,
        outputs=[output] if output is not None and is_mesh else [],
        folders=[output] if output is not None and not is_mesh else [],
        workdir=workdir,
        max_memory=None if max_memory is None else options.parse_size("--max-memory", max_memory),
    )
    if as_json:
        print(json.dumps(done.as_dict(), indent=1))
        shown().warnings += done.warnings
    else:
        _show(path, done)
    if done.errors:
        raise typer.Exit(BAD_INPUT)
    shown().end()


def _show(path: Path, done: Preflight) -> None:
    for error in done.errors:
        print(f"error: {error}")
    for warning in done.warnings:
        print(f"warning: {warning}")
    shown().warnings += done.warnings
    if (plan := done.outlook) is not None:
        sources = [len(s) for s in plan.sources]
        moments = f" at {plan.frames} moments" if plan.frames > 1 else ""
        print(f"{path}: {done.format}, {plan.views} views{moments}, matched at up to {plan.width} x {plan.height} pixels")
        print(f"sources: {min(sources)} to {max(sources)} a view by the poses; views without any: {sources.count(0)}")
        print(f"about {max(plan.minutes, 0.1):.1f} minutes on {plan.cores} cores and {plan.memory / 2**30:.1f} GiB of memory")
    print("this can be reconstructed" if not done.errors else f"{len(done.errors)} errors: a run would be refused")


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the result.")] = Path("out"),
) -> None:
    """Reconstruct the bundled sample: a pickup in a yard, 16 views."""
    sample = Path(__file__).parent / "sample"
    if not (sample / "cameras.json").is_file():
        raise FileNotFoundError(f"{sample}: the bundled sample is not installed")
    reconstruct(sample, output / "pickup.glb", masks=sample / "masks", report=output / "report.json", save_depth=output / "depth")
