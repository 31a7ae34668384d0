"""``mvcore train``: the network, and what it is trained on."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InvalidInputError
from .app import app

train = typer.Typer(no_args_is_help=True, help="Train the network, or look at what it is trained on.")
app.add_typer(train, name="train")


@train.command("data")
def train_data(
    preview: Annotated[Path, typer.Option(help="Contact sheet to write, a PNG.")],
    seed: Annotated[int, typer.Option(help="Of the scenes.")] = 1,
    held_out: Annotated[bool, typer.Option(help="Shapes and textures kept for validation.")] = False,
) -> None:
    """A contact sheet of procedural scenes: views, true inverse depth, what the first source sees."""
    from .._core import encode_png
    from ..io.files import atomically
    from ..network.procedural.scenes import contact_sheet

    sheet, speed = contact_sheet(seed, held_out)
    encoded = encode_png(sheet)

    def write(path: Path) -> None:
        path.write_bytes(encoded)

    atomically(preview, write)
    print(f"{preview}: {speed:.1f} samples a second")


@train.command("disparity")
def train_disparity_network(
    out: Annotated[Path, typer.Option(help="Folder of checkpoints, log and weights; an earlier run there goes on.")],
    steps: Annotated[int, typer.Option(min=1, help="Batches in all.")] = 10_000,
    preset: Annotated[str, typer.Option(help="compact or paper.")] = "compact",
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    hours: Annotated[float | None, typer.Option(help="End after this long if not by the steps; the rate falls to zero by then.")] = None,
    data: Annotated[
        list[str] | None, typer.Option(help="A published set, LAYOUT:FOLDER (dtu, blendedmvs, sceneflow, kitti, middlebury).")
    ] = None,
    middlebury: Annotated[Path | None, typer.Option(help="Folder of Middlebury pairs to validate on as well.")] = None,
    batch: Annotated[int, typer.Option(min=2, help="Samples a batch.")] = 2,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the samples, multiples of 16.")] = "256x192",
    workers: Annotated[int, typer.Option(min=0, help="Processes that render.")] = 1,
    rate: Annotated[float, typer.Option(help="Learning rate.")] = 1e-3,
    start: Annotated[Path | None, typer.Option(help="Weights to begin from.")] = None,
    freeze_norms: Annotated[bool, typer.Option(help="Batch normalisation keeps the statistics of --start: for small batches.")] = False,
    bfloat16: Annotated[bool | None, typer.Option(help="Most of the work in that precision; by default on CUDA.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Batches between checkpoints.")] = 250,
    seed: Annotated[int, typer.Option(help="Of the scenes.")] = 1,
    replay: Annotated[int, typer.Option(min=0, help="Samples kept on the device to draw from: no step waits for rendering.")] = 0,
    validation: Annotated[int, typer.Option(min=4, help="Samples in each of the two held-out sets.")] = 200,
) -> None:
    """Train the disparity network on procedural scenes, and on published sets where given."""
    from ..network.features import PRESETS
    from ..network.training.batches import Recipe
    from ..network.training.datasets import find_items
    from ..network.training.logs import plot_log
    from ..network.training.train_disparity import Training, keep_memory, train_disparity

    if preset not in PRESETS:
        raise InvalidInputError(f"--preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
    for source in data or ():
        print(f"{source}: {len(find_items(source))} samples")
    width, height = _sides(size)
    recipe = Recipe(seed, batch, width, height, every=replay > 0, data=tuple(data or ()))
    pairs = str(middlebury) if middlebury else None
    begun = str(start) if start else None
    training = Training(
        steps,
        preset,
        rate=rate,
        every=every,
        hours=hours,
        workers=workers,
        bfloat16=bfloat16,
        freeze_norms=freeze_norms,
        replay=replay,
        validation=validation,
        recipe=recipe,
        middlebury=pairs,
        start=begun,
    )
    keep_memory()
    print(train_disparity(training, out, device))
    plot_log(out / "log.csv", out / "log.png")


def _sides(size: str) -> tuple[int, int]:
    sides = [int(n) for n in size.split("x")] if re.fullmatch(r"\d+x\d+", size) else []
    if len(sides) != 2 or min(sides) < 32 or sides[0] % 16 or sides[1] % 16:
        raise InvalidInputError(f"--size: expected WIDTHxHEIGHT, multiples of 16 from 32 on, got {size!r}")
    return sides[0], sides[1]


@train.command("recognition")
def train_recognition_head(
    out: Annotated[Path, typer.Option(help="Folder of checkpoint, log and weights; an earlier run there goes on.")],
    steps: Annotated[int, typer.Option(min=1, help="Batches in all.")] = 3000,
    preset: Annotated[str, typer.Option(help="compact or paper.")] = "compact",
    error: Annotated[str, typer.Option(help="entropy, or squared (the paper's eq 34).")] = "entropy",
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
) -> None:
    """Train the recognition head on procedural targets seen from several angles."""
    from ..network.features import PRESETS
    from ..network.training.logs import plot_log
    from ..network.training.train_recognition import RecognitionTraining, train_recognition

    if preset not in PRESETS:
        raise InvalidInputError(f"--preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
    if error not in ("entropy", "squared"):
        raise InvalidInputError(f"--error: expected entropy or squared, got {error!r}")
    print(train_recognition(RecognitionTraining(steps=steps, preset=preset, error=error), out, device))
    plot_log(out / "log.csv", out / "log.png")
