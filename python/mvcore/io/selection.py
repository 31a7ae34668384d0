"""Views by name, pattern or number: ``left,cam*,0-3``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import PurePath

from ..errors import InvalidInputError


def select_views(names: Sequence[str], only: str | None = None, exclude: str | None = None) -> list[int]:
    """The numbers of the views that are kept, in their order.

    Parameters
    ----------
    names : of the views: a camera's, or its image's path.
    only, exclude : separated by commas, names (with or without suffix, or a folder's), patterns with ``*``, ``?`` and ``[]``, numbers
        from 0 and ranges of them (``0-3``, both ends). A name counts before a number.

    Raises
    ------
    InvalidInputError
        Something that fits no view, or no view left.

    Examples
    --------
    >>> select_views(["a.jpg", "b.jpg", "c.jpg"], exclude="b,2")
    [0]
    """
    kept = set(range(len(names))) if only is None else _chosen(names, only, "only")
    kept -= set() if exclude is None else _chosen(names, exclude, "exclude")
    if not kept:
        raise InvalidInputError(f"only, exclude: expected views to be left of {len(names)}, got none")
    return sorted(kept)


def _chosen(names: Sequence[str], text: str, argument: str) -> set[int]:
    chosen: set[int] = set()
    for word in filter(None, (w.strip() for w in text.split(","))):
        fits = {n for n, name in enumerate(names) if _fits(name, word)}
        numbers = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", word)
        if not fits and numbers:
            first, last = int(numbers[1]), int(numbers[2] or numbers[1])
            if not first <= last < len(names):
                raise InvalidInputError(f"{argument}: expected views 0 to {len(names) - 1}, got {word}")
            fits = set(range(first, last + 1))
        if not fits:
            near = difflib.get_close_matches(word, [PurePath(n).stem for n in names], 1)
            hint = f"; did you mean {near[0]!r}?" if near else f" (the first is called {names[0]!r})" if names and names[0] else ""
            raise InvalidInputError(f"{argument}: expected a view's name, pattern or number, got {word!r}{hint}")
        chosen |= fits
    return chosen


def _fits(name: str, word: str) -> bool:
    path = PurePath(name)
    return bool(name) and any(fnmatchcase(form, word) for form in (name, path.stem, *path.parts))
