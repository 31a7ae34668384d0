"""Lens models: the projection is what the file says, also with zero coefficients."""

import json

import cv2
import mvcore
import numpy as np
import pytest
from mvcore import Camera, FormatError
from mvcore.io.formats.colmap import COUNTS, MODELS, SUPPORTED
from mvcore.io.formats.lens import TOLERANCE
from mvcore.io.images import distorted_pixels, undistort

COEFFICIENTS = {
    "SIMPLE_PINHOLE": [],
    "PINHOLE": [],
    "SIMPLE_RADIAL": [-0.08],
    "RADIAL": [-0.08, 0.02],
    "OPENCV": [-0.08, 0.02, 0.003, -0.002],
    "FULL_OPENCV": [-0.08, 0.02, 0.003, -0.002, 0.01, 0.02, -0.01, 0.004],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "SIMPLE_RADIAL_FISHEYE": [0.03],
    "RADIAL_FISHEYE": [0.03, -0.01],
    "OPENCV_FISHEYE": [0.03, -0.01, 0.004, -0.002],
}
POINTS = np.random.default_rng(1).uniform([-1.2, -0.9, 2], [1.2, 0.9, 4], (200, 3))


def colmap_model(folder, model, parameters, count=2):
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for n in range(count):
        cv2.imwrite(str(folder / "images" / f"{n}.png"), np.zeros((480, 640, 3), np.uint8))
    words = " ".join(repr(float(p)) for p in parameters)
    (folder / "cameras.txt").write_text(f"1 {model} 640 480 {words}\n")
    (folder / "images.txt").write_text("".join(f"{n + 1} 1 0 0 0 {n} 0 0 1 {n}.png\n\n" for n in range(count)))
    return folder


def parameters_of(model):
    focals = [500.0] if SUPPORTED[model][0] == 1 else [500.0, 510.0]
    return [*focals, 322.0, 238.0, *COEFFICIENTS[model]]


@pytest.mark.parametrize("model", sorted(SUPPORTED))
@pytest.mark.parametrize("zero", [False, True])
def test_supported_models_project_as_pycolmap_does(tmp_path, model, zero):
    pycolmap = pytest.importorskip("pycolmap")
    parameters = parameters_of(model)
    if zero:
        parameters[-len(COEFFICIENTS[model]) or len(parameters) :] = [0.0] * len(COEFFICIENTS[model])
    try:
        theirs = pycolmap.Camera(model=model, width=640, height=480, params=parameters)
    except Exception:
        pytest.skip(f"this pycolmap has no {model}")
    camera = mvcore.load(colmap_model(tmp_path, model, parameters)).calib[0]
    expected = np.asarray(theirs.img_from_cam(POINTS)).reshape(-1, 2) - 0.5
    assert np.abs(distorted_pixels(camera, camera.project(POINTS)) - expected).max() < 1e-6
    assert camera.fisheye == SUPPORTED[model][1]


def test_the_table_of_models_is_pycolmaps():
    pycolmap = pytest.importorskip("pycolmap")
    for name, number in pycolmap.CameraModelId.__members__.items():
        value = int(getattr(number, "value", number))
        if value >= 0:
            assert MODELS[value][0] == name
            assert MODELS[value][1] == len(pycolmap.Camera.create_from_model_id(1, number, 100.0, 64, 48).params)


@pytest.mark.parametrize("model", sorted(set(COUNTS) - set(SUPPORTED)))
def test_other_models_are_refused_by_name(tmp_path, model):
    with pytest.raises(FormatError, match=rf"camera 1 has the model {model}"):
        mvcore.load(colmap_model(tmp_path, model, [1.0] * COUNTS[model]))
    with pytest.raises(FormatError, match="unknown model 'NEW_MODEL'"):
        mvcore.load(colmap_model(tmp_path, "NEW_MODEL", [1.0]))


