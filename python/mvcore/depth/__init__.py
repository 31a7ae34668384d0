"""Depth maps: plane sweep, semi-global aggregation, slanted refinement, and consistency across views.

Two matchers find a view's rough depth: ``sgm`` is the classical one; in ``dcnn`` what the network finds is one more term of
its costs. Either goes coarse to fine: the sweep and the aggregation run on a small image, where they see the most context;
planes are then refined on it and on each finer scale up to the full size. A rectified pair is the same code with horizontal
homographies.
"""

from .geometric_filter import filter_depth
from .passes import (
    RoughDepth,
    estimate_depth,
    guided_depth,
    network_depth,
    refine_depth,
    seeded_depth,
    sweep_depth,
)
from .stereo import disparity
from .views import View

__all__ = [
    "RoughDepth",
    "View",
    "disparity",
    "estimate_depth",
    "filter_depth",
    "guided_depth",
    "network_depth",
    "refine_depth",
    "seeded_depth",
    "sweep_depth",
]
