"""Training logs: CSV lines that a resumed run continues, and their plot."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from ...errors import MvcoreError
from ...io.files import atomically


def cut_log(path: Path, step: int) -> None:
    """Drops lines after ``step``, which a kill may have left."""
    if path.exists():
        with path.open(newline="") as file:
            rows = [r for r in csv.DictReader(file) if int(float(r["step"])) <= step]
        path.unlink()
        for row in rows:
            log_row(path, row)


def log_row(path: Path, row: dict[str, Any]) -> None:
    """Appends a line, with a header to a new file."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


def plot_log(log: Path, picture: Path) -> None:
    """Every column of a log over its steps, a panel each, as a PNG. Needs matplotlib, ``pip install mvcore[train]``."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MvcoreError("plots need matplotlib: pip install 'mvcore[train]'") from None
    with log.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [n for n in (rows[0] if rows else []) if n not in ("step", "seconds")]
    figure = Figure((4 * min(3, len(names)), 3 * ((len(names) + 2) // 3)), layout="constrained")
    steps = [float(r["step"]) for r in rows]
    for n, name in enumerate(names):
        axes = figure.add_subplot((len(names) + 2) // 3, min(3, len(names)), n + 1, title=name, xlabel="step")
        axes.plot(steps, [float(r[name]) for r in rows])
        axes.grid(alpha=0.3)
    atomically(picture, lambda p: figure.savefig(p, format="png", dpi=80))
