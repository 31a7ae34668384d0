import numpy as np
import pytest
from conftest import look_at
from hypothesis import given
from hypothesis import strategies as st
from mvcore import Calibration, Camera, InvalidInputError
from mvcore.geometry.cameras import euler_to_rotation, relative_map, rotation_to_euler

K = [[500.0, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]
angle = st.floats(-3.1, 3.1)


def rotation(axis, a):
    c, s = np.cos(a), np.sin(a)
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


@given(angle, st.floats(-1.5, 1.5), angle)
def test_euler_angles_are_rx_ry_rz_and_come_back(x, y, z):
    r = euler_to_rotation(x, y, z)
    assert np.allclose(r, rotation("x", x) @ rotation("y", y) @ rotation("z", z), atol=1e-14)
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