@pytest.mark.parametrize(
    ("fisheye", "distortion", "skew"),
    [
        (True, [], 0.0),
        (True, [0.03, -0.01, 0, 0], 0.0),
        (False, [-0.1, 0.02, 0.001, -0.002], 0.0),
        (False, [-0.1, 0.02, 0.001, 0], 20.0),
        (True, [0.03, 0, 0, 0], 20.0),
    ],
)
def test_undistorted_images_are_what_a_pinhole_sees(fisheye, distortion, skew):
    k = [[300, skew, 160], [0, 310, 120], [0, 0, 1]]
    camera = Camera(k, np.eye(3), np.zeros(3), 320, 240, distortion=distortion, fisheye=fisheye)
    assert camera.distorted
    grid = camera.pixel_grid().reshape(-1, 2)
    seen = distorted_pixels(camera, grid)
    # An image that shows at each distorted pixel a smooth function of that pixel.
    image = np.rint(127 + 60 * np.sin(grid / 25)).astype(np.uint8).reshape(240, 320, 2)
    flat = undistort(np.dstack([image, image[..., 0]]), camera)[..., :2].reshape(-1, 2)
    inside = ((seen > 2) & (seen < [317, 237])).all(1)
    assert inside.mean() > 0.5
    assert np.abs(flat[inside] - (127 + 60 * np.sin(seen[inside] / 25))).max() < 2  # grey levels: rounding and interpolation


