"""rich's progress bars."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

T = TypeVar("T")


class Progress:
    """A `Track` on stderr."""

    def __call__(self, items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
        """The items again, one by one."""
        from rich.console import Console
        from rich.progress import track

        return track(items, description, total, console=Console(stderr=True))
