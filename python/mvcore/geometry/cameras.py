"""Pinhole cameras: eqs 1-12 of the paper.

Axes x right, y down, z forward; ``X_camera = R X_world + t``; pixel centres at integers, (0, 0) is the centre of the top-left
pixel; depth is z along the optical axis. All matrices float64.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InvalidInputError, require

Float = NDArray[np.float64]

ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R Rᵀ from the identity: calibration files are often rounded to four digits."""
EXACT = 1e-14
"""The same deviation of a rotation that only float64 rounded."""


def euler_to_rotation(x: float, y: float, z: float) -> Float:
    """R = Rx · Ry · Rz from angles in radians, shape (3, 3), with the matrices as the paper prints them.

    Eqs 2-5: world axes turn by the angles, so coordinates turn against them (``Rx`` has +sin above the diagonal).

    Examples
    --------
    >>> euler_to_rotation(np.pi / 2, 0, 0).round(12) + 0.0
    array([[ 1.,  0.,  0.],
           [ 0.,  0.,  1.],
           [ 0., -1.,  0.]])
    """
    cx, cy, cz = np.cos([x, y, z])
    sx, sy, sz = np.sin([x, y, z])
    rx = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    ry = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    rz = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
    return rx @ ry @ rz


def rotation_to_euler(rotation: ArrayLike) -> tuple[float, float, float]:
    """Angles (x, y, z) in radians with ``euler_to_rotation(x, y, z) == rotation``; z = 0 at gimbal lock (y = ±90°)."""
    r = np.asarray(rotation, np.float64)
    y = float(np.arctan2(-r[0, 2], np.hypot(r[0, 0], r[0, 1])))
    if np.hypot(r[0, 0], r[0, 1]) < 1e-9:
        return float(np.arctan2(-r[2, 1], r[1, 1])), y, 0.0
    return float(np.arctan2(r[1, 2], r[2, 2])), y, float(np.arctan2(r[0, 1], r[0, 0]))


