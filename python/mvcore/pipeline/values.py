"""Typed values as arrays and JSON: what stages hand on can be kept in memory, on disk or sent to another machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


def pack(value: Any) -> tuple[Arrays, Any]:
    """Arrays by name, and a tree of plain JSON values that says how they belong together.

    Takes None, numbers, texts, arrays, lists, tuples, mappings and mvcore's dataclasses, nested.

    Raises
    ------
    TypeError
        Anything else.
    """
    arrays: Arrays = {}
    return arrays, _packed(value, arrays)


def _packed(value: Any, arrays: Arrays) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        arrays[str(len(arrays))] = value
        return {"array": len(arrays) - 1}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_packed(v, arrays) for v in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_packed(k, arrays), _packed(v, arrays)] for k, v in value.items()]}
    kind = type(value)
    if dataclasses.is_dataclass(value) and kind.__module__.split(".")[0] == __package__.split(".")[0]:
        fields = [[f.name, _packed(getattr(value, f.name), arrays)] for f in dataclasses.fields(value)]
        return {"class": f"{kind.__module__}:{kind.__qualname__}", "fields": fields}
    raise TypeError(f"pack: expected plain values, arrays or mvcore's dataclasses, got {kind.__name__}")


def unpack(arrays: Mapping[str, NDArray[Any]], tree: Any) -> Any:
    """The value of which `pack` gave the arrays and the tree.

    Raises
    ------
    ValueError
        The tree is not one of `pack`, or of another version's classes.
    """
    try:
        return _unpacked(arrays, tree)
    except (AttributeError, ImportError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"unpack: {error}") from None


def _unpacked(arrays: Mapping[str, NDArray[Any]], tree: Any) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[str(tree["array"])]
    if "list" in tree:
        return [_unpacked(arrays, v) for v in tree["list"]]
    if "tuple" in tree:
        return tuple(_unpacked(arrays, v) for v in tree["tuple"])
    if "dict" in tree:
        return {_unpacked(arrays, k): _unpacked(arrays, v) for k, v in tree["dict"]}
    kind = _class(tree["class"])
    return kind(**{name: _unpacked(arrays, v) for name, v in tree["fields"]})


def _class(name: str) -> Any:
    module, _, path = name.partition(":")
    if module.split(".")[0] != __package__.split(".")[0]:
        raise ValueError(f"unpack: {name} is not a class of this package")
    kind: Any = import_module(module)
    for part in path.split("."):
        kind = getattr(kind, part)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise ValueError(f"unpack: {name} is not a dataclass")
    return kind


def size_of(value: Any) -> int:
    """Bytes of the arrays in a value."""
    return sum(a.nbytes for a in pack(value)[0].values())
