"""Options that commands share, and what they mean."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InvalidInputError, require

if TYPE_CHECKING:
    from ..config import Config
    from ..io.scene import Scene
    from ..pipeline.cluster import Cluster

INPUT, OUTPUT, SETTINGS, RUNNING = "Input", "Output", "Settings", "Running"
"""Groups of the help."""

Images = Annotated[Path | None, typer.Option(help="Folder of the images, where the calibration does not say.", rich_help_panel=INPUT)]
Outside = Annotated[
    bool, typer.Option("--allow-outside", help="Follow paths in the calibration that lead out of its folder.", rich_help_panel=INPUT)
]
Only = Annotated[str | None, typer.Option(help="Views to take alone: names, patterns, numbers, e.g. cam*,0-3.", rich_help_panel=INPUT)]
Exclude = Annotated[str | None, typer.Option(help="Views to leave out, likewise.", rich_help_panel=INPUT)]
Masks = Annotated[Path | None, typer.Option(help="Folder of masks (of clips: mask clips), bright on the target.", rich_help_panel=INPUT)]
Bounds = Annotated[str | None, typer.Option(help="Box of the target: x0,y0,z0,x1,y1,z1, world units.", rich_help_panel=INPUT)]
Settings = Annotated[Path | None, typer.Option("--config", help="Settings, a TOML file; options win over it.", rich_help_panel=SETTINGS)]
MaxImageSize = Annotated[
    int | None, typer.Option(help="Reduce images to so many pixels on the longer side (1600).", rich_help_panel=SETTINGS)
]
MaxFaces = Annotated[int | None, typer.Option(help="Decimate each mesh to so many faces.", rich_help_panel=SETTINGS)]
Closed = Annotated[
    bool, typer.Option("--closed", help="Keep the sides that silhouettes bound but no image shows.", rich_help_panel=SETTINGS)
]
Matcher = Annotated[str | None, typer.Option(help="sgm (classical), or dcnn (with the network).", rich_help_panel=SETTINGS)]
Device = Annotated[str | None, typer.Option(help="Where the network runs: cpu or cuda.", rich_help_panel=SETTINGS)]
Workdir = Annotated[Path | None, typer.Option(help="Keeps results; an interrupted run goes on there.", rich_help_panel=RUNNING)]
Scheduler = Annotated[
    str | None, typer.Option(help="A dask.distributed scheduler, tcp://host:port or tls://host:port.", rich_help_panel=RUNNING)
]
TlsCa = Annotated[Path | None, typer.Option(help="The cluster's certificate authority, a PEM file, for tls://.", rich_help_panel=RUNNING)]
TlsCert = Annotated[Path | None, typer.Option(help="This client's certificate, a PEM file.", rich_help_panel=RUNNING)]
TlsKey = Annotated[Path | None, typer.Option(help="The key of that certificate, a PEM file.", rich_help_panel=RUNNING)]
MaxMemory = Annotated[str | None, typer.Option(help="Memory that the run may take, e.g. 4G or 800M.", rich_help_panel=RUNNING)]
Jobs = Annotated[int | None, typer.Option(help="Processors to use; all of them by default.", rich_help_panel=RUNNING)]

BYTES = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


def parse_size(option: str, text: str) -> int:
    """Bytes of a size such as 4G: powers of 1024."""
    parts = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmgt]?)(?:i?b)?", text.strip().lower())
    if not parts or not (size := int(float(parts[1]) * BYTES[parts[2]])):
        raise InvalidInputError(f"{option}: expected a size such as 4G or 800M, got {text!r}")
    return size


def parse_numbers(option: str, text: str | None, count: int | None = None) -> list[float] | None:
    """Finite numbers separated by commas."""
    if text is None:
        return None
    try:
        values = [float(word) for word in text.split(",") if word.strip()]
    except ValueError:
        values = [float("nan")]
    if not values or any(v - v != 0 for v in values):
        raise InvalidInputError(f"{option}: expected numbers separated by commas, got {text!r}")
    if count is not None and len(values) != count:
        raise InvalidInputError(f"{option}: expected {count} numbers, got {len(values)}")
    return values


def parse_box(text: str | None) -> list[float] | None:
    """``--bounds``: six numbers, the lesser corner first."""
    box = parse_numbers("--bounds", text, 6)
    if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise InvalidInputError(f"--bounds: expected x0 < x1, y0 < y1 and z0 < z1, got {text}")
    return box


def settings_of(
    file: Path | None, matcher: str | None, device: str | None, max_image_size: int | None, max_faces: int | None, closed: bool
) -> Config:
    """The configuration of a settings file, changed by the options that are there."""
    from ..config import Config

    config = Config.from_file(file) if file is not None else Config()
    options = {
        "--matcher": {} if matcher is None else {"matcher": matcher},
        "--device": {} if device is None else {"device": device},
        "--max-image-size": {} if max_image_size is None else {"depth": {"max_image_size": max_image_size}},
        "--max-faces": {} if max_faces is None else {"surface": {"max_faces": max_faces}},
        "--closed": {"surface": {"unseen_reach": None}} if closed else {},
    }
    for option, values in options.items():
        try:
            config = config.updated(values)
        except InvalidInputError as error:
            raise InvalidInputError(f"{option}: {str(error).partition(': ')[2]}") from None
    return config


def cluster_of(scheduler: str | None, tls: Sequence[Path | None]) -> Cluster | None:
    """The cluster that ``--scheduler`` and the options for TLS (authority, certificate, key) name."""
    from ..pipeline.cluster import Cluster

    if scheduler is None:
        require(not any(tls), "--tls-ca, --tls-cert, --tls-key", "--scheduler tls://host:port with them", "none")
        return None
    try:
        cluster = Cluster(scheduler, *tls)
    except InvalidInputError as error:
        raise InvalidInputError(f"--{str(error).replace('_', '-').replace(', tls', ', --tls')}") from None
    cluster.check_files()
    return cluster


def running(
    workdir: Path | None, scheduler: str | None, max_memory: str | None, jobs: int | None, tls: Sequence[Path | None] = (None,) * 3
) -> dict[str, Any]:
    """Keyword arguments of `reconstruct` and `reconstruct_video` on how to run; only those that were asked for.

    ``--jobs`` bounds the threads of kernels, too, which start with the first kernel: nothing has run before.
    """
    if jobs is not None and not 1 <= jobs <= 4096:
        raise InvalidInputError(f"--jobs: expected a whole number from 1 to 4096 (processors), got {jobs}")
    arguments: dict[str, Any] = {
        "workdir": workdir,
        "scheduler": cluster_of(scheduler, tls),
        "max_memory": None if max_memory is None else parse_size("--max-memory", max_memory),
    }
    if jobs is not None:
        for name in ("RAYON_NUM_THREADS", "OMP_NUM_THREADS"):
            os.environ[name] = str(jobs)
        if scheduler is None:
            from concurrent.futures import ThreadPoolExecutor

            arguments["executor"] = ThreadPoolExecutor(jobs, thread_name_prefix="mvcore")
    return {name: value for name, value in arguments.items() if value is not None}


def chosen(scene: Scene, only: str | None, exclude: str | None) -> tuple[Scene, list[int]]:
    """The scene of the views that ``--only`` and ``--exclude`` leave, and their numbers."""
    from ..io.selection import select_views

    try:
        numbers = select_views([c.name for c in scene.calib], only, exclude)
    except InvalidInputError as error:
        raise InvalidInputError(re.sub(r"^((?:only|exclude)(?:, exclude)?):", r"--\1:", str(error))) from None
    return scene.subset(numbers), numbers
