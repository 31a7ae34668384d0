"""The command line: ``mvcore COMMAND``. One command a job; errors are one line on stderr with exit code 2."""

from __future__ import annotations

from . import clean, reconstruct, tools, train, video
from .app import app

__all__ = ["app", "clean", "main", "reconstruct", "tools", "train", "video"]


def main() -> None:
    """Entry point."""
    app()


if __name__ == "__main__":
    main()
