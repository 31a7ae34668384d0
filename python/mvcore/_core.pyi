"""The Rust kernels. Arrays must be C-contiguous; wrong shapes raise `ValueError`, bad values `InvalidInputError`."""

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Atlas",
    "Interrupt",
    "aggregate",
    "carve",
    "close_holes",
    "compare_views",
    "components",
    "consistency",
    "correlate",
    "decimate",
    "distance_transform",
    "encode_png",
    "expect",
    "fuse",
    "isosurface_dense",
    "isosurface_sparse",
    "keep_best",
    "match_epipolar",
    "nearest",
    "nurbs_basis",
    "nurbs_control_gradient",
    "nurbs_curve",
    "nurbs_curve_control_gradient",
    "nurbs_curve_knot_gradient",
    "nurbs_knot_gradient",
    "nurbs_surface",
    "nurbs_surface_grid",
    "nurbs_surface_partials",
    "photo_carve",
    "rasterize",
    "rate_faces",
    "read_obj",
    "refine",
    "select_views",
    "shade",
    "sweep",
    "weighted_median",
]

_F32 = NDArray[np.float32]
_F64 = NDArray[np.float64]
_U8 = NDArray[np.uint8]
_U32 = NDArray[np.uint32]
_I16 = NDArray[np.int16]
_I32 = NDArray[np.int32]
_I64 = NDArray[np.int64]

@final
class Interrupt:
    def __new__(cls) -> Interrupt: ...
    def enter(self) -> None: ...
    def set(self) -> None: ...

def sweep(reference: _U8, images: Sequence[_U8], maps: _F32, planes: _F32, best: int = 0) -> _U8: ...
def aggregate(costs: _U8, guide: _U8, p1: int, p2: int, p2_falloff: int) -> tuple[_F32, _F32]: ...
def expect(costs: _U8, expected: _F32, confidence: _F32, weight: float, reach: float) -> None: ...
def weighted_median(
    values: _F32, guide: _U8, doubtful: _U8, *, radius: int, step: int, colour: float, distance: float, slack: float
) -> _F32: ...
def correlate(reference: _F32, sources: Sequence[_F32], maps: _F32, planes: _F32, gain: _F32, bias: float) -> _F32: ...
def refine(
    reference: _U8,
    images: Sequence[_U8],
    maps: _F32,
    depths: Sequence[_F32],
    backs: _F32,
    init: _F32,
    prior: _F32,
    *,
    iterations: int,
    low: float,
    high: float,
    step: float,
    max_slope: float,
    prior_weight: float,
    prior_reach: float,
    geometry_weight: float,
    adjacent: bool,
) -> _F32: ...
def consistency(
    depth: _F32,
    others: Sequence[_F32],
    there: _F32,
    back: _F32,
    min_views: int,
    pixel_unit: float,
    depth_unit: float,
) -> tuple[_F32, _U8]: ...
def decimate(vertices: _F64, faces: _U32, error: float, most_faces: int = ..., keep_borders: bool = ...) -> tuple[_F64, _U32]: ...
def distance_transform(sites: _U8) -> tuple[_U32, _U32]: ...
def fuse(
    origin: Sequence[float],
    voxel: float,
    shape: Sequence[int],
    depths: Sequence[_F32],
    weights: Sequence[_F32],
    silhouettes: Sequence[_F32] | None,
    windows: Sequence[tuple[float, float, float, float]],
    projections: _F64,
    *,
    tile: Sequence[Sequence[int]] | None = ...,
    cuts: Sequence[tuple[int, int, int, int]] | None = None,
    hints: NDArray[np.int8] | None = None,
    truncation: float,
    free_weight: float,
    min_weight: float,
    solid_weight: float,
    smoothing: float,
    measured_smoothing: float,
    hull_tolerance: float,
    complete: bool = ...,
    hollow: bool = ...,
    max_memory: int,
) -> tuple[_U32, _F32]: ...
def carve(
    origin: Sequence[float],
    voxel: float,
    shape: Sequence[int],
    masks: Sequence[_U8],
    projections: _F64,
    *,
    tolerance: float,
    least_views: int,
) -> NDArray[np.bool_]: ...
def photo_carve(
    origin: Sequence[float],
    voxel: float,
    occupied: NDArray[np.bool_],
    low: Sequence[_U8],
    high: Sequence[_U8],
    projections: _F64,
    centers: Sequence[Sequence[float]],
    *,
    threshold: int,
    least_views: int,
    rounds: int,
) -> NDArray[np.bool_]: ...
def isosurface_dense(values: _F32) -> tuple[_F32, _U32]: ...
def isosurface_sparse(coords: _U32, values: _F32) -> tuple[_F32, _U32]: ...
def close_holes(vertices: _F64, faces: _U32, most_edges: int) -> _U32: ...
def components(faces: _U32) -> _U32: ...
def nearest(points: _F64, others: _F64, reach: float = ...) -> tuple[_F64, _I64]: ...
def match_epipolar(
    positions_a: _F32,
    descriptors_a: _U8,
    positions_b: _F32,
    descriptors_b: _U8,
    fundamental: _F64,
    band: float,
    ratio: float,
) -> _U32: ...
def rasterize(vertices: _F64, faces: _U32, matrix: _F64, width: int, height: int) -> tuple[_F32, _I32]: ...
def shade(
    vertices: _F64,
    faces: _U32,
    uv: _F32,
    normals: _F32,
    materials: NDArray[np.uint16],
    textures: _U8,
    gloss: _F32,
    matrices: _F64,
    lamp: Sequence[float],
    width: int,
    height: int,
    samples: int = 2,
) -> _U8: ...
def rate_faces(
    vertices: _F64,
    faces: _U32,
    image: _U8,
    detail: _F32,
    depth: _F32,
    matrix: _F64,
    center: Sequence[float],
    tolerance: float,
) -> tuple[_F32, _U8]: ...
def keep_best(view: int, quality: _F32, colour: _U8, views: _I16, qualities: _F32, colours: _U8) -> None: ...
def compare_views(views: _I16, qualities: _F32, colours: _U8, count: int, sample: int) -> tuple[_I32, _U32, _F32]: ...
def select_views(
    vertices: _F64,
    faces: _U32,
    views: _I16,
    qualities: _F32,
    colours: _U8,
    gains: _F32,
    unit: float,
    seam: float,
    outlier: float,
    least_patch: float,
) -> _I32: ...

