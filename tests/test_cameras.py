import numpy as np
import pytest
from conftest import look_at
from hypothesis import given
from hypothesis import strategies as st
from mvcore import Calibration, Camera, InvalidInputError
from mvcore.geometry.cameras import euler_to_rotation, relative_map, rotation_from, rotation_to_euler, same_shape
from mvcore.geometry.projections import MIRROR, cameras_from_projections

K = [[500.0, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]
angle = st.floats(-3.1, 3.1)


def test_euler_matrices_are_the_papers():
    # Worked out by hand from eqs 2-5 as printed: quarter turns, then 30, 60 and 45 degrees.
    assert np.allclose(euler_to_rotation(np.pi / 2, 0, 0), [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert np.allclose(euler_to_rotation(0, np.pi / 2, 0), [[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    assert np.allclose(euler_to_rotation(0, 0, np.pi / 2), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    two, three, six = np.sqrt([2, 3, 6])
    expected = [[two / 4, two / 4, -three / 2], [-six / 8, 3 * six / 8, 1 / 4], [5 * two / 8, two / 8, three / 4]]
    assert np.allclose(euler_to_rotation(np.pi / 6, np.pi / 3, np.pi / 4), expected)
    camera = Camera.from_euler(K, (np.pi / 2, 0, 0), (0, 0, 5), 640, 480)
    # The world's y axis points along the camera's -z: a point 1 up it is nearer by 1.
    assert np.allclose(camera.to_camera([[0, 1, 0]]), [[0, 0, 4]])


@given(angle, st.floats(-1.5, 1.5), angle)
def test_euler_angles_come_back(x, y, z):
    r = euler_to_rotation(x, y, z)
    assert np.allclose(r @ r.T, np.eye(3), atol=1e-14)
    assert np.allclose(euler_to_rotation(*rotation_to_euler(r)), r, atol=1e-12)


def test_gimbal_lock_still_gives_the_rotation():
    r = euler_to_rotation(0.3, np.pi / 2, -0.8)
    assert np.allclose(euler_to_rotation(*rotation_to_euler(r)), r, atol=1e-9)


@given(angle, st.floats(-1.5, 1.5), angle, st.floats(0.01, 100), st.booleans())
def test_a_projection_matrix_decomposes_at_any_scale_and_sign(x, y, z, scale, negative):
    camera = Camera.from_euler(K, (x, y, z), (0.1, -2, 5), 640, 480)
    again = Camera.from_projection(camera.projection * (-scale if negative else scale), 640, 480)
    assert np.allclose(again.K, camera.K, atol=1e-8)
    assert np.allclose(again.R, camera.R, atol=1e-10)
    assert np.allclose(again.t, camera.t, atol=1e-9)


OFFSETS = [np.zeros(3), np.array([500_123.25, 5_600_456.5, 210.0]), np.array([3_900_000.0, 700_000.0, 4_970_000.0])]


@pytest.mark.parametrize("offset", OFFSETS, ids=["local", "UTM", "ECEF"])
def test_a_rounded_rotation_moves_no_centre(offset):
    true = look_at((1, 2, 0.5), (0, 0, 0))
    rounded = np.round(true.R, 5)  # times 5e6 m, its error of 1e-5 would be tens of metres
    center = true.center + offset
    for camera in (
        Camera.from_center(true.K, rounded, center, 240, 180),
        Camera(true.K, rounded, -rounded @ center, 240, 180),  # as a reader of a file with centres has it
    ):
        assert np.abs(camera.center - center).max() < 1e-8
        assert np.abs(camera.R @ camera.R.T - np.eye(3)).max() < 1e-14
        assert np.abs(camera.project([offset + np.array([0.1, 0.1, 0])]) - true.project([[0.1, 0.1, 0]])).max() < 0.01  # the rounding of R


def test_rotations_within_float64_stay_as_they_are():
    camera = look_at((1, 2, 0.5), (0, 0, 0))
    assert (rotation_from(camera.R) == camera.R).all()
    again = Camera(camera.K, camera.R, camera.t, 240, 180)
    assert (again.R == camera.R).all()
    assert (again.t == camera.t).all()
    with pytest.raises(InvalidInputError, match="R: expected a rotation, got a reflection"):
        rotation_from(np.diag([1.0, 1, -1]))


def test_a_fisheye_without_coefficients_is_one():
    camera = Camera(K, np.eye(3), np.zeros(3), 640, 480, fisheye=True)
    assert camera.distorted
    assert camera.distortion.tolist() == [0, 0, 0, 0]
    assert not camera.pinhole().distorted
    assert not Camera(K, np.eye(3), np.zeros(3), 640, 480, distortion=[0.0] * 5).distorted


def turntable(count=6):
    return [look_at((2 * np.cos(a), 2 * np.sin(a), 0.5), (0, 0, 0)) for a in np.linspace(0, 5, count)]


@pytest.mark.parametrize("scale", [1.0, -3.0])
def test_projection_matrices_of_a_proper_world(scale):
    cameras = turntable()
    again, mirrored = cameras_from_projections([scale * c.projection for c in cameras], [(240, 180)] * 6)
    assert not mirrored
    assert all(np.allclose(a.R, c.R) and np.allclose(a.t, c.t) for a, c in zip(again, cameras))


def test_projection_matrices_of_a_mirrored_world():
    # A left-handed world: the caller's coordinates are those of the real scene with one axis turned round.
    flip = np.diag([1.0, -1, 1, 1])
    matrices = [c.projection @ flip for c in turntable()]
    cameras, mirrored = cameras_from_projections(matrices, [(240, 180)] * 6)
    assert mirrored
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.2
    for camera, p in zip(cameras, matrices):
        homogeneous = np.column_stack([points, np.ones(20)]) @ p.T
        caller = homogeneous[:, :2] / homogeneous[:, 2:]
        assert np.allclose(camera.project(points @ MIRROR[:3, :3]), caller)  # NaN behind the camera


def test_outward_cameras_are_no_mirror():
    cameras = [look_at((np.cos(a), np.sin(a), 0), (5 * np.cos(a), 5 * np.sin(a), 0)) for a in np.linspace(0, 5, 6)]
    assert not cameras_from_projections([c.projection for c in cameras], [(240, 180)] * 6)[1]


@pytest.mark.parametrize(
    ("size", "other", "same"),
    [((640, 480), (1280, 960), True), ((333, 250), (1000, 750), True), ((640, 480), (1920, 1080), False), ((20, 10), (64, 48), False)],
)
def test_sizes_of_one_picture(size, other, same):
    assert same_shape(size, other) == same_shape(other, size) == same


def test_projection_and_unprojection_are_inverse():
    camera = look_at((1, 2, 0.5), (0, 0, 0))
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.3
    x, z = camera.project(points), camera.to_camera(points)[:, 2]
    assert np.allclose(camera.unproject(x, z), points, atol=1e-12)
    assert np.isnan(camera.project([camera.center - camera.axis])).all()


def test_resizing_keeps_pixel_centres():
    camera = look_at((1, 2, 0.5), (0, 0, 0))
    half = camera.resized(120, 90)
    x = camera.project([[0.1, 0.05, -0.1]])
    assert np.allclose(half.project([[0.1, 0.05, -0.1]]), (x + 0.5) / 2 - 0.5)


def test_relative_map_is_the_two_view_geometry():
    a, b = look_at((2, 0, 0.3), (0, 0, 0)), look_at((1.7, 1, 0.2), (0, 0, 0))
    point = np.array([[0.1, 0.2, -0.1]])
    m = relative_map(a, b).astype(float)
    x, z = a.project(point)[0], a.to_camera(point)[0, 2]
    q = m[:9].reshape(3, 3) @ [*x, 1] + m[9:] / z
    assert np.allclose(q[:2] / q[2], b.project(point)[0], atol=1e-3)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"R": np.diag([1.0, 1, -1])}, "R"),
        ({"R": np.eye(3) * 1.1}, "R"),
        ({"t": [0, np.nan, 0]}, "t"),
        ({"K": np.eye(2)}, "K"),
        ({"K": np.diag([-500.0, 500, 1])}, "K"),
        ({"width": 0}, "size"),
        ({"distortion": [0.1, 0.2]}, "distortion"),
        ({"K": "abc"}, "K"),
    ],
)
def test_bad_values_are_named(change, named):
    good = {"K": K, "R": np.eye(3), "t": [0, 0, 1], "width": 640, "height": 480}
    with pytest.raises(InvalidInputError, match=named):
        Camera(**(good | change))


def test_one_camera_and_coincident_cameras_are_refused():
    camera = look_at((1, 2, 0.5), (0, 0, 0))
    with pytest.raises(InvalidInputError, match="at least 2"):
        Calibration((camera,)).check_baselines()
    with pytest.raises(InvalidInputError, match="coincident"):
        Calibration((camera, look_at((1, 2, 0.5), (0, 0, 1)))).check_baselines()
