"""Settings: one frozen dataclass a stage, each field with its unit and its reason."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from .errors import InvalidInputError, require

T = TypeVar("T")


@dataclass(frozen=True)
class SparseConfig:
    """Feature points: depth ranges, view scores and the health of the calibration."""

    max_features: int = 4000
    """SIFT features a view: enough for ranges and scores; matching grows with the square."""
    neighbours: int = 8
    """Views that each view is matched with, nearest in position and direction first."""
    ratio: float = 0.8
    """Lowe's ratio test along the epipolar line."""
    band: float = 2.0
    """Pixels: half width of the epipolar band, widened where the calibration is found to be worse."""
    min_parallax: float = 3.0
    """Degrees: a point seen under less has no reliable depth."""
    max_error: float = 2.0
    """Pixels of reprojection error above which a point is dropped."""
    warn_error: float = 1.0
    """Pixels of median epipolar error above which the calibration is called doubtful."""
    fail_error: float = 5.0
    """Pixels of median epipolar error above which reconstruction is refused."""
    range_stretch: float = 0.25
    """Share by which a view's 1 % .. 99 % depth range is stretched at either end."""


@dataclass(frozen=True)
class DepthConfig:
    """Depth maps by plane sweep, semi-global aggregation and slanted refinement."""

    sources: int = 6
    """Source views a reference view: the paper's figure; the best half is used at each pixel."""
    best_angle: float = 5.0
    """Degrees between views that match best: less has no parallax, more looks different."""
    max_angle: float = 65.0
    """Degrees beyond which two views do not show the same surface."""
    planes: int = 128
    """Planes of the sweep, uniform in inverse depth: the paper's figure."""
    coarsest: int = 200
    """Pixels: the sweep runs where the longer side is about this long; below, windows see too little."""
    p1: int = 6
    """Aggregation penalty of a step by one plane, cost units (0 .. 64)."""
    p2: int = 60
    """Aggregation penalty of a larger step on an even surface, cost units."""
    p2_falloff: int = 12
    """Grey levels of an image edge at which `p2` has halved."""
    edge_radius: int = 14
    """Pixels of the sweep's scale around a pixel whose colours and depths decide whose side of an edge it is on; 0 leaves that out."""
    sweep_rounds: int = 3
    """Rounds of slanted refinement at the sweep's scale, where they are cheap."""
    rounds: int = 1
    """Rounds at each finer scale."""
    network_weight: float = 16.0
    """With the network: cost units, at full confidence, of a plane far from what it found."""
    network_reach: float = 6.0
    """Planes at which that cost stops growing."""
    max_slant: float = 76.0
    """Degrees between a surface's normal and the view: flatter surfaces cannot be matched."""
    prior_weight: float = 0.1
    """Pull towards the semi-global solution, in units of 1 - ZNCC: decides only where the photographs do not."""
    prior_reach: float = 4.0
    """Planes at which that pull stops growing."""
    max_image_size: int = 1600
    """Pixels: longer sides are reduced to this; detail beyond costs time and rarely adds shape."""
    geometry_weight: float = 0.2
    """Cost of missing the other views' surfaces by three pixels or more, in units of 1 - ZNCC."""
    geometry_rounds: int = 1
    """Rounds at half the size once the other views' depth is known."""
    surface_rounds: int = 1
    """Rounds at full size that start from the surface of all views; 0 leaves the third pass out."""
    surface_lead: float = 0.05
    """Cost by which a view's own depth must beat that surface to be kept, in units of 1 - ZNCC: many views speak for the surface."""
    min_views: int = 1
    """Fewest other views that must agree with a depth, at the tightest tolerance."""
    pixel_unit: float = 0.25
    """Pixels of reprojection error allowed per agreeing view."""
    depth_unit: float = 1.0 / 1200.0
    """Relative depth error allowed per agreeing view."""
    fusion_units: float = 2.15
    """Times these tolerances a depth may err and still be fused: many views average what one must not show alone."""

    def loosened(self) -> DepthConfig:
        """With the tolerances that fusion takes."""
        k = self.fusion_units
        return dataclasses.replace(self, pixel_unit=k * self.pixel_unit, depth_unit=k * self.depth_unit)