def rotation_from(matrix: ArrayLike, name: str = "R") -> Float:
    """The rotation nearest to a matrix that is one but for rounding, (3, 3) float64.

    Calibration files are often rounded to four digits. Far from the origin (UTM, ECEF) the error of such an R times the
    centre is metres: readers of formats that store the centre C need the rotation itself before t = -R C.

    Raises
    ------
    InvalidInputError
        A matrix that is off by more than `ROTATION_TOLERANCE`, or a reflection.
    """
    r = _matrix(name, matrix, (3, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(r @ r.T - np.eye(3)).max()
    require(off < ROTATION_TOLERANCE, name, "a rotation (R Rᵀ = 1)", f"a deviation of {off:.3g}")
    det = np.linalg.det(r)
    require(det > 0, name, "a rotation", f"a reflection (det {det:.3g})")
    if off <= EXACT:
        return r
    u, _, v = np.linalg.svd(r)
    return u @ v


def _matrix(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Float:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        raise InvalidInputError(f"{name}: expected {shape} numbers, got {value!r:.80}") from None
    if shape == (3,) and array.size == 3:
        array = array.reshape(3)
    require(array.shape == shape, name, f"shape {shape}", f"shape {array.shape}")
    require(np.isfinite(array).all(), name, "finite numbers", "NaN or infinity")
    array.setflags(write=False)
    return array


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) can be the same picture at two scales, each side rounded to a whole pixel."""
    (w, h), (a, b) = sorted((size, other))
    return abs(w * b / a - h) <= 1 or abs(h * a / b - w) <= 1


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated view.

    Parameters
    ----------
    K : (3, 3) float64, pixels. Upper triangular, K[2, 2] = 1.
    R : (3, 3) float64. World to camera. A matrix rounded to a few digits is replaced by the nearest rotation.
    t : (3,) float64, world units. World to camera. Where R is replaced, t follows, so that the centre -R⁻¹ t stays.
    width, height : image size in pixels.
    distortion : OpenCV coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6]]), or four fisheye ones; empty for a pinhole.
    fisheye : the projection is OpenCV's fisheye (equidistant) model, also where all four coefficients are zero.
    name : what the files call the view.

    Raises
    ------
    InvalidInputError
        R is no rotation, K no camera matrix, or a value is NaN.

    Examples
    --------
    >>> camera = Camera(K=[[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], R=np.eye(3), t=[0, 0, 2], width=640, height=480)
    >>> camera.project([[0.0, 0.0, 0.0]])
    array([[319.5, 239.5]])
    """

    K: Float
    R: Float
    t: Float
    width: int
    height: int
    distortion: Float = field(default_factory=lambda: np.zeros(0))
    fisheye: bool = False
    name: str = ""

    def __post_init__(self) -> None:
        who = f"camera {self.name!r} " if self.name else ""
        k, r, t = _matrix(who + "K", self.K, (3, 3)), _matrix(who + "R", self.R, (3, 3)), _matrix(who + "t", self.t, (3,))
        require(k[0, 0] > 0 and k[1, 1] > 0, who + "K", "positive focal lengths", f"{k[0, 0]:g}, {k[1, 1]:g}")
        lower = np.abs([k[1, 0], k[2, 0], k[2, 1]]).max()
        require(lower < 1e-6 and abs(k[2, 2] - 1) < 1e-6, who + "K", "an upper triangular matrix with K[2, 2] = 1", k.tolist())
        rotation = rotation_from(r, who + "R")
        if not np.array_equal(rotation, r):
            t = rotation @ np.linalg.solve(r, t)
        require(self.width > 0 and self.height > 0, who + "size", "positive width and height", f"{self.width} x {self.height}")
        d = np.array(self.distortion, np.float64).reshape(-1)
        sizes = (0, 4) if self.fisheye else (0, 4, 5, 8, 12, 14)
        require(d.size in sizes, who + "distortion", f"{' or '.join(map(str, sizes))} coefficients", d.size)
        require(np.isfinite(d).all(), who + "distortion", "finite numbers", "NaN or infinity")
        if self.fisheye and not d.size:
            d = np.zeros(4)
        values = {"K": k, "R": rotation, "t": t, "distortion": d, "width": int(self.width), "height": int(self.height)}
        for key, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)

    @classmethod
    def from_projection(cls, projection: ArrayLike, width: int, height: int, **more: Any) -> Camera:
        """From a bare 3x4 matrix P ~ K [R | t] (any scale and sign), decomposed by RQ."""
        p = _matrix("projection", projection, (3, 4))
        m = p[:, :3]
        require(
            abs(np.linalg.det(m)) > 1e-12 * np.linalg.norm(m) ** 3,
            "projection",
            "an invertible left 3x3 block",
            "a singular one",
        )
        if np.linalg.det(m) < 0:
            p, m = -p, -m
        q, r = np.linalg.qr(np.linalg.inv(m))  # inv(K R) = Rᵀ K⁻¹
        sign = np.diag(np.sign(np.diag(r)))
        k, rotation = np.linalg.inv(sign @ r), (q @ sign).T
        k = np.triu(k)
        t = np.linalg.solve(k, p[:, 3])
        return cls(K=k / k[2, 2], R=rotation, t=t, width=width, height=height, **more)

    @classmethod
    def from_center(cls, K: ArrayLike, R: ArrayLike, center: ArrayLike, width: int, height: int, **more: Any) -> Camera:
        """From the camera's centre in the world, (3,), in place of t: t = -R C with R's nearest rotation."""
        rotation = rotation_from(R)
        t = -rotation @ _matrix("center", center, (3,))
        return cls(K=np.asarray(K), R=rotation, t=t, width=width, height=height, **more)

    @classmethod
    def from_euler(cls, K: ArrayLike, angles: ArrayLike, t: ArrayLike, width: int, height: int, **more: Any) -> Camera:
        """From Euler angles (x, y, z) in radians, R = Rx · Ry · Rz (paper eqs 2-5), and t (eq 6)."""
        x, y, z = _matrix("angles", angles, (3,))
        return cls(K=np.asarray(K), R=euler_to_rotation(x, y, z), t=np.asarray(t), width=width, height=height, **more)

    @property
    def center(self) -> Float:
        """Camera centre in the world, shape (3,)."""
        return -self.R.T @ self.t

    @property
    def distorted(self) -> bool:
        """Whether its images must be undistorted: a fisheye, or any coefficient that is not zero."""
        return self.fisheye or bool(self.distortion.any())

    @property
    def axis(self) -> Float:
        """Viewing direction in the world, unit length, shape (3,)."""
        return self.R[2]

    @property
    def projection(self) -> Float:
        """P = K [R | t], shape (3, 4)."""
        return self.K @ np.column_stack([self.R, self.t])

    @property
    def euler(self) -> tuple[float, float, float]:
        """Euler angles (x, y, z) in radians."""
        return rotation_to_euler(self.R)

    def to_camera(self, points: ArrayLike) -> Float:
        """World points (N, 3) in camera axes, (N, 3) (paper eq 7)."""
        return np.asarray(points, np.float64) @ self.R.T + self.t

    def project(self, points: ArrayLike) -> Float:
        """Undistorted pixel positions (N, 2) of world points (N, 3) (paper eqs 8-12); NaN behind the camera."""
        q = self.to_camera(points) @ self.K.T
        z = np.where(q[:, 2:] > 0, q[:, 2:], np.nan)
        return q[:, :2] / z

    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> Float:
        """World points (N, 3) of pixels (N, 2) at z-depths (N,)."""
        p = np.asarray(pixels, np.float64)
        rays = np.column_stack([p, np.ones(len(p))]) @ np.linalg.inv(self.K).T
        return (rays * np.asarray(depth, np.float64)[:, None] - self.t) @ self.R

    def pixel_grid(self) -> Float:
        """Pixel centres (height, width, 2) as (x, y)."""
        return np.stack(np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float)), -1)

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another image size; pixel centres stay at integers."""
        sx, sy = width / self.width, height / self.height
        scale = np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]])
        return replace(self, K=scale @ self.K, width=width, height=height)

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """The view of a window of the image whose top-left pixel is (x, y)."""
        shift = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
        return replace(self, K=shift @ self.K, width=width, height=height)

    def moved(self, pose: ArrayLike) -> Camera:
        """The view as seen from a frame that ``pose`` (4, 4) brings into the world: X_world = pose X."""
        m = _matrix("pose", pose, (4, 4))
        return replace(self, R=self.R @ m[:3, :3], t=self.R @ m[:3, 3] + self.t)

    def pinhole(self) -> Camera:
        """The same view without distortion, as its undistorted image shows it."""
        return replace(self, distortion=np.zeros(0), fisheye=False)

    def __repr__(self) -> str:
        c = np.round(self.center, 4).tolist()
        return f"Camera({self.name!r}, {self.width}x{self.height}, f={self.K[0, 0]:.1f}, center={c})"


@dataclass(frozen=True)
class Calibration(Sequence[Camera]):
    """The cameras of a rig or of a set of photographs, in the order of the frames.

    ``mirrored``: the caller's world is left-handed; the cameras are those of its reflection in z (`Scene.mirror`).

    Raises
    ------
    InvalidInputError
        A single camera, or all of them at one place: nothing can be triangulated.
    """

    cameras: tuple[Camera, ...]
    source: str = ""
    mirrored: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        require(all(isinstance(c, Camera) for c in self.cameras), "calib", "a sequence of Camera", "something else")

    def check_baselines(self) -> None:
        """Raise unless at least two cameras stand at different places."""
        require(len(self) >= 2, "calib", "at least 2 cameras", f"{len(self)}: depth needs parallax")
        centers = np.array([c.center for c in self])
        spread = np.linalg.norm(centers - centers.mean(0), axis=1).max()
        size = max(np.abs(centers).max(), 1e-300)
        require(spread > 1e-9 * size, "calib", "cameras at different places", "coincident camera centres")

    def __getitem__(self, index: Any) -> Any:
        return self.cameras[index]

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)


def relative_map(reference: Camera, source: Camera) -> NDArray[np.float32]:
    """Where a reference pixel of inverse depth w lands in a source view: q = A (x, y, 1) + w b.

    A = K_s R_sr K_r⁻¹ and b = K_s t_sr (paper eqs 9-12 for two views), as the 12 float32 values that the kernels take.
    """
    rotation = source.R @ reference.R.T
    a = source.K @ rotation @ np.linalg.inv(reference.K)
    b = source.K @ (source.t - rotation @ reference.t)
    return np.concatenate([a.reshape(-1), b]).astype(np.float32)
