"""Settings: one frozen dataclass a stage, each field with its type, range, unit and reason.

Values are checked wherever a settings object is made: by ``Config.from_dict``, ``Config.from_file`` or a class itself.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from .errors import FormatError, InvalidInputError, require

T = TypeVar("T")
MATCHERS = ("sgm", "dcnn")
DEVICES = ("cpu", "cuda")


def within(low: float, high: float, unit: str) -> msgspec.Meta:
    """The range of a setting, both ends allowed, and its unit."""
    return msgspec.Meta(ge=low, le=high, extra={"unit": unit})


@functools.cache
def _types(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


class Checked:
    """A dataclass whose fields are of their declared types and within their ranges, or which is not made."""

    def __post_init__(self) -> None:
        section = type(self).__name__.removesuffix("Config").lower()
        for name, kind in _types(type(self)).items():
            value = _plain(getattr(self, name))
            object.__setattr__(self, name, _converted(f"{section}.{name}" if section else name, value, kind))


def _plain(value: Any) -> Any:
    """NumPy's scalars and zero-dimensional arrays as Python's numbers."""
    return value.item() if getattr(value, "shape", None) == () and hasattr(value, "item") else value


def _converted(name: str, value: Any, kind: Any) -> Any:
    if isinstance(kind, type) and issubclass(kind, Checked):
        require(isinstance(value, kind), name, f"a {kind.__name__}", repr(value))
        return value
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError:
        raise InvalidInputError(f"{name}: expected {_expected(kind)}, got {_shown(value)}") from None


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _expected(kind: Any) -> str:
    """What a field's type asks for, in words: ``a whole number from 16 to 65536 (pixels)``."""
    origin = typing.get_origin(kind)
    if origin is Annotated:
        number, meta = typing.get_args(kind)
        what = "a whole number" if number is int else "a number"
        return f"{what} from {_number(meta.ge)} to {_number(meta.le)} ({meta.extra['unit']})"
    if origin is Literal:
        return f"one of {', '.join(typing.get_args(kind))}"
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_expected(k) for k in typing.get_args(kind))
    return {bool: "true or false", type(None): "None"}[kind]


def _number(value: float) -> str:
    return str(int(value)) if math.isfinite(value) and value == int(value) and abs(value) < 1e16 else f"{value:g}"


@dataclass(frozen=True)
class SparseConfig(Checked):
    """Feature points: depth ranges, view scores and the health of the calibration."""

    max_features: Annotated[int, within(10, 1_000_000, "features")] = 4000
    """SIFT features a view: enough for ranges and scores; matching grows with the square."""
    neighbours: Annotated[int, within(1, 10_000, "views")] = 8
    """Views that each view is matched with, nearest in position and direction first."""
    ratio: Annotated[float, within(0, 1, "ratio of distances")] = 0.8
    """Lowe's ratio test along the epipolar line."""
    band: Annotated[float, within(0.1, 1000, "pixels")] = 2.0
    """Pixels: half width of the epipolar band, widened where the calibration is found to be worse."""
    min_parallax: Annotated[float, within(0, 90, "degrees")] = 3.0
    """Degrees: a point seen under less has no reliable depth."""
    max_error: Annotated[float, within(0.01, 1000, "pixels")] = 2.0
    """Pixels of reprojection error above which a point is dropped."""
    warn_error: Annotated[float, within(0, 1e6, "pixels")] = 1.0
    """Pixels of median epipolar error above which the calibration is called doubtful."""
    fail_error: Annotated[float, within(0, 1e6, "pixels")] = 5.0
    """Pixels of median epipolar error above which reconstruction is refused."""
    range_stretch: Annotated[float, within(0, 100, "share")] = 0.25
    """Share by which a view's 1 % .. 99 % depth range is stretched at either end."""


