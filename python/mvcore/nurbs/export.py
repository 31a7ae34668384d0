"""Surfaces and curves as meshes, OBJ free-form geometry and STEP files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, InvalidInputError, require
from ..files import atomically
from .checks import Array
from .curve import Curve
from .search import subdivided
from .surface import Surface

if TYPE_CHECKING:
    import trimesh

Shape = Curve | Surface


def tessellate(surface: Surface, tolerance: float, *, max_vertices: int = 4_000_000) -> tuple[Array, NDArray[np.int64], Array]:
    """Vertices (N, dim), triangles (F, 3) and parameters (N, 2) of a mesh nowhere farther than ``tolerance`` from the surface.

    Each span is cut as finely as its second derivatives ask for, then lines are added where the surface still leaves the middle of an
    edge or cell by more than the tolerance. Counter-clockwise about S_u x S_v. Edges that meet, and poles, share vertices.
    """
    require(np.isfinite(tolerance) and tolerance > 0, "tolerance", "a positive value", tolerance)
    axes = [_estimated(surface, d, tolerance) for d in (0, 1)]
    for _ in range(12):
        require(len(axes[0]) * len(axes[1]) <= max_vertices, "tolerance", f"one that {max_vertices} vertices can hold", tolerance)
        halves = [_too_coarse(surface, axes, d, tolerance) for d in (0, 1)]
        if not any(len(h) for h in halves):
            break
        axes = [np.sort(np.concatenate([a, h])) for a, h in zip(axes, halves, strict=True)]
    grid = surface.evaluate_grid(*axes)
    m, n, dim = grid.shape
    number = np.arange(m * n).reshape(m, n)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    points = grid.reshape(-1, dim)
    merged = _merged(points, (m, n), tolerance)
    faces = merged[faces]
    good = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    used, compact = np.unique(faces[good], return_inverse=True)
    at = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    return points[used], compact.reshape(-1, 3), at[used]


def to_mesh(surface: Surface, tolerance: float) -> trimesh.Trimesh:
    """A mesh nowhere farther than ``tolerance`` from a surface in space; vertex normals are the surface's own."""
    import trimesh

    require(surface.control_points.shape[2] == 3, "surface", "three coordinates", surface.control_points.shape[2])
    vertices, faces, at = tessellate(surface, tolerance)
    return trimesh.Trimesh(vertices, faces, vertex_normals=surface.normal(at[:, 0], at[:, 1]), process=False)


def _estimated(surface: Surface, axis: int, tolerance: float) -> Array:
    """Parameters along an axis so that chords stay within a third of the tolerance: h² |S''| / 8 a span."""
    breaks = surface.breaks
    own, p = breaks[axis], surface.degree[axis]
    inner = np.linspace(0, 1, 2 * p + 1)
    along = own[:-1, None] + np.diff(own)[:, None] * inner
    other = breaks[1 - axis]
    across = np.sort(np.concatenate([other, subdivided(other, 3)]))
    pair = (along.ravel(), across) if axis == 0 else (across, along.ravel())
    second = surface.derivatives_grid(pair[0], pair[1], 2)[(2, 0) if axis == 0 else (0, 2)]
    second = np.linalg.norm(second, axis=2)
    worst = (second.max(1) if axis == 0 else second.max(0)).reshape(along.shape).max(1)
    pieces = np.ceil(np.diff(own) * np.sqrt(worst * 3 / (8 * tolerance))).clip(1, 4096).astype(int)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(own[:-1], own[1:], pieces, strict=True)]
    return np.concatenate([*parts, own[-1:]])


def _too_coarse(surface: Surface, axes: list[Array], axis: int, tolerance: float) -> Array:
    """Middles of the intervals along an axis whose edges, or cells, the surface leaves by more than the tolerance."""
    a = axes[axis]
    middle = (a[:-1] + a[1:]) / 2
    grid = surface.evaluate_grid(*axes)
    grid = grid if axis == 0 else grid.transpose(1, 0, 2)
    pair = (middle, axes[1]) if axis == 0 else (axes[0], middle)
    at = surface.evaluate_grid(*pair)
    at = at if axis == 0 else at.transpose(1, 0, 2)
    off = np.linalg.norm(at - (grid[:-1] + grid[1:]) / 2, axis=2).max(1)
    # The diagonal of each cell is an edge as well.
    other = axes[1 - axis]
    between = (other[:-1] + other[1:]) / 2
    pair = (middle, between) if axis == 0 else (between, middle)
    at = surface.evaluate_grid(*pair)
    at = at if axis == 0 else at.transpose(1, 0, 2)
    # S at the middle against the diagonal's; parts the two directions share are left to the one with the longer chord.
    twist = np.linalg.norm(at - (grid[:-1, :-1] + grid[1:, 1:]) / 2, axis=2).max(1)
    return middle[(off > tolerance) | (twist > tolerance)]