@pytest.mark.parametrize("fisheye", [False, True])
def test_images_larger_than_opencv_remaps_are_undistorted_in_parts(monkeypatch, fisheye):
    camera = Camera([[300, 0, 160], [0, 310, 120], [0, 0, 1]], np.eye(3), np.zeros(3), 320, 240, [0.03, -0.01, 0, 0], fisheye)
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    whole = undistort(image, camera)
    monkeypatch.setattr("mvcore.io.images.PART", 50)
    monkeypatch.setattr("mvcore.io.images.MOST_SIDE", 230)
    np.testing.assert_array_equal(undistort(image, camera), whole)
    monkeypatch.undo()
    wide = Camera([[3e4, 0, 16500], [0, 3e4, 20], [0, 0, 1]], np.eye(3), np.zeros(3), 33000, 40, [-0.1, 0, 0, 0])
    steps = np.repeat(np.arange(33000)[None] // 200, 40, 0).astype(np.uint8)
    seen = distorted_pixels(wide, [[32000, 20]])[0, 0]
    assert undistort(steps, wide)[20, 32000] == pytest.approx(seen // 200, abs=1)


def nerf(folder, common, **frame):
    (folder / "images").mkdir(exist_ok=True)
    frames = []
    for n in range(2):
        cv2.imwrite(str(folder / "images" / f"{n}.png"), np.zeros((48, 64, 3), np.uint8))
        pose = np.eye(4)
        pose[0, 3] = n
        frames.append({"file_path": f"images/{n}.png", "transform_matrix": pose.tolist()} | frame)
    data = {"fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "frames": frames} | common
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def test_the_only_transforms_file_is_read_under_any_name(tmp_path):
    (nerf(tmp_path, {}) / "transforms.json").rename(tmp_path / "transforms_test.json")
    assert len(mvcore.load(tmp_path)) == 2
    (tmp_path / "transforms_val.json").write_text("{}")
    with pytest.raises(FormatError, match="no calibration found"):
        mvcore.load(tmp_path)


def test_nerf_lenses(tmp_path):
    zero = mvcore.load(nerf(tmp_path, {"camera_model": "OPENCV_FISHEYE"})).calib[0]
    assert zero.fisheye
    assert zero.distortion.tolist() == [0, 0, 0, 0]
    flagged = mvcore.load(nerf(tmp_path, {"is_fisheye": True, "k1": 0.1, "k4": 0.2})).calib[0]
    assert flagged.fisheye
    assert flagged.distortion.tolist() == [0.1, 0, 0, 0.2]
    assert not mvcore.load(nerf(tmp_path, {"is_fisheye": False})).calib[0].distorted
    plain = mvcore.load(nerf(tmp_path, {"camera_model": "OPENCV", "k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.5})).calib[0]
    assert plain.distortion.tolist() == [0.1, 0.2, 0.3, 0.4, 0.5]
    with pytest.raises(
        FormatError, match=r"frames\[0\]: k1 .. k4: expected a distortion that does not turn back in the image, got -2, 0, 0, 0.2"
    ):
        mvcore.load(nerf(tmp_path, {"camera_model": "OPENCV", "k1": -2.0, "k4": 0.2}))
    for model in ("EQUIRECTANGULAR", "FISHEYE624"):
        with pytest.raises(FormatError, match=f"camera_model '{model}' is not supported"):
            mvcore.load(nerf(tmp_path, {}, camera_model=model))


@pytest.mark.parametrize(("k", "sized", "tolerance"), [((-0.1, 0.02, 0.001, 0.2), True, TOLERANCE), ((0.05, 0.0, 0.0, -0.02), False, 1e-6)])
def test_nerfstudios_fourth_radial_term(tmp_path, k, sized, tolerance):
    """Its radial_and_tangential_undistort: d = 1 + r (k1 + r (k2 + r (k3 + r k4))) with r = x² + y²; p1 and p2 as OpenCV's."""
    lens = dict(zip(("k1", "k2", "k3", "k4"), k)) | {"p1": 0.002, "p2": -0.001}
    camera = mvcore.load(nerf(tmp_path, lens | ({} if sized else {"w": None, "h": None}))).calib[0]
    x, y = np.random.default_rng(0).uniform([-0.5, -0.35], [0.5, 0.35], (200, 2)).T
    r = x * x + y * y
    d = 1 + r * (k[0] + r * (k[1] + r * (k[2] + r * k[3])))
    u = d * x + 2 * 0.002 * x * y - 0.001 * (r + 2 * x * x)
    v = d * y - 2 * 0.001 * x * y + 0.002 * (r + 2 * y * y)
    pixels = distorted_pixels(camera, np.column_stack([60 * x + 31.5, 61 * y + 23.5]))
    assert np.abs(pixels - np.column_stack([60 * u + 31.5, 61 * v + 23.5])).max() < tolerance


def test_a_lens_that_is_hard_to_fit(tmp_path):
    """Four terms of one sign and size at a long focal length: within the fit's tolerance, not refused."""
    folder = nerf(
        tmp_path,
        {"k1": -0.1, "k2": 0.02, "k3": 0.001, "k4": 0.2, "fl_x": 287.0, "fl_y": 288.0, "cx": 158.5, "cy": 104.9, "w": 320, "h": 213},
    )
    for n in range(2):
        cv2.imwrite(str(folder / "images" / f"{n}.png"), np.zeros((213, 320, 3), np.uint8))
    camera = mvcore.load(folder).calib[0]
    x = np.linspace(0, 0.5, 100)
    expected = 287 * x * (1 - 0.1 * x**2 + 0.02 * x**4 + 0.001 * x**6 + 0.2 * x**8) + 158
    pixels = distorted_pixels(camera, np.column_stack([287 * x + 158, np.full(100, 104.4)]))
    assert np.abs(pixels[:, 0] - expected).max() < TOLERANCE


def test_a_field_of_view_needs_the_images_size(tmp_path):
    angle = 2 * np.arctan(0.5)
    camera = mvcore.load(
        nerf(tmp_path, {"fl_x": None, "fl_y": None, "w": None, "h": None, "cx": None, "cy": None, "camera_angle_x": angle})
    )
    assert np.allclose(camera.calib[0].K, [[64, 0, 31.5], [0, 64, 23.5], [0, 0, 1]])
    plain = {"fl_x": None, "fl_y": None, "cx": None, "cy": None}
    degrees = mvcore.load(nerf(tmp_path, plain | {"x_fov": float(np.degrees(angle))}))  # instant-ngp's
    assert np.allclose(degrees.calib[0].K, [[64, 0, 31.5], [0, 64, 23.5], [0, 0, 1]])
    with pytest.raises(FormatError, match="neither fl_x nor camera_angle_x"):
        mvcore.load(nerf(tmp_path, {"fl_x": None, "fl_y": None}))