@final
class Atlas:
    """A texture atlas in the making; once finished it is empty."""

    def __new__(cls, vertices: _F64, faces: _U32, labels: _I32, matrices: _F64) -> Atlas: ...
    @property
    def size(self) -> tuple[int, int]:
        """Most texels (height, width) that it can have."""
    @property
    def views(self) -> list[int]:
        """The views that have charts, ascending."""
    def add_view(self, view: int, image: _U8) -> None: ...
    def finish(self, gains: _F32) -> tuple[_U32, _F32, _U32, _U8]: ...

def encode_png(rgb: _U8) -> bytes: ...
def read_obj(path: str) -> tuple[_F64, _U32]: ...
def nurbs_basis(knots: _F64, count: int, u: _F64, order: int) -> tuple[_I64, _F64]: ...
def nurbs_curve(control: _F64, knots: _F64, u: _F64, order: int, rational: bool) -> _F64: ...
def nurbs_surface(control: _F64, knots: tuple[_F64, _F64], u: _F64, v: _F64, order: int, rational: bool) -> _F64: ...
def nurbs_surface_partials(control: _F64, knots: tuple[_F64, _F64], u: _F64, v: _F64, orders: Sequence[tuple[int, int]]) -> _F64: ...
def nurbs_surface_grid(control: _F64, knots: tuple[_F64, _F64], u: _F64, v: _F64, order: int, rational: bool) -> _F64: ...
def nurbs_control_gradient(
    knots: tuple[_F64, _F64], counts: tuple[int, int], u: _F64, v: _F64, gradient: _F64, orders: tuple[int, int]
) -> _F64: ...
def nurbs_curve_control_gradient(knots: _F64, count: int, u: _F64, gradient: _F64, order: int) -> _F64: ...
def nurbs_knot_gradient(control: _F64, knots: tuple[_F64, _F64], u: _F64, v: _F64, gradient: _F64) -> tuple[_F64, _F64]: ...
def nurbs_curve_knot_gradient(control: _F64, knots: _F64, u: _F64, gradient: _F64) -> _F64: ...