@dataclass(frozen=True)
class DepthConfig(Checked):
    """Depth maps by plane sweep, semi-global aggregation and slanted refinement."""

    sources: Annotated[int, within(1, 1000, "views")] = 6
    """Source views a reference view: the paper's figure; the best half is used at each pixel."""
    best_angle: Annotated[float, within(0, 90, "degrees")] = 5.0
    """Degrees between views that match best: less has no parallax, more looks different."""
    max_angle: Annotated[float, within(1, 180, "degrees")] = 65.0
    """Degrees beyond which two views do not show the same surface."""
    planes: Annotated[int, within(2, 4096, "planes")] = 128
    """Planes of the sweep, uniform in inverse depth: the paper's figure."""
    coarsest: Annotated[int, within(16, 65_536, "pixels")] = 200
    """Pixels: the sweep runs where the longer side is about this long; below, windows see too little."""
    p1: Annotated[int, within(0, 127, "cost units")] = 6
    """Aggregation penalty of a step by one plane, cost units (0 .. 64)."""
    p2: Annotated[int, within(0, 127, "cost units")] = 60
    """Aggregation penalty of a larger step on an even surface, cost units."""
    p2_falloff: Annotated[int, within(1, 255, "grey levels")] = 12
    """Grey levels of an image edge at which `p2` has halved."""
    edge_radius: Annotated[int, within(0, 100, "pixels")] = 14
    """Pixels of the sweep's scale around a pixel whose colours and depths decide whose side of an edge it is on; 0 leaves that out."""
    sweep_rounds: Annotated[int, within(0, 100, "rounds")] = 3
    """Rounds of slanted refinement at the sweep's scale, where they are cheap."""
    rounds: Annotated[int, within(0, 100, "rounds")] = 1
    """Rounds at each finer scale."""
    network_weight: Annotated[float, within(0, 127, "cost units")] = 16.0
    """With the network: cost units, at full confidence, of a plane far from what it found."""
    network_reach: Annotated[float, within(0.01, 4096, "planes")] = 6.0
    """Planes at which that cost stops growing."""
    max_slant: Annotated[float, within(0, 89.9, "degrees")] = 76.0
    """Degrees between a surface's normal and the view: flatter surfaces cannot be matched."""
    prior_weight: Annotated[float, within(0, 100, "units of 1 - ZNCC")] = 0.1
    """Pull towards the semi-global solution, in units of 1 - ZNCC: decides only where the photographs do not."""
    prior_reach: Annotated[float, within(0.01, 4096, "planes")] = 4.0
    """Planes at which that pull stops growing."""
    max_image_size: Annotated[int, within(16, 65_536, "pixels")] = 1600
    """Pixels: longer sides are reduced to this; detail beyond costs time and rarely adds shape."""
    geometry_weight: Annotated[float, within(0, 100, "units of 1 - ZNCC")] = 0.2
    """Cost of missing the other views' surfaces by three pixels or more, in units of 1 - ZNCC."""
    geometry_rounds: Annotated[int, within(0, 100, "rounds")] = 1
    """Rounds at half the size once the other views' depth is known."""
    surface_rounds: Annotated[int, within(0, 100, "rounds")] = 1
    """Rounds at full size that start from the surface of all views; 0 leaves the third pass out."""
    surface_lead: Annotated[float, within(0, 100, "units of 1 - ZNCC")] = 0.05
    """Cost by which a view's own depth must beat that surface to be kept, in units of 1 - ZNCC: many views speak for the surface."""
    min_views: Annotated[int, within(1, 1000, "views")] = 1
    """Fewest other views that must agree with a depth, at the tightest tolerance."""
    pixel_unit: Annotated[float, within(0.001, 100, "pixels a view")] = 0.25
    """Pixels of reprojection error allowed per agreeing view."""
    depth_unit: Annotated[float, within(1e-7, 1, "share of the depth a view")] = 1.0 / 1200.0
    """Relative depth error allowed per agreeing view."""
    fusion_units: Annotated[float, within(0.01, 1000, "times the tolerances")] = 2.15
    """Times these tolerances a depth may err and still be fused: many views average what one must not show alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.p2 >= self.p1, "depth.p2", f"at least depth.p1 ({self.p1})", self.p2)
        require(self.best_angle <= self.max_angle, "depth.best_angle", f"at most depth.max_angle ({self.max_angle:g})", self.best_angle)

    def loosened(self) -> DepthConfig:
        """With the tolerances that fusion takes."""
        k = self.fusion_units
        return dataclasses.replace(self, pixel_unit=min(k * self.pixel_unit, 100.0), depth_unit=min(k * self.depth_unit, 1.0))


@dataclass(frozen=True)
class VolumeConfig(Checked):
    """Fusion of the depth maps into a block-sparse signed distance field."""

    voxel: Annotated[float, within(1e-12, 1e12, "world units")] | None = None
    """World units; by default `footprints` pixel footprints of the target."""
    footprints: Annotated[float, within(0.1, 1000, "pixel footprints")] = 1.35
    """Pixel footprints a voxel: below 1 there is nothing to resolve, above 1.5 detail is lost."""
    hull_footprints: Annotated[float, within(0.1, 1000, "pixel footprints")] = 3.0
    """The same for a visual hull alone: silhouettes say little about detail."""
    truncation: Annotated[float, within(1, 64, "voxels")] = 5.0
    """Voxels on either side of a surface that carry its distance."""
    free_weight: Annotated[float, within(0, 100, "weight")] = 0.3
    """Weight of seeing through a voxel against seeing a surface there."""
    min_weight: Annotated[float, within(0, 1000, "weight")] = 0.05
    """Weight of surface observations below which nothing is solid; 1 is a confident depth at the target's distance."""
    solid_share: Annotated[float, within(0, 1000, "weight a view")] = 0.3
    """With silhouettes: weight of observations, a view, that overrules the solid inside of the hull; times the share of the silhouettes'
    pixels that was not measured (where depth maps show little, what they show is doubtful), times the square of the share that was not
    measured off the hull (of a hollow thing the hull says little)."""
    smoothing: Annotated[float, within(0, 16, "voxels")] = 0.7
    """Voxels: standard deviation of the field's smoothing without masks, and with them where depth maps measured it well."""
    solid_smoothing: Annotated[float, within(0, 16, "voxels")] = 2.0
    """With masks, elsewhere: where depth is known here and not there, the solid inside of the hull would leave crumbs."""
    hull_tolerance: Annotated[float, within(0, 1, "share of the views")] = 0.04
    """Share of the silhouettes that may disagree: one wrong mask among 25 does no harm; with fewer views each is needed."""
    max_memory: Annotated[int, within(1, 1 << 50, "bytes")] = 4 << 30
    """Bytes of the volume; the voxels grow until it fits, and the report says so."""