@dataclass(frozen=True)
class VolumeConfig:
    """Fusion of the depth maps into a block-sparse signed distance field."""

    voxel: float | None = None
    """World units; by default `footprints` pixel footprints of the target."""
    footprints: float = 1.35
    """Pixel footprints a voxel: below 1 there is nothing to resolve, above 1.5 detail is lost."""
    hull_footprints: float = 3.0
    """The same for a visual hull alone: silhouettes say little about detail."""
    truncation: float = 5.0
    """Voxels on either side of a surface that carry its distance."""
    free_weight: float = 0.3
    """Weight of seeing through a voxel against seeing a surface there."""
    min_weight: float = 0.05
    """Weight of surface observations below which nothing is solid; 1 is a confident depth at the target's distance."""
    solid_share: float = 0.3
    """With silhouettes: weight of observations, a view, that overrules the solid inside of the hull; times the share of the silhouettes'
    pixels that was not measured (where depth maps show little, what they show is doubtful), times the square of the share that was not
    measured off the hull (of a hollow thing the hull says little)."""
    smoothing: float = 0.7
    """Voxels: standard deviation of the field's smoothing without masks, and with them where depth maps measured it well."""
    solid_smoothing: float = 2.0
    """With masks, elsewhere: where depth is known here and not there, the solid inside of the hull would leave crumbs."""
    hull_tolerance: float = 0.04
    """Share of the silhouettes that may disagree: one wrong mask among 25 does no harm; with fewer views each is needed."""
    max_memory: int = 4 << 30
    """Bytes of the volume; the voxels grow until it fits, and the report says so."""


@dataclass(frozen=True)
class TargetConfig:
    """Foreground masks of a target in clips."""

    threshold: float = 12.0
    """Grey levels by which a pixel must differ from the background; three times the measured noise where that is more."""
    noise: float = 3.0
    """Grey levels of noise: a weaker pattern is none, and cannot tell a shadow from a thing."""
    window: int = 7
    """Pixels a side of the window over which patterns are compared."""
    correlation: float = 0.5
    """Correlation of a pattern with the background's above which it is the background in another light."""
    least_part: float = 0.02
    """Parts of a mask smaller than this share of the largest are dropped."""
    cut_rounds: int = 2
    """Rounds of GrabCut, which brings a mask's border onto the image's edges."""
    max_size: int = 960
    """Pixels of the longer side at which masks are found; larger frames are reduced for it."""
    samples: int = 25
    """Instants from which a background is learnt where there is no clean plate."""
    learn_size: int = 480
    """Pixels of the longer side at which the target's colours are learnt for it."""


@dataclass(frozen=True)
class CarveConfig:
    """Space carving."""

    resolution: int = 96
    """Voxels along the longest side where cameras agree on masks: a few pixels each."""
    tolerance: float = 0.2
    """Share of the cameras that may not support a voxel there: one of five, as things stand before others."""
    photo_consistency: bool = False
    """Whether a hull that no depth map bounds is carved on where its photographs disagree."""
    threshold: int = 18
    """Grey levels between two views' colours of a voxel beyond which they contradict each other."""
    least_views: int = 3
    """Views that must see a voxel before their colours may remove it."""
    rounds: int = 8
    """Most rounds of six sweeps; usually far fewer change anything."""


@dataclass(frozen=True)
class StandingConfig:
    """Silhouettes of what stands on the ground, found without masks where the depth maps show little of it."""

    enabled: bool = True
    """Whether such silhouettes complete the surface."""
    max_measured: float = 0.5
    """Share of the silhouettes' pixels with a filtered depth above which the depth maps do without: hulls fill hollows."""
    min_agreement: float = 0.88
    """Intersection over union of a silhouette and the common hull's, in the median view: less is no outline of one thing."""
    min_shown: float = 0.7
    """Share of the views that must show it; their hull tells the others where it is."""
    max_gap: float = 90.0
    """Degrees between neighbouring cameras around it: beyond, the hull is more corner than target."""
    ground_share: float = 0.3
    """Least share of the measured points that lie on the ground, less twice those under it."""
    ground_tolerance: float = 0.01
    """Share of the box's longest side within which a point counts as on the ground; targets begin at twice that."""
    step: int = 4
    """Pixels between the points that the ground is sought in."""
    look_size: int = 160
    """Pixels of the longer side for the quick look that tells how much was measured."""
    max_size: int = 480
    """Pixels of the longer side at which silhouettes are found."""


