"""STEP files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import require
from ..io.files import atomically
from .checks import Array
from .curve import Curve
from .obj import _shapes
from .surface import Surface


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