@dataclass(frozen=True)
class BackgroundConfig(Checked):
    """Foreground masks of a target in clips."""

    threshold: Annotated[float, within(0, 255, "grey levels")] = 12.0
    """Grey levels by which a pixel must differ from the background; three times the measured noise where that is more."""
    noise: Annotated[float, within(0, 255, "grey levels")] = 3.0
    """Grey levels of noise: a weaker pattern is none, and cannot tell a shadow from a thing."""
    window: Annotated[int, within(1, 255, "pixels")] = 7
    """Pixels a side of the window over which patterns are compared."""
    correlation: Annotated[float, within(-1, 1, "correlation")] = 0.5
    """Correlation of a pattern with the background's above which it is the background in another light."""
    least_part: Annotated[float, within(0, 1, "share")] = 0.02
    """Parts of a mask smaller than this share of the largest are dropped."""
    cut_rounds: Annotated[int, within(0, 100, "rounds")] = 2
    """Rounds of GrabCut, which brings a mask's border onto the image's edges."""
    max_size: Annotated[int, within(16, 65_536, "pixels")] = 960
    """Pixels of the longer side at which masks are found; larger frames are reduced for it."""
    samples: Annotated[int, within(1, 10_000, "instants")] = 25
    """Instants from which a background is learnt where there is no clean plate."""
    learn_size: Annotated[int, within(16, 65_536, "pixels")] = 480
    """Pixels of the longer side at which the target's colours are learnt for it."""


@dataclass(frozen=True)
class CarveConfig(Checked):
    """Space carving."""

    resolution: Annotated[int, within(4, 1024, "voxels")] = 96
    """Voxels along the longest side where cameras agree on masks: a few pixels each."""
    tolerance: Annotated[float, within(0, 1, "share of the cameras")] = 0.2
    """Share of the cameras that may not support a voxel there: one of five, as things stand before others."""
    photo_consistency: bool = False
    """Whether a hull that no depth map bounds is carved on where its photographs disagree."""
    threshold: Annotated[int, within(0, 255, "grey levels")] = 18
    """Grey levels between two views' colours of a voxel beyond which they contradict each other."""
    least_views: Annotated[int, within(1, 10_000, "views")] = 3
    """Views that must see a voxel before their colours may remove it."""
    rounds: Annotated[int, within(0, 10_000, "rounds")] = 8
    """Most rounds of six sweeps; usually far fewer change anything."""