def _merged(points: Array, shape: tuple[int, int], tolerance: float) -> NDArray[np.int64]:
    """For each vertex of a grid the one it is joined to: along edges that meet and edges that are one point."""
    number = np.arange(len(points)).reshape(shape)
    out = np.arange(len(points))
    near = 1e-9 * max(1e-300, float(np.abs(points).max())) + 1e-6 * tolerance
    for first, last in ((number[0], number[-1]), (number[:, 0], number[:, -1])):
        if np.linalg.norm(points[first] - points[last], axis=1).max() <= near:
            out[last] = first
    for edge in (number[0], number[-1], number[:, 0], number[:, -1]):
        if np.linalg.norm(points[edge] - points[edge[0]], axis=1).max() <= near:
            out[edge] = edge[0]
    while (out[out] != out).any():
        out = out[out]
    return out


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
    text = Path(path).read_text(errors="replace").replace("\\\n", " ")
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


class _Step:
    """The data section of a STEP file: entities in order, referred to by number."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.points: dict[tuple[float, ...], str] = {}
        self.corners: dict[tuple[float, ...], str] = {}

    def add(self, entity: str) -> str:
        self.lines.append(f"#{len(self.lines) + 1}={entity};")
        return f"#{len(self.lines)}"

    def point(self, place: Array) -> str:
        key = tuple(float(x) for x in place)
        if key not in self.points:
            self.points[key] = self.add(f"CARTESIAN_POINT('',({','.join(_real(x) for x in key)}))")
        return self.points[key]

    def vertex(self, place: Array) -> str:
        # Corners that differ by rounding are one vertex.
        key = tuple(float(np.round(x, 9)) + 0.0 for x in place)
        if key not in self.corners:
            self.corners[key] = self.add(f"VERTEX_POINT('',{self.point(place)})")
        return self.corners[key]

    def curve(self, curve: Curve) -> str:
        points = ",".join(self.point(p) for p in curve.control_points)
        knots, times = np.unique(curve.knots, return_counts=True)
        basic = f"{curve.degree},({points}),.UNSPECIFIED.,.F.,.F."
        along = f"{_list(times)},{_list(knots)},.UNSPECIFIED."
        if curve.weights is None:
            return self.add(f"B_SPLINE_CURVE_WITH_KNOTS('',{basic},{along})")
        return self.add(
            f"(BOUNDED_CURVE() B_SPLINE_CURVE({basic}) B_SPLINE_CURVE_WITH_KNOTS({along}) CURVE() GEOMETRIC_REPRESENTATION_ITEM() "
            f"RATIONAL_B_SPLINE_CURVE({_list(curve.weights)}) REPRESENTATION_ITEM(''))"
        )

    def surface(self, surface: Surface) -> str:
        net = ",".join("(" + ",".join(self.point(p) for p in row) + ")" for row in surface.control_points)
        (ku, tu), (kv, tv) = (np.unique(k, return_counts=True) for k in surface.knots)
        p, q = surface.degree
        basic = f"{p},{q},({net}),.UNSPECIFIED.,.F.,.F.,.F."
        along = f"{_list(tu)},{_list(tv)},{_list(ku)},{_list(kv)},.UNSPECIFIED."
        if surface.weights is None:
            return self.add(f"B_SPLINE_SURFACE_WITH_KNOTS('',{basic},{along})")
        weights = ",".join(_list(row) for row in surface.weights)
        return self.add(
            f"(BOUNDED_SURFACE() B_SPLINE_SURFACE({basic}) B_SPLINE_SURFACE_WITH_KNOTS({along}) GEOMETRIC_REPRESENTATION_ITEM() "
            f"RATIONAL_B_SPLINE_SURFACE(({weights})) REPRESENTATION_ITEM('') SURFACE())"
        )

    def face(self, surface: Surface) -> str:
        """A patch with the boundary curves that are longer than a point, counter-clockwise."""
        (a, b), (c, d) = surface.domain
        sides = [surface.curve("u", c), surface.curve("v", b), surface.curve("u", d).reverse(), surface.curve("v", a).reverse()]
        size = float(np.abs(np.diff(surface.bounding_box(), axis=0)).max())
        uses = []
        for side in sides:
            if np.abs(np.diff(side.control_points, axis=0)).max() <= 1e-9 * size:
                continue
            ends = [self.vertex(side.evaluate(u)[0]) for u in side.domain]
            edge = self.add(f"EDGE_CURVE('',{ends[0]},{ends[1]},{self.curve(side)},.T.)")
            uses.append(self.add(f"ORIENTED_EDGE('',*,*,{edge},.T.)"))
        loop = self.add(f"EDGE_LOOP('',({','.join(uses)}))")
        bound = self.add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        return self.add(f"ADVANCED_FACE('',({bound}),{self.surface(surface)},.T.)")


def _real(value: float) -> str:
    text = f"{float(value):.17g}".upper()
    if "E" in text:
        mantissa, exponent = text.split("E")
        return f"{mantissa if '.' in mantissa else mantissa + '.'}E{exponent}"
    return text if "." in text else text + "."


def _list(values: Iterable[Any]) -> str:
    return "(" + ",".join(str(v) if isinstance(v, int | np.integer) else _real(v) for v in values) + ")"


_UNITS = {"mm": ".MILLI.", "cm": ".CENTI.", "m": "$"}


def save_step(path: str | os.PathLike[str], surfaces: Surface | Sequence[Surface], *, unit: str = "mm", name: str = "target") -> None:
    """Writes surfaces as faces of a STEP AP214 file for CAD programs; ``unit`` (mm, cm or m) is that of the coordinates.

    A surface closed in a direction is written as two faces, so that no face meets itself; sides that are one point are left out of
    the boundary.
    """
    require(unit in _UNITS, "unit", "mm, cm or m", repr(unit))
    many = _shapes(surfaces)
    require(all(isinstance(s, Surface) for s in many), "surfaces", "surfaces only", "a curve")
    step = _Step()
    faces = [step.face(part) for s in many if isinstance(s, Surface) for part in _open_parts(s.clamped())]
    length = step.add(f"(LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT({_UNITS[unit]},.METRE.))")
    angle = step.add("(NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.))")
    solid = step.add("(NAMED_UNIT(*) SI_UNIT($,.STERADIAN.) SOLID_ANGLE_UNIT())")
    exact = step.add(f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-06),{length},'distance_accuracy_value','')")
    context = step.add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({exact})) "
        f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid})) REPRESENTATION_CONTEXT('',''))"
    )
    shell = step.add(f"OPEN_SHELL('',({','.join(faces)}))")
    model = step.add(f"SHELL_BASED_SURFACE_MODEL('',({shell}))")
    shape = step.add(f"MANIFOLD_SURFACE_SHAPE_REPRESENTATION('',({model}),{context})")
    application = step.add("APPLICATION_CONTEXT('core data for automotive mechanical design processes')")
    step.add(f"APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,{application})")
    product_context = step.add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
    label = name.encode("ascii", "replace").decode().replace("'", "''")
    product = step.add(f"PRODUCT('{label}','{label}','',({product_context}))")
    formation = step.add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    stage = step.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
    definition = step.add(f"PRODUCT_DEFINITION('design','',{formation},{stage})")
    whole = step.add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
    step.add(f"SHAPE_DEFINITION_REPRESENTATION({whole},{shape})")
    now = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%S")
    header = (
        "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\n"
        f"FILE_NAME('{Path(path).name.encode('ascii', 'replace').decode()}','{now}',(''),(''),'mvcore','mvcore','');\n"
        "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
    )
    atomically(Path(path), lambda p: p.write_text(header + "\n".join(step.lines) + "\nENDSEC;\nEND-ISO-10303-21;\n") and None)


def _open_parts(surface: Surface) -> list[Surface]:
    parts = [surface]
    for axis, direction in enumerate(("u", "v")):
        ends = np.moveaxis(surface.control_points, axis, 0)[[0, -1]]
        size = float(np.ptp(surface.control_points.reshape(-1, 3), axis=0).max())
        if np.abs(ends[0] - ends[1]).max() <= 1e-9 * size:
            parts = [half for part in parts for half in part.split(direction, sum(part.domain[axis]) / 2)]  # type: ignore[arg-type]
    return parts
