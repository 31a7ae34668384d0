"""``mvcore video`` and ``view``: clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InvalidInputError
from . import options
from .app import app, shown

if TYPE_CHECKING:
    from ..io.clips import Clips


@app.command()
def video(
    path: Annotated[Path, typer.Argument(help="A folder of clips: video files, or a folder of images a camera.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the meshes and their index.", rich_help_panel=options.OUTPUT)],
    calib: Annotated[
        Path | None, typer.Option(help="Calibration; by default what lies in the folder.", rich_help_panel=options.INPUT)
    ] = None,
    images: options.Images = None,
    allow_outside: options.Outside = False,
    only: options.Only = None,
    exclude: options.Exclude = None,
    masks: options.Masks = None,
    background: Annotated[
        str | None, typer.Option(help="Folder of clean plates; 'none' for the whole scene.", rich_help_panel=options.INPUT)
    ] = None,
    regions: Annotated[
        Path | None, typer.Option(help="Folder of CAMERA.png, bright where targets may be (a road).", rich_help_panel=options.INPUT)
    ] = None,
    bounds: options.Bounds = None,
    rotate: Annotated[
        str, typer.Option(help="Turn of the stored frames: auto, or 0, 90, 180, 270 degrees clockwise.", rich_help_panel=options.INPUT)
    ] = "auto",
    start: Annotated[int, typer.Option(help="First frame.", rich_help_panel=options.INPUT)] = 0,
    stop: Annotated[int | None, typer.Option(help="Frame to stop before.", rich_help_panel=options.INPUT)] = None,
    stride: Annotated[int, typer.Option(help="Take every Nth frame.", rich_help_panel=options.INPUT)] = 1,
    target: Annotated[str, typer.Option(help="free, or rigid: all frames make one model.", rich_help_panel=options.SETTINGS)] = "free",
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
    """Synchronised clips in, a textured mesh a frame out."""
    from ..io import load_video
    from ..pipeline.preflight import preflight_clips

    if target not in ("free", "rigid"):
        raise InvalidInputError(f"--target: expected free or rigid, got {target!r}")
    box = options.parse_box(bounds)
    settings = options.settings_of(config, matcher, device, max_image_size, max_faces, closed)
    if scheduler is not None and workdir is None:
        workdir = output / "work"  # a temporary folder would be this machine's alone
    how = options.running(workdir, scheduler, max_memory, jobs, (tls_ca, tls_cert, tls_key))
    choice = {"only": only, "exclude": exclude, "allow_outside": allow_outside, "rotation": rotate}
    clips = load_video(path if images is None else images, calib or path, start=start, stop=stop, stride=stride, **choice)
    before = preflight_clips(clips, box, settings, folders=[output], workdir=workdir, max_memory=how.get("max_memory"))
    before.require_good()
    shown().warn(before.warnings)
    plates = False if background == "none" else background
    _run(clips, output, masks=masks, background=plates, regions=regions, bounds=box, target=target, config=settings, **how)


def _run(clips: Clips, output: Path, *, regions: Path | None, **arguments: Any) -> None:
    from ..io.images import find_pictures
    from ..video.api import reconstruct_video

    names = [c.name for c in clips.clips]
    areas = find_pictures(regions, names) if regions is not None else None
    run = reconstruct_video(clips, regions=areas, track=shown().track(), **arguments)
    run.save(output)
    shown().warn(run.warnings)
    shown().done(f"{output}: {len(run)} instants of {len(names)} cameras, {sum(run.seconds):.0f} s")


@app.command()
def view(
    output: Annotated[Path, typer.Argument(help="Folder that 'mvcore video' wrote.")],
    page: Annotated[Path | None, typer.Option(help="Page to write; by default view.html in the folder.")] = None,
) -> None:
    """One self-contained HTML page with a time slider, depth maps and the report."""
    from ..viewer.page import write_page

    print(write_page(output, page))
