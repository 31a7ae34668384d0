"""Files of other tools, written here from their formats' equations: their own projection and that of the cameras read agree."""

import json
import random
import shutil

import cv2
import mvcore
import numpy as np
import pytest
from mvcore import FormatError, InvalidInputError, MvcoreError
from mvcore.io.formats import lens
from other_tools import (
    AHEAD,
    POINTS,
    ROS_LENSES,
    SIZE,
    WRITERS,
    F,
    brown,
    normal,
    pictures,
    storage,
    storage_pair,
    text_of,
    views,
    write_3dgs,
    write_kitti,
    write_meshroom,
    write_middlebury_stereo,
    write_polycam,
    write_ros,
)

EXACT = 1e-6  # pixels, the tolerance


@pytest.fixture
def rig():
    """Rotation world to camera and centre of four cameras."""
    return views()


def seen(camera, points):
    """Where a camera sees points, distortion included, by OpenCV."""
    points, r = points.reshape(-1, 1, 3), cv2.Rodrigues(camera.R)[0]
    k = np.array(camera.K)
    k[0, 1] = 0
    if camera.fisheye:
        x = cv2.fisheye.projectPoints(points, r, camera.t, k, camera.distortion)[0]
    else:
        x = cv2.projectPoints(points, r, camera.t, k, camera.distortion if camera.distortion.size else None)[0]
    x = x.reshape(-1, 2)
    return x + np.column_stack([camera.K[0, 1] * (x[:, 1] - k[1, 2]) / k[1, 1], np.zeros(len(x))])


def check(scene, expected, points=POINTS, tolerance=EXACT):
    assert len(scene) == len(expected)
    for camera, pixels in zip(scene.calib, expected):
        assert np.abs(seen(camera, points) - pixels).max() < tolerance


NAMED = ("Metashape", "RealityCapture", "Bundler", "VisualSFM", "Meshroom", "openMVG", "OpenSfM")
"""Formats that name their images."""
SIZED = ("aniposelib", "Metashape", "Meshroom", "openMVG", "Polycam", "Record3D", "OpenSfM", "3D Gaussian", "Panoptic", "MC-Calib")
"""Formats that say their images' sizes."""
TEXTS = (".toml", ".xml", ".csv", ".txt", ".out", ".nvm", ".sfm", ".json", ".yml", "")
"""Suffixes of the files that hold calibrations."""


def calibrations(folder):
    return sorted(f for f in folder.rglob("*") if f.is_file() and f.suffix in TEXTS)