@dataclass(frozen=True)
class StandingConfig(Checked):
    """Silhouettes of what stands on the ground, found without masks where the depth maps show little of it."""

    enabled: bool = True
    """Whether such silhouettes complete the surface."""
    max_measured: Annotated[float, within(0, 1, "share")] = 0.5
    """Share of the silhouettes' pixels with a filtered depth above which the depth maps do without: hulls fill hollows."""
    min_agreement: Annotated[float, within(0, 1, "share")] = 0.88
    """Intersection over union of a silhouette and the common hull's, in the median view: less is no outline of one thing."""
    min_shown: Annotated[float, within(0, 1, "share of the views")] = 0.7
    """Share of the views that must show it; their hull tells the others where it is."""
    max_gap: Annotated[float, within(0, 360, "degrees")] = 90.0
    """Degrees between neighbouring cameras around it: beyond, the hull is more corner than target."""
    ground_share: Annotated[float, within(0, 1, "share of the points")] = 0.3
    """Least share of the measured points that lie on the ground, less twice those under it."""
    ground_tolerance: Annotated[float, within(1e-6, 1, "share of the box")] = 0.01
    """Share of the box's longest side within which a point counts as on the ground; targets begin at twice that."""
    step: Annotated[int, within(1, 1000, "pixels")] = 4
    """Pixels between the points that the ground is sought in."""
    look_size: Annotated[int, within(16, 65_536, "pixels")] = 160
    """Pixels of the longer side for the quick look that tells how much was measured."""
    max_size: Annotated[int, within(16, 65_536, "pixels")] = 480
    """Pixels of the longer side at which silhouettes are found."""


@dataclass(frozen=True)
class SurfaceConfig(Checked):
    """From the field to the mesh."""

    min_component: Annotated[float, within(0, 1, "share of the area")] = 0.005
    """Parts with a smaller share of the area than this, relative to the largest, are dropped."""
    close_holes: Annotated[int, within(0, 1_000_000, "edges")] = 120
    """Holes of at most this many edges (of somewhat less than a voxel) are closed where they lie in the surface; 0 leaves them all."""
    unseen_reach: Annotated[float, within(0, 1e6, "voxels")] | None = 1.0
    """With silhouettes: voxels from what a photograph shows beyond which the hull's other sides are left open: there it is a bound and no
    measurement. None keeps them, and with them a closed surface."""
    smooth: Annotated[int, within(0, 1000, "rounds")] = 0
    """Rounds of Taubin smoothing: rounds off noise without shrinking."""
    decimation: Annotated[float, within(0, 1000, "voxels")] = 0.25
    """Voxels by which decimation may move the surface, as a root mean square. At 0.25 (a third of a
    pixel footprint) 90 to 97 % of the faces go, and F-scores at 1, 2 and 4 footprints change by at
    most .004, .001 and .001. 0 keeps all faces."""
    max_faces: Annotated[int, within(4, 1_000_000_000, "faces")] | None = None
    """Faces to decimate to where those are more, whatever that moves; None sets no limit."""


@dataclass(frozen=True)
class TextureConfig(Checked):
    """Images onto the mesh."""

    candidates: Annotated[int, within(1, 64, "views")] = 8
    """Views that are kept for each face, the best by resolution and contrast: memory and cost do not grow with the views beyond."""
    seam: Annotated[float, within(0, 1000, "cost a voxel")] = 0.2
    """Cost of a voxel of seam against the best and the worst view of a square voxel of surface (1)."""
    outlier: Annotated[float, within(0, 1000, "grey levels")] = 60.0
    """Grey levels, after the colour gains, by which a view may differ from the median of a face's: beyond, it shows an occluder or a
    highlight."""
    loyalty: Annotated[float, within(0, 1, "share")] = 0.5
    """Share by which the view that a face had in the frame before counts as better: it changes only where another is clearly better."""
    least_patch: Annotated[float, within(0, 1e9, "square voxels")] = 12.0
    """Area below which a patch takes its neighbour's view."""
    mask_erosion: Annotated[int, within(0, 1000, "pixels")] = 3
    """Pixels taken off the masks: their borders mix in background."""
    max_size: Annotated[int, within(16, 65_536, "texels")] = 8192
    """Texels a side of the atlas; images are reduced until it fits."""
    padding_depth: Annotated[float, within(0, 1000, "voxels")] = 2.0
    """Voxels by which a vertex may lie behind the z-buffer and still count as seen."""


