"""NURBS curves and surfaces: evaluate, differentiate, change, fit, write (paper section 2.2, eqs 13-31).

``mvcore.nurbs.torch`` holds the differentiable forms; it alone imports torch.
"""

from .curve import Curve
from .export import tessellate, to_mesh
from .fit import (
    approximate_curve,
    approximate_surface,
    fit_scattered,
    interpolate_curve,
    interpolate_surface,
    spread_parameters,
)
from .fit_mesh import TargetFit, fit_target
from .obj import load_obj, save_obj
from .shapes import arc, circle, cylinder, ellipse, extrude, loft, revolve, ruled, sphere, torus
from .step import save_step
from .surface import Surface

__all__ = [
    "Curve",
    "Surface",
    "TargetFit",
    "approximate_curve",
    "approximate_surface",
    "arc",
    "circle",
    "cylinder",
    "ellipse",
    "extrude",
    "fit_scattered",
    "fit_target",
    "interpolate_curve",
    "interpolate_surface",
    "load_obj",
    "loft",
    "revolve",
    "ruled",
    "save_obj",
    "save_step",
    "sphere",
    "spread_parameters",
    "tessellate",
    "to_mesh",
    "torus",
]
