"""Pairing of files with views or clips by name, in natural order (``frame10`` after ``frame9``)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath

from ..errors import FormatError

Key = Callable[[PurePath], object]


def natural_order(path: PurePath) -> list[tuple[int, str]]:
    """A key under which ``frame10`` comes after ``frame9``."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part.casefold()) for part in parts]


def pair_by_name(
    names: Sequence[str | PurePath],
    candidates: Sequence[Path],
    what: str,
    *,
    partial: bool = False,
    exact: bool = False,
    in_order: bool = True,
) -> list[Path | None]:
    """The file that belongs to each name.

    The strictest of these comparisons that pairs the most decides, for all names together: equal names; without suffix; without
    suffix and case; of masks without words such as ``_mask``; the numbers in the name (``mask_2`` with ``v02``). Folders count where
    names are equal without them. If nothing pairs and there are as many files as names, both are taken in natural order.

    Parameters
    ----------
    names : of views, cameras or frames; paths may have folders and suffixes.
    candidates : files (or folders) to choose from; more than names are allowed, except for pairing by order.
    what : one such file, for messages: ``"mask"``.
    partial : names without a file are allowed and give None, as long as one has a file.
    exact : names alone decide, neither the numbers in them nor their order. in_order : the order may decide.

    Returns
    -------
    list[Path | None]
        One a name; no file twice.

    Raises
    ------
    FormatError
        A name that fits two files, two names that fit one, or names that fit only partly.

    Examples
    --------
    >>> files = [Path("mask_10.png"), Path("mask_2.png")]
    >>> [str(p) for p in pair_by_name(["v02.jpg", "v10.jpg"], files, "mask")]
    ['mask_2.png', 'mask_10.png']
    """
    wanted = [PurePath(n) for n in names]
    files = sorted(candidates, key=lambda p: (natural_order(p.parent), natural_order(p)))
    if not wanted or not files:
        return _whole(wanted, files, [None] * len(wanted), what, partial)
    keys = (*_KEYS[:-1], *([_bare] if what == "mask" else []), *([] if exact else _KEYS[-1:]))
    best = _best(wanted, files, what, keys)
    if _paired(best):
        return _whole(wanted, files, best, what, partial)
    if in_order and not exact and len(files) == len(wanted):
        order = sorted(range(len(wanted)), key=lambda n: (natural_order(wanted[n].parent), natural_order(wanted[n])))
        ordered: list[Path | None] = [None] * len(wanted)
        for file, n in zip(files, order, strict=True):
            ordered[n] = file
        return ordered
    return _whole(wanted, files, [None] * len(wanted), what, partial)


def _best(names: Sequence[PurePath], files: Sequence[Path], what: str, keys: Sequence[Key]) -> list[Path | None]:
    """The pairs of the strictest key that pairs all names, else of the one that pairs most."""
    best: list[Path | None] = [None] * len(names)
    clash = ""
    for key in keys:
        pairs, problem = _match(names, files, key, what)
        if _paired(pairs) == len(pairs) > 0:
            return pairs
        clash = clash or problem
        # Numbers alone pair wrongly where they start elsewhere: all files must have a name.
        if _paired(pairs) > _paired(best) and (key is not _numbers or _paired(pairs) == len(files)):
            best = pairs
    if clash:
        raise FormatError(clash)
    return best


def _paired(pairs: Sequence[Path | None]) -> int:
    return sum(p is not None for p in pairs)


def _match(names: Sequence[PurePath], files: Sequence[Path], key: Key, what: str) -> tuple[list[Path | None], str]:
    """The pairs under a key, or what makes them ambiguous."""
    folders = _folders(names)
    table: dict[object, list[Path]] = {}
    for file in files:
        table.setdefault(_full(file, key, folders), []).append(file)
    pairs: list[Path | None] = []
    taken: dict[Path, PurePath] = {}
    for name in names:
        options = table.get(_full(name, key, folders), []) if key(name) else []
        if len(options) > 1:
            options = _closest(name, options)
        if len(options) > 1:
            return [], f"{name}: expected one {what}, got {options[0]} and {options[1]}"
        if options and options[0] in taken:
            return [], f"{options[0]}: belongs to both {taken[options[0]]} and {name}, expected one {what} each"
        if options:
            taken[options[0]] = name
        pairs.append(options[0] if options else None)
    return pairs, ""


def _folders(names: Sequence[PurePath]) -> int:
    """How many folders it takes to tell names apart."""
    deepest = max(len(n.parts) for n in names)
    return next((d for d in range(deepest) if len({n.parts[-1 - d :] for n in names}) == len(names)), deepest - 1)


def _full(path: PurePath, key: Key, folders: int) -> tuple[object, ...]:
    return (*(p.casefold() for p in path.parts[:-1][len(path.parts) - 1 - folders :]), key(path)) if folders else (key(path),)


def _closest(name: PurePath, files: Sequence[Path]) -> list[Path]:
    """The files that share the most folders with a name; of those the ones in the fewest folders (not ``old/a.png`` beside ``a.png``)."""
    folders = [p.casefold() for p in name.parent.parts]

    def shared(file: Path) -> int:
        theirs = [p.casefold() for p in file.parent.parts]
        count = 0
        while count < min(len(folders), len(theirs)) and folders[-1 - count] == theirs[-1 - count]:
            count += 1
        return count

    most = max(map(shared, files))
    closest = [f for f in files if shared(f) == most]
    least = min(len(f.parts) for f in closest)
    return [f for f in closest if len(f.parts) == least]


def _stem(path: PurePath) -> str:
    """The name without suffixes that name a file's kind: ``a.jpg.png`` is ``a``, ``v1.2`` stays."""
    name = path.name
    while (match := re.fullmatch(r"(.+)\.([A-Za-z][A-Za-z0-9]{1,4})", name)) is not None:
        name = match.group(1)
    return name


def _numbers(path: PurePath) -> tuple[int, ...]:
    return tuple(int(d) for d in re.findall(r"\d+", _stem(path)))


MASK_WORDS = re.compile(r"(?:^|[-_. ])(?:masks?|mattes?|alpha|silhouettes?|sil|seg|segmentation|labels?|fg|foreground)(?=$|[-_. ])")


def _bare(path: PurePath) -> str:
    """The name without a word for what a mask is: ``left_mask`` and ``mask-left`` are ``left``."""
    return MASK_WORDS.sub("", _stem(path).casefold()).strip("-_. ")


_KEYS: tuple[Key, ...] = (lambda p: p.name, _stem, lambda p: _stem(p).casefold(), _numbers)


def _whole(names: Sequence[PurePath], files: Sequence[Path], pairs: list[Path | None], what: str, partial: bool) -> list[Path | None]:
    missing = [str(n) for n, p in zip(names, pairs, strict=True) if p is None]
    if not missing or (partial and len(missing) < len(pairs)):
        return pairs
    extra = [f.name for f in files if f not in set(pairs)]
    rest = f"; {', '.join(extra[:3])} {'belongs' if len(extra) == 1 else 'belong'} to none" if extra else ""
    raise FormatError(f"no {what} for {missing[0]} ({len(missing)} of {len(names)} have none){rest}")