@dataclass(frozen=True)
class VideoConfig(Checked):
    """Clips: what instants share."""

    segment: Annotated[int, within(1, 1_000_000, "instants")] = 8
    """Instants of a chain: its first is searched in full, each later one starts from the surface before it."""
    chains: Annotated[int, within(1, 1000, "chains")] = 2
    """Chains that are worked on at a time."""
    margin: Annotated[float, within(0, 10, "share of the box")] = 0.06
    """Share of a target's silhouette box added around it before the frames are cropped."""
    stereo_angle: Annotated[float, within(0, 180, "degrees")] = 40.0
    """Degrees between a view and its nearest neighbour, in the median, beyond which stereo cannot work and the hull is the result."""
    least_target: Annotated[float, within(0, 1, "share of the volume")] = 0.1
    """Parts of the hull with a smaller share of the largest part's volume are no targets, unless they are close to one."""
    model_instants: Annotated[int, within(1, 10_000, "instants")] = 16
    """Most instants, spread over the clip, whose views make a rigid target's model."""
    registration_points: Annotated[int, within(100, 10_000_000, "points")] = 30_000
    """Points an instant for the poses of a rigid target."""
    registration_rounds: Annotated[int, within(1, 10_000, "rounds")] = 40
    """Rounds of their joint refinement."""


@dataclass(frozen=True)
class Config(Checked):
    """Everything that can be set.

    Raises
    ------
    InvalidInputError
        A value of another type or outside its range: the message names the setting, what was expected and what came.

    Examples
    --------
    >>> Config.from_dict({"volume": {"footprints": 1.5}}).volume.footprints
    1.5
    >>> DepthConfig(coarsest=0)
    Traceback (most recent call last):
    mvcore.errors.InvalidInputError: depth.coarsest: expected a whole number from 16 to 65536 (pixels), got 0
    """

    sparse: SparseConfig = field(default_factory=SparseConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    volume: VolumeConfig = field(default_factory=VolumeConfig)
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    carve: CarveConfig = field(default_factory=CarveConfig)
    standing: StandingConfig = field(default_factory=StandingConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    texture: TextureConfig = field(default_factory=TextureConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    matcher: Literal["sgm", "dcnn"] = "sgm"
    """The depth matcher: ``sgm`` is the classical one, ``dcnn`` asks the network as well: a little better, twice the time."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network runs: ``cpu``, or ``cuda`` where torch finds such a device."""

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """From nested mappings; unknown keys are refused with the nearest known one."""
        return cls().updated(values)

    @classmethod
    def from_file(cls, path: str | Path) -> Config:
        """From a TOML file with a table a stage (``[depth]``), or a JSON file of the same.

        Raises
        ------
        FileNotFoundError
            No such file.
        FormatError
            No TOML or JSON, an unknown key, or a value outside its range; with the path, and the line where the file cannot be read.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file of settings")
        values = _read_json(path) if path.suffix.lower() == ".json" else _read_toml(path)
        try:
            return cls.from_dict(values)
        except InvalidInputError as error:
            raise FormatError(f"{path}: {error}") from None

    def updated(self, values: Mapping[str, Any]) -> Config:
        """The same settings with some values, nested as in `from_dict`, in place of these."""
        return _updated(self, values, "config")


def _updated(settings: T, values: Mapping[str, Any], where: str) -> T:
    require(isinstance(values, Mapping), where, "a mapping", _shown(values))
    known = [f.name for f in dataclasses.fields(settings)]  # type: ignore[arg-type]
    arguments = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, 1)
            hint = f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"
            raise InvalidInputError(f"{where}: unknown key {key!r}{hint}")
        part = getattr(settings, key)
        nested = isinstance(part, Checked) and not isinstance(value, Checked)
        arguments[key] = _updated(part, value, f"{where}.{key}") if nested else value
    return dataclasses.replace(settings, **arguments)  # type: ignore[type-var]


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:  # also of text that is not UTF-8
        raise FormatError(f"{path}: not a TOML file: {error}") from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not a JSON file: {error}") from None