@pytest.mark.parametrize("name", WRITERS)
def test_cameras_project_as_the_format_says(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    scene = mvcore.load(tmp_path / "office0" if name == "Replica" else tmp_path)
    assert scene.format.startswith(name)
    check(scene, expected)
    assert all(f.is_file() for f in scene.frames)


@pytest.mark.parametrize("name", [n for n in WRITERS if n != "LLFF"])
def test_byte_order_marks_and_windows_line_ends_change_nothing(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    for file in calibrations(tmp_path):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    check(mvcore.load(tmp_path / "office0" if name == "Replica" else tmp_path), expected)


@pytest.mark.parametrize("name", ["aniposelib", "LLFF", *NAMED])
def test_images_in_a_folder_of_the_callers(tmp_path, rig, name):
    (tmp_path / "set").mkdir()
    expected = WRITERS[name](tmp_path / "set", rig)
    photos = [f for f in sorted((tmp_path / "set").rglob("*")) if f.suffix.lower() in (".png", ".jpg") and f.parent.name != "images"]
    photos = photos or sorted((tmp_path / "set" / "images").iterdir())
    for photo in photos:
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        shutil.move(photo, tmp_path / "elsewhere" / photo.name)
    shutil.rmtree(tmp_path / "set" / "images", ignore_errors=True)
    with pytest.raises((FormatError, FileNotFoundError)):
        mvcore.load(tmp_path / "set")
    check(mvcore.load(tmp_path / "set", images=tmp_path / "elsewhere"), expected)


@pytest.mark.parametrize("name", SIZED)
def test_cameras_alone_need_no_images(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    for image in [f for f in tmp_path.rglob("*") if f.suffix in (".png", ".jpg")]:
        image.unlink()
    check(mvcore.load(tmp_path, images=False), expected)


@pytest.mark.parametrize("name", [n for n in WRITERS if n not in ("Replica", "ScanNet", "Record3D")])
def test_a_calibration_file_stands_for_its_folder(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    files = [f for f in [*calibrations(tmp_path), *tmp_path.glob("*.npy")] if f.name not in ("list.txt", "rgb.txt", "camera.txt")]
    check(mvcore.load(files[0]), expected)


def test_nvm_with_matrices_and_blanks_in_names(tmp_path, rig):
    expected = WRITERS["VisualSFM"](tmp_path, rig)
    lines = (tmp_path / "scene.nvm").read_text().splitlines()
    lines[0] = "NVM_V3_R9T"
    for n, (r, c) in enumerate(rig):
        _, f, *_, radial, zero = lines[3 + n].split()
        lines[3 + n] = f'my"photos\\a"{n}.png {f} {text_of([*r.ravel(), *(-r @ c)])} {radial} {zero}'
        (tmp_path / "photos" / f"a{n}.png").rename(tmp_path / "photos" / f"a {n}.png")
    (tmp_path / "scene.nvm").write_text("\n".join(lines))
    scene = mvcore.load(tmp_path)
    check(scene, expected)
    assert [f.name for f in scene.frames] == [f"a {n}.png" for n in range(len(rig))]


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 2, 5)])
def test_meshroom_versions(tmp_path, rig, version):
    expected = write_meshroom(tmp_path, rig, version)
    check(mvcore.load(tmp_path), expected)


@pytest.mark.parametrize(
    ("files", "names", "motion"),
    [
        (["intrinsics.yml", "extrinsics.yml"], ("M1", "D1", "M2", "D2"), lambda r, t: {"R": r, "T": t.reshape(3, 1)}),
        (["stereo.yml"], ("K1", "D1", "K2", "D2"), lambda r, t: {"R": r, "T": t.tolist()}),
        (["stereo.xml"], ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"), lambda r, t: {"R": cv2.Rodrigues(r)[0], "T": t}),
        (["stereo.yaml"], ("K_left", "D_left", "K_right", "D_right"), lambda r, t: {"rotation_matrix": r, "translation_vector": t}),
        (["stereo.yml"], ("mtxL", "distL", "mtxR", "distR"), lambda r, t: {"Rot": r, "Trans": t}),
        (["a.yml", "b.yml"], ("camera_matrix_0", "dist_coeffs_0", "camera_matrix_1", "dist_coeffs_1"), lambda r, t: {"R": r, "T": t}),
    ],
)
def test_opencv_stereo_in_one_or_two_files(tmp_path, rig, files, names, motion):
    expected, points = storage_pair(tmp_path, rig, files, names, motion)
    pictures(tmp_path, ["left.png", "right.png"])
    for path in (tmp_path, tmp_path / files[0], tmp_path / files[-1]):
        check(mvcore.load(path), expected, points)


def test_a_stereo_calibration_without_its_motion_says_so(tmp_path, rig):
    storage_pair(tmp_path, rig, ["a.yml", "b.yml"], ("M1", "D1", "M2", "D2"), lambda r, t: {"R": r, "T": t})
    (tmp_path / "b.yml").unlink()
    with pytest.raises(FormatError, match=r"a\.yml.*R and T of the second camera missing"):
        mvcore.load(tmp_path, images=False)


@pytest.mark.parametrize("model", ROS_LENSES)
def test_ros_camera_info(tmp_path, model):
    expected = write_ros(tmp_path, model)
    check(mvcore.load(tmp_path), expected, AHEAD)
    check(mvcore.load(tmp_path / "right.yaml"), expected, AHEAD)
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(FormatError, match="two or more cameras, got one"):
        mvcore.load(tmp_path)


def test_kitti(tmp_path):
    expected = write_kitti(tmp_path)
    check(mvcore.load(tmp_path), expected, AHEAD)
    (tmp_path / "poses.txt").unlink()
    alone = mvcore.load(tmp_path)
    check(alone, expected[:2], AHEAD)
    assert alone.frames[0].parent.name == "image_2"  # colour
    assert "only the first of 2 frames" in alone.warnings[0]


def test_middlebury_stereo(tmp_path):
    expected = write_middlebury_stereo(tmp_path)
    check(mvcore.load(tmp_path), expected, 1000 * AHEAD)


def test_a_pycolmap_reconstruction(tmp_path, rig):
    pycolmap = pytest.importorskip("pycolmap")
    k, d = [[F, 0, 31], [0, F + 1, 23], [0, 0, 1]], [-0.1, 0.03, 0.002, 0.001]
    scene = mvcore.Scene(
        [tmp_path / "photos" / f"{n}.png" for n in range(len(rig))],
        mvcore.Calibration(tuple(mvcore.Camera(k, r, -r @ c, *SIZE, d) for r, c in rig)),
    )
    mvcore.save_calibration(tmp_path / "model", scene, "colmap")
    pictures(tmp_path / "photos", [f"{n}.png" for n in range(len(rig))])
    reconstruction = pycolmap.Reconstruction(str(tmp_path / "model"))
    read = mvcore.load(reconstruction, images=tmp_path / "photos")
    check(read, [seen(c, POINTS) for c in scene.calib])
    assert [f.name for f in read.frames] == [f"{n}.png" for n in range(len(rig))]
    with pytest.raises(InvalidInputError, match="images"):
        mvcore.load(reconstruction)
    assert len(mvcore.load(reconstruction, images=False)) == len(rig)


ANIPOSELIB = """
[cam_0]
name = "A"
size = [ 640, 480,]
matrix = [ [ 610.5, 0.0, 321.25,], [ 0.0, 612.75, 239.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.21, 0.06, 0.001, -0.002, 0.013,]
rotation = [ 0.1, -0.2, 0.05,]
translation = [ 0.1, 0.2, 3.0,]

[cam_1]
name = "left cam"
size = [ 640, 480,]
matrix = [ [ 610.5, 0.0, 321.25,], [ 0.0, 612.75, 239.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.21, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.0, 1.2, -0.3,]
translation = [ -0.4, 0.1, 2.5,]

[cam_2]
name = "fish"
size = [ 640, 480,]
matrix = [ [ 300.0, 0.0, 318.0,], [ 0.0, 301.5, 241.25,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.05, -0.01, 0.002, 0.001,]
rotation = [ -0.4, -0.9, 0.2,]
translation = [ 0.3, -0.1, 2.0,]
fisheye = true

[metadata]
adjusted = false
error = 0.5
"""
ANIPOSE_POINTS = np.array([[0.25, -0.1, 0.4], [-0.5, 0.35, -0.2], [0.05, 0.45, 0.3]])
ANIPOSE_PIXELS = [
    [[369.62502727754656, 251.78584742562597], [239.3424118424291, 361.0135685582437], [332.7049049886745, 351.94295945027244]],
    [[327.6788129057599, 210.15439229918036], [180.3023772504181, 363.0239656093906], [319.90652100525307, 354.9411996532673]],
    [[334.63099943537173, 240.4913855110629], [351.03744443848166, 241.3617109173743], [331.4686613468376, 300.63491334527447]],
]
"""What CameraGroup.dump of aniposelib 0.8.0 wrote, and where CameraGroup.project saw the points."""


def test_aniposelibs_own_file_and_projections(tmp_path):
    (tmp_path / "calibration.toml").write_text(ANIPOSELIB)
    scene = mvcore.load(tmp_path, images=False)
    assert [c.name for c in scene.calib] == ["A", "left cam", "fish"]
    check(scene, ANIPOSE_PIXELS, ANIPOSE_POINTS)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_nerfstudios_rays(tmp_path, rig, model):
    """Its Cameras._generate_rays_from_coords, for pixel (row i, column j) at (i + 0.5, j + 0.5), with the lens of camera_utils."""
    fisheye, rng = model == "OPENCV_FISHEYE", np.random.default_rng(2)
    lens = {"k1": 0.05, "k2": -0.02, "k3": 0.004} | ({"k4": 0.001} if fisheye else {"p1": 0.002, "p2": -0.001})
    value = lambda key: lens.get(key, 0.0)  # noqa: E731
    frames, points, pixels = [], [], []
    for n, (r, c) in enumerate(rig):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = r.T @ np.diag([1.0, -1, -1]), c
        frames.append({"file_path": f"./images/{n}", "transform_matrix": pose.tolist()})
        x, y = rng.uniform([-0.5, -0.35], [0.5, 0.35], (30, 2)).T  # undistorted
        s = x * x + y * y
        d = 1 + s * (value("k1") + s * (value("k2") + s * (value("k3") + s * value("k4"))))
        u = d * x + 2 * value("p1") * x * y + value("p2") * (s + 2 * x * x)
        v = d * y + 2 * value("p2") * x * y + value("p1") * (s + 2 * y * y)
        angle = np.sqrt(s)
        turn = np.sin(angle) / angle if fisheye else np.ones_like(s)
        rays = np.column_stack([x * turn, -y * turn, -np.cos(angle) if fisheye else -np.ones_like(s)])
        points.append(c + 1.7 * rays @ pose[:3, :3].T)
        pixels.append(np.column_stack([u * F + 32.25, v * (F + 1) + 23]) - 0.5)
    pictures(tmp_path / "images", [f"{n}.png" for n in range(len(rig))])
    data = {"camera_model": model, "fl_x": F, "fl_y": F + 1, "cx": 32.25, "cy": 23, "w": SIZE[0], "h": SIZE[1], **lens, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    for camera, seen_at, there in zip(mvcore.load(tmp_path).calib, pixels, points):
        assert np.abs(seen(camera, there) - seen_at).max() < EXACT


def test_kalibrs_equations(tmp_path):
    """aslam_cv: RadialTangentialDistortion.hpp and EquidistantDistortion.hpp, distort(y), and the wiki's T_cn_cnm1."""
    chain, out, pose = {}, [], np.eye(4)
    for n, kind in enumerate(("radtan", "equidistant", "none")):
        step = np.vstack([np.column_stack([cv2.Rodrigues(np.array([0.02, -0.1, 0.03]) * n)[0], [-0.3 * n, 0.02, 0.01]]), [0, 0, 0, 1]])
        pose = step @ pose if n else pose
        q = AHEAD @ pose[:3, :3].T + pose[:3, 3]
        y = q[:, :2] / q[:, 2:]
        if kind == "radtan":
            k1, k2, p1, p2 = d = [-0.1, 0.03, 0.002, -0.001]
            mx2, my2, mxy = y[:, 0] ** 2, y[:, 1] ** 2, y[:, 0] * y[:, 1]
            rho2 = mx2 + my2
            radial = k1 * rho2 + k2 * rho2**2
            shift = [y[:, 0] * radial + 2 * p1 * mxy + p2 * (rho2 + 2 * mx2), y[:, 1] * radial + 2 * p2 * mxy + p1 * (rho2 + 2 * my2)]
            y = y + np.column_stack(shift)
        elif kind == "equidistant":
            k1, k2, k3, k4 = d = [0.05, 0.01, 0.002, 0.001]
            r = np.sqrt((y**2).sum(1))
            theta = np.arctan(r)
            y = y * (theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / r)[:, None]
        else:
            d = []
        chain[f"cam{n}"] = {"camera_model": "pinhole", "distortion_model": kind, "distortion_coeffs": d, "resolution": list(SIZE)}
        chain[f"cam{n}"] |= {"intrinsics": [F, F + 1, 31.0, 23.0], "rostopic": f"/cam{n}"} | ({"T_cn_cnm1": step.tolist()} if n else {})
        out.append(y * [F, F + 1] + [31, 23])
    pictures(tmp_path, [f"cam{n}.png" for n in range(3)])
    (tmp_path / "log-camchain.yaml").write_text(json.dumps(chain))
    check(mvcore.load(tmp_path), out, AHEAD)


def test_colmap_comes_before_the_cameras_of_a_splatting_run(tmp_path, rig):
    expected = write_3dgs(tmp_path, rig)
    cameras = tuple(mvcore.Camera([[F, 0, 30], [0, F + 1, 22], [0, 0, 1]], r, -r @ c, *SIZE) for r, c in rig)
    scene = mvcore.Scene([tmp_path / "images" / f"v{n}.jpg" for n in range(len(rig))], mvcore.Calibration(cameras))
    mvcore.save_calibration(tmp_path / "sparse" / "0", scene, "colmap")
    read = mvcore.load(tmp_path)
    assert read.format == "COLMAP"
    assert read.calib[0].K[0, 2] == pytest.approx(30)
    check(mvcore.load(tmp_path / "cameras.json"), expected)


def test_what_each_reader_said(tmp_path, rig):
    write_3dgs(tmp_path, rig)
    (tmp_path / "cameras.json").write_text('[{"img_name": "a", "rotation": 1}]')
    (tmp_path / "scene.nvm").write_text("NVM_V3\n\nmany\n")
    with pytest.raises(FormatError, match=r"as VisualSFM .nvm: .*scene.nvm:3: .*; as 3D Gaussian .*\[0\].rotation: expected 3 x 3"):
        mvcore.load(tmp_path)
    expected = write_polycam(tmp_path, rig)
    scene = mvcore.load(tmp_path)
    check(scene, expected)
    assert "scene.nvm:3" in scene.warnings[0]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "Metashape",
            'type="frame" class="adjusted"',
            'type="spherical" class="adjusted"',
            r"sensor 's': the camera type 'spherical' cannot be read",
        ),
        ("Metashape", "<p1>0.002", "<p3>0.002</p3><p1>0.002", "p3 and p4"),
        ("Metashape", "<f>60.0</f>", "<f>60.0x</f>", r"<f>: expected a finite number, got '60.0x'"),
        ("Metashape", "<resolution ", '<resolution width="0" ', r"cameras.xml:\d+: "),
        ("Meshroom", '"brown"', '"3deanamorphic4"', "the camera model '3deanamorphic4' cannot be read"),
        ("Meshroom", '"poses"', '"positions"', "no poses"),
        ("Meshroom", '"36"', '"0"', "sensorWidth: expected a positive width"),
        ("openMVG", '"fisheye"}', '"spherical"}', "'spherical' cannot be read"),
        ("openMVG", '"extrinsics"', '"extras"', "no extrinsics"),
        ("OpenSfM", '"projection_type": "brown"', '"projection_type": "spherical"', "'spherical' cannot be read"),
        ("aniposelib", "fisheye = true", 'fisheye = "perhaps"\nx = [', "Calib.toml:"),
        ("aniposelib", "size = [64", "size = [1e400", "cam_0.size"),
        ("aniposelib", "matrix = [[60.0", "matrix = [[nan", "cam_0.matrix: NaN"),
        ("aniposelib", "rotation = [", "rotation = [1.0, ", "rotation of 3 or 9 numbers, got 4"),
        ("VisualSFM", "0.080000000000000002 0", "-3 0", "scene.nvm:6: the radial distortion -3 turns back"),
        ("VisualSFM", "60.0", "-60", r"scene.nvm:4: expected a positive focal length, got -60"),
        ("VisualSFM", "\n4\n", "\n5000000\n", "scene.nvm:3: expected a number of cameras"),
        ("Bundler", "\n5 0\n", "\n999999999 0\n", "bundle.out:2: expected a number of cameras"),
        ("Bundler", "-0.1 0.02", "-0.1 inf", "bundle.out:3: NaN or infinity"),
        ("RealityCapture", ",30,", ",30 mm,", "cameras.csv:3: f: expected a finite number, got '30 mm'"),
        ("Polycam", '"fx": 60.0', '"fx": null', "8.json: fx missing"),
        ("Polycam", '"width": 64', '"width": 99999999', "width: expected a size of 1"),
        ("Record3D", '"poses": [[', '"poses": [[5, ', r"metadata: poses\[0\]: expected 7 numbers, got 8"),
        ("Panoptic", '"resolution": [64', '"resolution": [-64', r"cameras\[0\].resolution: expected a size"),
        ("MC-Calib", "distortion_type: 0", "distortion_type: 7", "camera_0: the camera model '7' cannot be read"),
        ("TUM", "1000.0000 ", "1000.0000 x ", "groundtruth.txt:3: expected numbers, got 'x'"),
        ("Replica", " 1\n", " 1 2\n", "traj.txt:1: expected 16 numbers, got 17"),
        ("3D Gaussian", '"fx": 60.0', '"fx": "wide"', r"cameras.json: \[0\].fx: expected a finite number, got 'wide'"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, rig, name, old, new, message):
    WRITERS[name](tmp_path, rig)
    changed = False
    for file in calibrations(tmp_path):
        text = file.read_text()
        changed |= old in text
        file.write_text(text.replace(old, new))
    assert changed
    with pytest.raises(FormatError, match=message):
        mvcore.load(tmp_path / "office0" if name == "Replica" else tmp_path)


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_read_or_refused(tmp_path, rig, name):
    WRITERS[name](tmp_path, rig)
    root = tmp_path / "office0" if name == "Replica" else tmp_path
    rng = random.Random(name)
    files = [*calibrations(tmp_path), *tmp_path.glob("*.npy")]
    for _ in range(40):
        file = rng.choice(files)
        good = file.read_bytes()
        file.write_bytes(damaged(good, rng))
        said = str(tmp_path)
        try:
            mvcore.load(root)
        except (MvcoreError, OSError) as error:  # and nothing else is raised
            said = str(error)
        file.write_bytes(good)
        assert str(tmp_path) in said


def damaged(data, rng):
    """A file cut short, with bytes or numbers changed, or a piece repeated."""
    at, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    kind = rng.randrange(5)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + bytes(rng.randrange(256) for _ in range(4)) + data[at + 4 :]
    if kind == 2:
        return data[:end] + data[at:end][:500] + data[end:]
    if kind == 3:
        return data[:at] + rng.choice([b"[" * 3000, b"{", b"nan", b"-1e999", b"9" * 5000, b'"', b"<a>", b"\x00", b"null"]) + data[at:]
    numbers = [n for n in range(len(data)) if data[n : n + 1].isdigit()]
    at = rng.choice(numbers) if numbers else at
    return data[:at] + rng.choice([b"1e308", b"-", b"e", b"NaN", b"0x", b"99999999999999999999"]) + data[at + 1 :]


def test_lens_models_are_fitted_or_refused():
    k = np.array([[F, 0, 31.5], [0, F, 23.5], [0, 0, 1]])
    corner = lens.corner_radius(k, *SIZE)
    values = lens.polynomial([-0.2, 0.05, -0.01, 0.004], 0.001, -0.002, F, corner)
    p = np.column_stack([np.linspace(0, 0.55, 50), np.linspace(0, 0.4, 50)])
    theirs = cv2.projectPoints(np.column_stack([p, np.ones(50)]), np.zeros(3), np.zeros(3), np.eye(3), np.array(values))[0].reshape(-1, 2)
    assert np.abs(theirs - brown(p, -0.2, 0.05, -0.01, 0.001, -0.002, k4=0.004)).max() * F < EXACT
    assert lens.polynomial([-2.0, 0, 0, 0.1], 0, 0, F, corner) is None  # turns back within the image
    assert lens.measured(-2.0, F, corner) is None
    assert lens.measured(0.0, F, corner) == []


def test_coefficients_named_k1_and_k2_make_no_stereo_pair(tmp_path, rig):
    for n, (r, c) in enumerate(rig):
        k = np.array([[F, 0, 31], [0, F + 1, 23], [0, 0, 1]])
        storage(
            tmp_path / f"{n}.yml", camera_matrix=k, rvec=cv2.Rodrigues(r)[0], tvec=-r @ c, image_width=64, image_height=48, k1=-0.1, k2=0.02
        )
    pictures(tmp_path, [f"{n}.png" for n in range(len(rig))])
    scene = mvcore.load(tmp_path)
    assert scene.format == "OpenCV FileStorage"
    assert not scene.warnings
    check(scene, [normal(r, c) * [F, F + 1] + [31, 23] for r, c in rig])


def test_a_file_of_one_format_is_not_said_to_be_another(tmp_path, rig):
    write_polycam(tmp_path, rig)
    assert not mvcore.load(tmp_path / "keyframes" / "corrected_cameras" / "8.json").warnings
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(FormatError, match=r"notes\.json: expected an object with a list 'views'"):
        mvcore.load(tmp_path / "notes.json")
