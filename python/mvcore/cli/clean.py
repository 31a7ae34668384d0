"""``mvcore clean``: what a workdir keeps."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InvalidInputError
from .app import app, shown
from .options import parse_size

SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def parse_age(text: str) -> float:
    """Seconds of an age such as 7d."""
    parts = re.fullmatch(r"(\d+(?:\.\d+)?)([smhdw])", text.strip().lower())
    if not parts:
        raise InvalidInputError(f"--older-than: expected an age such as 7d, 12h or 30m, got {text!r}")
    return float(parts[1]) * SECONDS[parts[2]]


@app.command()
def clean(
    workdir: Annotated[Path, typer.Argument(help="A folder given to --workdir.")],
    older_than: Annotated[str | None, typer.Option(help="Remove results not used for so long: 7d, 12h, 30m.")] = None,
    max_size: Annotated[str | None, typer.Option(help="Remove the longest unused until no more is left: 2G, 500M.")] = None,
) -> None:
    """Remove stored results from a workdir: all, or by age and size; never what a run uses that still goes on."""
    from ..pipeline.store import Store

    age = parse_age(older_than) if older_than is not None else None
    size = parse_size("--max-size", max_size) if max_size is not None else None
    if not workdir.is_dir():
        raise NotADirectoryError(f"{workdir}: there is no such folder")
    done = Store(workdir).clean(age, size)
    busy = f"; {done.runs} runs use it" if done.runs else ""
    shown().done(
        f"{workdir}: removed {done.removed} results ({done.removed_bytes / 1e6:.1f} MB), "
        f"{done.left} ({done.left_bytes / 1e6:.1f} MB) are left{busy}"
    )
