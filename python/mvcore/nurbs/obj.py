"""OBJ free-form files."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FormatError, InvalidInputError, require
from ..io.files import atomically
from ..io.limits import MOST_ARRAYS, read_bytes
from .checks import Array
from .curve import Curve
from .export import Shape
from .surface import Surface


def save_obj(path: str | os.PathLike[str], shapes: Shape | Iterable[Shape]) -> None:
    """Writes curves and surfaces of three coordinates as OBJ free-form geometry (``cstype bspline`` or ``rat bspline``)."""
    many = _shapes(shapes)
    lines, used = ["# NURBS written by mvcore"], 0
    for n, shape in enumerate(many):
        control = (
            shape.control_points.reshape(-1, 3) if isinstance(shape, Curve) else shape.control_points.transpose(1, 0, 2).reshape(-1, 3)
        )
        weights = None if shape.weights is None else shape.weights.T.ravel()
        # With weights a vertex line is x y z w; evaluators divide, so x y z are the points themselves.
        for k, point in enumerate(control):
            w = "" if weights is None else f" {float(weights[k])!r}"
            lines.append("v " + " ".join(repr(float(x)) for x in point) + w)
        numbers = " ".join(str(used + k + 1) for k in range(len(control)))
        used += len(control)
        lines += [f"g shape{n}", "cstype " + ("bspline" if weights is None else "rat bspline")]
        if isinstance(shape, Curve):
            low, high = shape.domain
            lines += [f"deg {shape.degree}", f"curv {low!r} {high!r} {numbers}", _parm("u", shape.knots), "end"]
        else:
            (a, b), (c, d) = shape.domain
            p, q = shape.degree
            lines += [f"deg {p} {q}", f"surf {a!r} {b!r} {c!r} {d!r} {numbers}"]
            lines += [_parm("u", shape.knots_u), _parm("v", shape.knots_v), "end"]
    atomically(Path(path), lambda p: p.write_text("\n".join(lines) + "\n") and None)


def _parm(name: str, knots: Array) -> str:
    return f"parm {name} " + " ".join(repr(float(t)) for t in knots)


def _shapes(shapes: Any) -> list[Shape]:
    many = [shapes] if isinstance(shapes, Curve | Surface) else list(shapes)
    require(len(many) > 0, "shapes", "at least one curve or surface", "none")
    for shape in many:
        if not isinstance(shape, Curve | Surface):
            raise InvalidInputError(f"shapes: expected curves and surfaces, got {type(shape).__name__}")
        require(shape.control_points.shape[-1] == 3, "shapes", "three coordinates", shape.control_points.shape[-1])
    return many


def load_obj(path: str | os.PathLike[str]) -> list[Shape]:
    """Reads the B-spline curves and surfaces of an OBJ file; polygons and other free-form types are passed over.

    Raises `FormatError` with path and line where the file is malformed.
    """
    vertices: list[list[float]] = []
    shapes: list[Shape] = []
    state: dict[str, Any] = {}
    text = read_bytes(Path(path), MOST_ARRAYS).decode("utf-8", "replace").replace("\\\n", " ")
    for line, content in enumerate(text.splitlines(), 1):
        word, *rest = content.split("#")[0].split() or [""]
        try:
            if word == "v":
                vertices.append([float(x) for x in rest])
            elif word == "cstype":
                state = {"type": rest}
            elif word == "deg":
                state["deg"] = [int(x) for x in rest]
            elif word in ("curv", "surf"):
                ends = 2 if word == "curv" else 4
                picked = [int(x.split("/")[0]) for x in rest[ends:]]
                state |= {"kind": word, "range": [float(x) for x in rest[:ends]], "line": line}
                state["points"] = [vertices[k - 1 if k > 0 else len(vertices) + k] for k in picked]
            elif word == "parm":
                if rest[0] not in ("u", "v"):
                    raise ValueError(f"expected parm u or parm v, got parm {rest[0]:.20}")
                state[rest[0]] = np.array([float(x) for x in rest[1:]])
            elif word == "end" and state.get("type") in (["bspline"], ["rat", "bspline"]) and "kind" in state:
                shapes.append(_read_shape(state))
                state = {k: state[k] for k in ("type", "deg") if k in state}
        except (ValueError, IndexError, KeyError) as error:
            raise FormatError(f"{path}:{line}: not a B-spline: {error}") from None
    return shapes


def _read_shape(state: dict[str, Any]) -> Shape:
    rational = state["type"][0] == "rat"
    points = state["points"]
    control = np.array([p[:3] for p in points])
    weights = np.array([p[3] if len(p) > 3 else 1.0 for p in points]) if rational else None
    if state["kind"] == "curv":
        return Curve(control, state["u"], weights)
    p, q = state["deg"]
    m, n = len(state["u"]) - p - 1, len(state["v"]) - q - 1
    require(m * n == len(points), "surf", f"{m} x {n} control points", len(points))
    net = control.reshape(n, m, 3).transpose(1, 0, 2)
    return Surface(net, state["u"], state["v"], None if weights is None else weights.reshape(n, m).T)