@dataclass(frozen=True)
class SurfaceConfig:
    """From the field to the mesh."""

    min_component: float = 0.005
    """Parts with a smaller share of the faces than this, relative to the largest, are dropped."""
    close_holes: int = 120
    """Holes of at most this many edges (of somewhat less than a voxel) are closed where they lie in the surface; 0 leaves them all."""
    unseen_reach: float | None = 1.0
    """With silhouettes: voxels from what a photograph shows beyond which the hull's other sides are left open: there it is a bound and no
    measurement. None keeps them, and with them a closed surface."""
    smooth: int = 0
    """Rounds of Taubin smoothing: rounds off noise without shrinking."""
    max_faces: int | None = None
    """Faces to decimate to by quadric errors; None keeps all."""


@dataclass(frozen=True)
class TextureConfig:
    """Images onto the mesh."""

    candidates: int = 8
    """Views that are kept for each face, the best by resolution and contrast: memory and cost do not grow with the views beyond."""
    seam: float = 0.5
    """Cost of a seam along one edge against the best and the worst view of a face (1)."""
    outlier: float = 60.0
    """Grey levels, after the colour gains, by which a view may differ from the median of a face's: beyond, it shows an occluder or a
    highlight."""
    loyalty: float = 0.5
    """Share by which the view that a face had in the frame before counts as better: it changes only where another is clearly better."""
    least_patch: int = 32
    """Faces below which a patch takes its neighbour's view."""
    mask_erosion: int = 3
    """Pixels taken off the masks: their borders mix in background."""
    max_size: int = 8192
    """Texels a side of the atlas; images are reduced until it fits."""
    padding_depth: float = 2.0
    """Voxels by which a vertex may lie behind the z-buffer and still count as seen."""


@dataclass(frozen=True)
class VideoConfig:
    """Clips: what instants share."""

    segment: int = 8
    """Instants of a chain: its first is searched in full, each later one starts from the surface before it."""
    chains: int = 2
    """Chains that are worked on at a time."""
    margin: float = 0.06
    """Share of a target's silhouette box added around it before the frames are cropped."""
    stereo_angle: float = 40.0
    """Degrees between a view and its nearest neighbour, in the median, beyond which stereo cannot work and the hull is the result."""
    least_target: float = 0.1
    """Parts of the hull with a smaller share of the largest part's volume are no targets, unless they are close to one."""
    model_instants: int = 16
    """Most instants, spread over the clip, whose views make a rigid target's model."""
    registration_points: int = 30_000
    """Points an instant for the poses of a rigid target."""
    registration_rounds: int = 40
    """Rounds of their joint refinement."""


@dataclass(frozen=True)
class Config:
    """Everything that can be set.

    Examples
    --------
    >>> Config.from_dict({"volume": {"footprints": 1.5}}).volume.footprints
    1.5
    """

    sparse: SparseConfig = field(default_factory=SparseConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    volume: VolumeConfig = field(default_factory=VolumeConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    carve: CarveConfig = field(default_factory=CarveConfig)
    standing: StandingConfig = field(default_factory=StandingConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    texture: TextureConfig = field(default_factory=TextureConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    matcher: str = "sgm"
    """The depth matcher: ``sgm`` is the classical one, ``dcnn`` asks the network as well: a little better, twice the time."""
    device: str = "cpu"
    """Where the network runs: ``cpu``, or ``cuda`` where torch finds such a device."""

    def __post_init__(self) -> None:
        require(self.device in DEVICES, "device", f"one of {', '.join(DEVICES)}", repr(self.device))
        require(self.matcher in MATCHERS, "matcher", f"one of {', '.join(MATCHERS)}", repr(self.matcher))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """From nested mappings; unknown keys are refused with the nearest known one."""
        return _build(cls, values, "config")


MATCHERS = ("sgm", "dcnn")
DEVICES = ("cpu", "cuda")


def _build(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    require(isinstance(values, Mapping), where, "a mapping", repr(values))
    known = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    arguments = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, 1)
            hint = f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"
            raise InvalidInputError(f"{where}: unknown key {key!r}{hint}")
        part = known[key].default_factory
        nested = part if dataclasses.is_dataclass(part) else None
        arguments[key] = _build(nested, value, f"{where}.{key}") if nested else value
    return cls(**arguments)
