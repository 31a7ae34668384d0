"""Every function of the compiled module with mad arguments: ``python -m fuzz.kernels --seconds 60`` in the folder ``tests``."""

from __future__ import annotations

import argparse
import random
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from mvcore import _core
from mvcore.errors import MvcoreError

from . import runner

H, W = 12, 16
ALLOWED = (MvcoreError, MemoryError, TypeError, OverflowError)
"""TypeError and OverflowError: arguments that are no arrays or no numbers of the right kind never reach a kernel."""
SCALARS = (
    *(0, -1, 1, 2, 7, 1 << 16, 1 << 31, 1 << 40, 1 << 63, (1 << 64) - 1),
    *(0.0, -1.0, 0.5, 1e-45, 1e-300, 1e300, 3e38, float("nan"), float("inf")),
)
VALUES = (0, 1, -1, 0.5, 255, 1e-30, 1e30, 1e300, float("nan"), float("inf"), -float("inf"))
KINDS = (np.uint8, np.float32, np.float64, np.uint32, np.int32, np.int64, np.bool_)
Arguments = dict[str, Any]


def calls() -> dict[str, Arguments]:
    """A call of each function that succeeds."""
    rng = np.random.default_rng(0)
    grey = lambda: rng.integers(0, 256, (H, W), np.uint8)  # noqa: E731
    rgb = lambda: rng.integers(0, 256, (H, W, 3), np.uint8)  # noqa: E731
    ones = np.ones((H, W), np.float32)
    pair = np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0]], np.float32)
    projection = np.array([[10.0, 0, 8, 0], [0, 10, 6, 0], [0, 0, 1, 0]])
    vertices = np.array([[-1.0, -1, 3], [1, -1, 3], [1, 1, 3], [-1, 1, 3]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    mesh = {"vertices": vertices, "faces": faces}
    grid = {"origin": (-1.0, -1.0, 2.0), "voxel": 0.2, "shape": (10, 10, 10)}
    knots = np.array([0, 0, 0, 0, 1, 1, 1, 1.0])
    u = np.array([0.1, 0.5])
    net = rng.random((4, 4, 3))
    fusion = {"truncation": 0.5, "free_weight": 0.3, "min_weight": 0.1, "solid_weight": 0.1, "smoothing": 0.7, "measured_smoothing": 0.5}
    points = rng.random((6, 3))
    surface = {"knots": (knots, knots), "u": u, "v": u}
    features = {"positions_a": rng.random((5, 2), np.float32) * 9, "descriptors_a": rng.integers(0, 256, (5, 128), np.uint8)}
    features |= {"positions_b": rng.random((4, 2), np.float32) * 9, "descriptors_b": rng.integers(0, 256, (4, 128), np.uint8)}
    filters = {"radius": 2, "step": 1, "colour": 10.0, "distance": 2.0, "slack": 0.5}
    search = {"iterations": 1, "low": 0.1, "high": 4.0, "step": 0.5, "max_slope": 0.5, "prior_weight": 0.1, "prior_reach": 1.0}
    out: dict[str, Arguments] = {
        "sweep": {"reference": grey(), "images": [grey()], "maps": pair, "planes": np.array([1.0, 2.0], np.float32), "best": 0},
        "aggregate": {"costs": rng.integers(0, 99, (H, W, 4), np.uint8), "guide": grey(), "p1": 3, "p2": 20, "p2_falloff": 2},
        "expect": {"costs": np.zeros((H, W, 4), np.uint8), "expected": ones, "confidence": ones, "weight": 2.0, "reach": 3.0},
        "weighted_median": {"values": ones, "guide": rgb(), "doubtful": grey(), **filters},
        "correlate": {
            "reference": rng.random((H, W, 4), np.float32),
            "sources": [rng.random((H, W, 4), np.float32)],
            "maps": pair,
            "planes": np.array([1.0, 2.0], np.float32),
            "gain": np.ones(2, np.float32),
            "bias": 0.1,
        },
        "refine": {
            "reference": grey(),
            "images": [grey()],
            "maps": pair,
            "depths": [ones],
            "backs": pair,
            "init": np.ones((H, W, 4), np.float32),
            "prior": ones,
            **search,
            "geometry_weight": 0.1,
            "adjacent": True,
        },
        "match_epipolar": {**features, "fundamental": rng.random((3, 3)), "band": 5.0, "ratio": 0.8},
        "rasterize": {**mesh, "matrix": projection, "width": W, "height": H},
        "consistency": {
            "depth": ones,
            "others": [ones],
            "there": pair,
            "back": pair,
            "min_views": 1,
            "pixel_unit": 1.0,
            "depth_unit": 0.1,
        },
        "fuse": {
            **grid,
            "depths": [3 * ones],
            "weights": [ones],
            "silhouettes": [-ones],
            "windows": [(0.0, 0.0, 16.0, 12.0)],
            "projections": projection[None],
            "tile": None,
            **fusion,
            "hull_tolerance": 0.1,
            "complete": False,
            "hollow": False,
            "max_memory": 1 << 28,
        },
        "carve": {**grid, "masks": [grey()], "projections": projection[None], "tolerance": 0.1, "least_views": 1},
        "photo_carve": {
            "origin": grid["origin"],
            "voxel": 0.2,
            "occupied": np.ones((8, 8, 8), bool),
            "low": [rgb(), rgb()],
            "high": [rgb(), rgb()],
            "projections": np.stack([projection, projection]),
            "centers": [(0.0, 0.0, 0.0)] * 2,
            "threshold": 9,
            "least_views": 2,
            "rounds": 2,
        },
        "isosurface_dense": {"values": rng.normal(size=(9, 9, 9)).astype(np.float32)},
        "isosurface_sparse": {
            "coords": np.array([[0, 0, 0], [0, 0, 1]], np.uint32),
            "values": rng.normal(size=(2, 8, 8, 8)).astype(np.float32),
        },
        "components": {"faces": faces},
        "close_holes": {**mesh, "most_edges": 8},
        "decimate": {**mesh, "error": 0.1, "most_faces": 4, "keep_borders": True},
        "nearest": {"points": points, "others": points[::-1].copy(), "reach": 5.0},
        "encode_png": {"rgb": rgb()},
        "nurbs_basis": {"knots": knots, "count": 4, "u": u, "order": 1},
        "nurbs_curve": {"control": net[0], "knots": knots, "u": u, "order": 1, "rational": False},
        "nurbs_surface": {"control": net, **surface, "order": 1, "rational": False},
        "nurbs_surface_partials": {"control": net, **surface, "orders": [(0, 0), (1, 0)]},
        "nurbs_surface_grid": {"control": net, **surface, "order": 1, "rational": True},
        "nurbs_control_gradient": {**_only(surface), "counts": (4, 4), "u": u, "v": u, "gradient": rng.random((2, 3)), "orders": (0, 1)},
        "nurbs_curve_control_gradient": {"knots": knots, "count": 4, "u": u, "gradient": rng.random((2, 3)), "order": 1},
        "nurbs_knot_gradient": {"control": net, **surface, "gradient": rng.random((2, 3))},
        "nurbs_curve_knot_gradient": {"control": net[0], "knots": knots, "u": u, "gradient": rng.random((2, 3))},
    }
    lists = {"views": np.full((2, 8), -1, np.int16), "qualities": np.zeros((2, 8), np.float32), "colours": np.zeros((2, 8, 3), np.uint8)}
    lists["views"][:, 0], lists["qualities"][:, 0] = 0, 1
    photo = {"image": rgb(), "detail": ones, "depth": 3 * ones, "matrix": projection, "center": (0.0, 0.0, 0.0), "tolerance": 0.1}
    lit = {"uv": rng.random((4, 2), np.float32), "normals": np.tile(np.float32([0, 0, -1]), (4, 1)), "materials": np.zeros(2, np.uint16)}
    lit |= {"textures": rng.integers(0, 256, (2, 4, 4, 3), np.uint8), "gloss": np.zeros((1, 5), np.float32), "matrices": projection[None]}
    labels = {"labels": np.zeros(2, np.int32), "matrices": projection[None]}
    out |= {
        "distance_transform": {"sites": grey() // 200},
        "rate_faces": {**mesh, **photo},
        "keep_best": {"view": 1, "quality": np.ones(2, np.float32), "colour": np.zeros((2, 3), np.uint8), **lists},
        "compare_views": {**lists, "count": 2, "sample": 16},
        "select_views": {
            **mesh,
            **lists,
            "gains": np.ones((2, 3), np.float32),
            "unit": 1.0,
            "seam": 1.0,
            "outlier": 3.0,
            "least_patch": 2.0,
        },
        "shade": {**mesh, **lit, "lamp": (0.0, 0.0, -1.0), "width": W, "height": H, "samples": 1},
        "atlas": {**mesh, **labels, "image": rgb(), "gains": np.ones((1, 3), np.float32)},
    }
    return out


def _atlas(vertices: Any, faces: Any, labels: Any, matrices: Any, image: Any, gains: Any) -> Any:
    atlas = _core.Atlas(vertices, faces, labels, matrices)
    for view in atlas.views:
        atlas.add_view(view, image)
    return atlas.finish(gains)


def function(name: str) -> Callable[..., Any]:
    """What a name of a call stands for."""
    return _atlas if name == "atlas" else getattr(_core, name)


def _only(surface: Arguments) -> Arguments:
    return {"knots": surface["knots"]}


def _array(value: np.ndarray, random: random.Random) -> Any:
    """An array of another kind, shape, order or with other values."""
    choice = random.randrange(9)
    if choice == 0:
        return value.astype(random.choice(KINDS))
    if choice == 1:
        return value[tuple(slice(0, random.choice((0, 1, 2, n))) for n in value.shape)].copy()
    if choice == 2:
        return value[None].copy() if random.random() < 0.5 else value[..., None].copy()
    if choice == 3:
        return value.reshape(-1) if random.random() < 0.5 else np.ascontiguousarray(value.T)
    if choice == 4:
        return value[::-1] if random.random() < 0.5 else np.asfortranarray(value)
    if choice == 5:
        shape = tuple(random.choice((n, n + 1, 2 * n, 1, 0)) for n in value.shape)
        return np.resize(value, shape) if value.size else np.zeros(shape, value.dtype)
    if choice == 6:
        return np.zeros_like(value)
    out = value.copy()
    for _ in range(random.choice((1, 3, out.size)) if out.size else 0):
        number = random.choice(VALUES)
        if out.dtype.kind in "ui":
            number = random.choice((0, 1, np.iinfo(out.dtype).max, np.iinfo(out.dtype).min, random.randrange(256)))
        elif out.dtype == np.float32:
            number = float(np.clip(number, -3e38, 3e38)) if np.isfinite(number) else number
        out.reshape(-1)[random.randrange(out.size)] = number
    return out


def mad(value: Any, random: random.Random) -> Any:
    """A value that does not fit, or only just."""
    if isinstance(value, np.ndarray):
        return _array(value, random)
    if isinstance(value, (list, tuple)):
        items = list(value)
        choice = random.randrange(4)
        if choice == 0:
            items = items[:-1]
        elif choice == 1:
            items = items * random.choice((0, 2, 40))
        elif items:
            at = random.randrange(len(items))
            items[at] = mad(items[at], random)
        return type(value)(items)
    if isinstance(value, bool):
        return not value
    number = random.choice(SCALARS)
    return int(number) if isinstance(value, int) and number == number and abs(number) < 1e30 else number


class Fuzzer:
    """Cases by number."""

    def __init__(self, seed: int, only: str = "") -> None:
        self.calls = [(n, a) for n, a in calls().items() if only in n]
        self.seed = seed

    def call(self, number: int) -> tuple[str, Callable[..., Any], Arguments]:
        """The function and the arguments of a case."""
        source = random.Random(zlib.crc32(f"{self.seed} {number}".encode()))
        name, arguments = self.calls[number % len(self.calls)]
        changed = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in arguments.items()}
        for _ in range(source.choice((1, 1, 2))):
            key = source.choice(list(changed))
            changed[key] = mad(changed[key], source)
        return name, function(name), changed

    def __call__(self, number: int) -> None:
        """Run a case."""
        _, function, arguments = self.call(number)
        try:
            function(**arguments)
        except ValueError as error:
            # PyO3's own, for a sequence of another length in place of a point or a pair: it never reaches a kernel.
            if not str(error).startswith(("expected a sequence of length", "expected tuple of length")):
                raise


def _shown(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist() if value.size <= 12 else f"{value.dtype}{value.shape}"
    return [_shown(v) for v in value] if isinstance(value, list | tuple) else value


def main() -> int:
    """Run for a time and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--count", type=int, default=10**9)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a function's name")
    options = parser.parse_args()
    fuzzer = Fuzzer(options.seed, options.only)
    outcome = runner.run(fuzzer, options.count, options.seconds, options.first, ALLOWED)
    print(outcome)
    for what, numbers in outcome.failures.items():
        name, _, arguments = fuzzer.call(numbers[0])
        shown = {k: _shown(v) for k, v in arguments.items()}
        print(f"case {numbers[0]} ({name}): {what}\n  {shown!s:.1500}")
    return 1 if outcome.failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
