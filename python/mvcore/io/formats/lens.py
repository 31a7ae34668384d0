"""Lens models of other tools as OpenCV's.

Polynomials up to r⁶ and two tangential terms are OpenCV's own. Any other radial function is fitted by OpenCV's rational model
(1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³), s = r²: for the smooth functions of lenses it agrees to a
thousandth of a pixel or much better, and where it does not the model is refused by name.
"""

from __future__ import annotations

import numpy as np

from .values import Float

NODES = 200
"""Radii at which a function is fitted."""
TOLERANCE = 1e-3
"""Largest deviation of the fit in pixels; features are located to about 0.1."""


def brown(k1: float = 0, k2: float = 0, p1: float = 0, p2: float = 0, k3: float = 0) -> list[float]:
    """OpenCV's coefficients of x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²); empty where all are zero."""
    values = [float(k1), float(k2), float(p1), float(p2), float(k3)]
    if not any(values):
        return []
    return values if k3 else values[:4]


def rational(radii: Float, factors: Float, focal: float, p1: float = 0.0, p2: float = 0.0) -> list[float] | None:
    """OpenCV's eight coefficients of a radial function that is known at some radii.

    Parameters
    ----------
    radii : (n,) undistorted distances from the axis at depth 1, from 0 on beyond the image's corners, increasing.
    factors : (n,) distorted over undistorted distance.
    focal : pixels; weighs the deviation.
    p1, p2 : OpenCV's tangential coefficients.

    Returns
    -------
    k1, k2, p1, p2, k3, k4, k5, k6, or None where no such function comes within `TOLERANCE` pixels.
    """
    scale = max(float(radii[-1]) ** 2, 1e-12)
    s = radii**2 / scale
    powers = np.stack([s, s**2, s**3], 1)
    columns = np.hstack([powers, -factors[:, None] * powers])
    weight = (radii + 1e-3 * radii[-1])[:, None]
    solution = np.linalg.lstsq(columns * weight, (factors - 1) * weight[:, 0], rcond=1e-14)[0]
    a, b = solution[:3], solution[3:]
    below = 1 + powers @ b
    if not (below > 1e-3).all():
        return None
    off = np.abs((1 + powers @ a) / below - factors) * radii * focal
    if not off.max() <= TOLERANCE:
        return None
    (k1, k2, k3), (k4, k5, k6) = a / scale ** np.arange(1, 4), b / scale ** np.arange(1, 4)
    return [float(v) for v in (k1, k2, p1, p2, k3, k4, k5, k6)]


def corner_radius(k: Float, width: int, height: int) -> float:
    """Distance of the farthest corner from the axis at depth 1, in the distorted image."""
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    offset = (corners - k[:2, 2]) / [k[0, 0], k[1, 1]]
    return float(np.linalg.norm(offset, axis=1).max())


def polynomial(coefficients: list[float], p1: float, p2: float, focal: float, corner: float) -> list[float] | None:
    """Coefficients of x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸ ..) with tangential terms; None where OpenCV has none like it.

    ``corner`` is the distance of the image's corner from the axis at depth 1, in the distorted image.
    """
    if not any(coefficients[3:]):
        k1, k2, k3 = (list(coefficients) + [0.0] * 3)[:3]
        return brown(k1, k2, p1, p2, k3)

    def factor(r: Float) -> Float:
        return np.asarray(np.polyval([*coefficients[::-1], 1.0], r**2), np.float64)

    radii = np.linspace(0, 4 * corner, 20 * NODES)
    beyond = np.flatnonzero(radii * factor(radii) >= 1.05 * corner)
    if not beyond.size:  # the function turns back before it reaches the corner
        return None
    radii = np.linspace(0, radii[beyond[0]], NODES)
    return rational(radii, factor(radii), focal, p1, p2)


def measured(coefficient: float, focal: float, corner: float) -> list[float] | None:
    """Coefficients of the inverse model x_undistorted = x (1 + k |x|²) of the measured x; None where it turns back in the image."""
    if not coefficient:
        return []
    distorted = np.linspace(0, 1.05 * corner, NODES)
    if (1 + 3 * coefficient * distorted**2 <= 1e-3).any():
        return None
    undistorted = distorted * (1 + coefficient * distorted**2)
    return rational(undistorted, 1 / (1 + coefficient * distorted**2), focal)
