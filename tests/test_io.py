"""One known point through every reader and back through every writer lands on the same pixel."""

import json
import struct

import cv2
import mvcore
import numpy as np
import pytest
from conftest import look_at
from mvcore import FormatError, InvalidInputError, Scene
from mvcore.io import maps
from mvcore.io.formats import mvsnet
from mvcore.io.formats.colmap import quaternion_to_rotation, rotation_to_quaternion
from mvcore.io.images import load_frame, undistort

POINT = np.array([[0.12, -0.2, 0.17]])


@pytest.fixture
def cameras():
    return [look_at((2 * np.cos(a), 2 * np.sin(a), 0.4), (0, 0, 0), (64, 48), 60.0) for a in (0.0, 0.5, 1.1)]


def pictures(folder, names, size=(64, 48)):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((size[1], size[0], 3), np.uint8))


def check(scene, cameras, tolerance=1e-9):
    assert len(scene) == len(cameras)
    for read, true in zip(scene.calib, cameras):
        assert np.abs(read.project(POINT) - true.project(POINT)).max() < tolerance


def scene_of(cameras, folder):
    names = [f"{n:08d}.png" for n in range(len(cameras))]
    pictures(folder / "images", names)
    return Scene([folder / "images" / n for n in names], mvcore.Calibration(tuple(cameras)))


@pytest.mark.parametrize("format", ["mvcore", "colmap", "mvsnet"])
def test_writers_and_readers_agree(tmp_path, cameras, format):
    scene = scene_of(cameras, tmp_path)
    path = tmp_path / "cameras.json" if format == "mvcore" else tmp_path
    mvcore.save_calibration(path, scene, format)
    check(mvcore.load(tmp_path), cameras)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_cameras_json_round_trips_exactly(tmp_path, cameras):
    scene = scene_of(cameras, tmp_path)
    box = np.array([[-1.0, -2, -3], [1, 2, 3]])
    mvcore.save_calibration(tmp_path / "cameras.json", Scene(scene.frames, scene.calib, bounds=box))
    again = mvcore.load(tmp_path)
    for a, b in zip(again.calib, cameras):
        assert (a.K == b.K).all()
        assert (a.R == b.R).all()
        assert (a.t == b.t).all()
    assert (again.bounds == box).all()


def test_colmap_text_differs_by_half_a_pixel_and_agrees_with_pycolmap(tmp_path, cameras):
    pycolmap = pytest.importorskip("pycolmap")
    mvcore.save_calibration(tmp_path, scene_of(cameras, tmp_path), "colmap")
    theirs = pycolmap.Reconstruction(str(tmp_path))
    for number, camera in enumerate(cameras, 1):
        image = theirs.images[number]
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        in_camera = pose * POINT[0]
        x = theirs.cameras[image.camera_id].img_from_cam(in_camera)
        assert np.abs(np.asarray(x).reshape(2) - 0.5 - camera.project(POINT)[0]).max() < 1e-9
    theirs.write_binary(str(tmp_path))
    (tmp_path / "cameras.txt").unlink()
    (tmp_path / "images.txt").unlink()
    check(mvcore.load(tmp_path), cameras)


def test_colmap_distortion_models(tmp_path):
    pictures(tmp_path / "images", [f"{n}.png" for n in range(4)])
    (tmp_path / "cameras.txt").write_text(
        "1 SIMPLE_RADIAL 64 48 60 32 24 0.1\n2 RADIAL 64 48 60 32 24 0.1 0.01\n"
        "3 OPENCV 64 48 60 61 32 24 0.1 0.01 0.001 0.002\n4 OPENCV_FISHEYE 64 48 60 61 32 24 0.1 0.01 0 0\n"
    )
    (tmp_path / "images.txt").write_text("".join(f"{n + 1} 1 0 0 0 {n} 0 0 {n + 1} {n}.png\n\n" for n in range(4)))
    a, b, c, d = mvcore.load(tmp_path).calib
    assert a.distortion.tolist() == [0.1, 0, 0, 0]
    assert b.distortion.tolist() == [0.1, 0.01, 0, 0]
    assert c.distortion.tolist() == [0.1, 0.01, 0.001, 0.002]
    assert d.fisheye
    assert c.K[0, 2] == 31.5


def test_quaternions_of_every_rotation():
    for axis in np.vstack([np.eye(3), np.random.default_rng(0).normal(size=(20, 3))]):
        for angle in (0.0, 1e-9, 1.0, 3.0, np.pi):
            r, _ = cv2.Rodrigues(axis / np.linalg.norm(axis) * angle)
            assert np.allclose(quaternion_to_rotation(rotation_to_quaternion(r)), r, atol=1e-12)


def test_nerf(tmp_path, cameras):
    pictures(tmp_path / "images", [f"{n}.png" for n in range(3)])
    frames = []
    for n, c in enumerate(cameras):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = c.R.T @ np.diag([1, -1, -1]), c.center
        frames.append({"file_path": f"images/{n}", "transform_matrix": pose.tolist()})
    k = cameras[0].K
    data = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2] + 0.5, "cy": k[1, 2] + 0.5, "w": 64, "h": 48, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    check(mvcore.load(tmp_path), cameras)
    data["frames"][1]["file_path"] = "../../etc/passwd"
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(FormatError, match="outside"):
        mvcore.load(tmp_path)


def test_idr(tmp_path, cameras):
    pictures(tmp_path / "image", [f"{n:06d}.png" for n in range(3)])
    mats = {f"world_mat_{n}": np.vstack([c.projection * 2.5, [0, 0, 0, 1]]) for n, c in enumerate(cameras)}
    np.savez(tmp_path / "cameras_sphere.npz", **mats, scale_mat_0=np.diag([2.0, 2, 2, 1]))
    scene = mvcore.load(tmp_path)
    check(scene, cameras)
    assert scene.bounds.tolist() == [[-2, -2, -2], [2, 2, 2]]


def test_a_pickled_npz_is_refused(tmp_path):
    np.savez(tmp_path / "cameras_sphere.npz", world_mat_0=np.array([{"a": 1}], dtype=object))
    with pytest.raises(FormatError, match="cameras_sphere"):
        mvcore.load(tmp_path)


def test_strecha_and_middlebury(tmp_path, cameras):
    pictures(tmp_path / "s", [f"{n}.png" for n in range(3)])
    pictures(tmp_path / "m", [f"{n}.png" for n in range(3)])
    rows = []
    for n, c in enumerate(cameras):
        text = lambda m: "\n".join(" ".join(f"{v:.17g}" for v in row) for row in np.atleast_2d(m))  # noqa: E731
        (tmp_path / "s" / f"{n}.png.camera").write_text(f"{text(c.K)}\n0 0 0\n{text(c.R.T)}\n{text(c.center)}\n{c.width} {c.height}\n")
        rows.append(f"{n}.png " + " ".join(f"{v:.17g}" for v in [*c.K.ravel(), *c.R.ravel(), *c.t]))
    (tmp_path / "m" / "x_par.txt").write_text("3\n" + "\n".join(rows) + "\n")
    (tmp_path / "m" / "README.txt").write_text("box\n(-1 -2 -3)\n(1.5 2 3e-1)\n")
    check(mvcore.load(tmp_path / "s"), cameras)
    check(mvcore.load(tmp_path / "m"), cameras)
    assert mvcore.load(tmp_path / "m").bounds.tolist() == [[-1, -2, -3], [1.5, 2, 0.3]]


def test_opencv(tmp_path, cameras):
    for n, c in enumerate(cameras):
        pictures(tmp_path, [f"{n}.png"])
        storage = cv2.FileStorage(str(tmp_path / f"{n}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", c.K)
        storage.write("rvec", cv2.Rodrigues(c.R)[0])
        storage.write("tvec", c.t.reshape(3, 1))
        storage.write("image_width", c.width)
        storage.write("image_height", c.height)
        storage.release()
    check(mvcore.load(tmp_path), cameras)


def test_pairs(tmp_path, cameras):
    mvcore.save_calibration(tmp_path, scene_of(cameras, tmp_path), "mvsnet")
    pairs = mvsnet.read_pairs(tmp_path / "pair.txt")
    assert [len(p) for p in pairs] == [2, 2, 2]
    (tmp_path / "pair.txt").write_text("1\n0\n2 1 0.5\n")
    with pytest.raises(FormatError, match=r"pair\.txt:3"):
        mvsnet.read_pairs(tmp_path / "pair.txt")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras.json", "{", r"cameras.json:1:"),
        ("cameras.json", "[]", "views"),
        ("cameras.json", '{"views": [{"K": 1}]}', "R, t missing"),
        ("transforms.json", "{}", "frames"),
        ("a_par.txt", "1\na.png 1 2\n", r"a_par.txt:2: expected 21 numbers"),
        ("a_par.txt", "1\na.png " + "nan " * 21, r"a_par.txt:2: NaN"),
        ("a.png.camera", "1 2 x\n", r"camera:1: expected numbers"),
        ("00000000_cam.txt", "extrinsic\n1 0 0 0\n", r"_cam.txt:1"),
        ("cam.yml", "%YAML:1.0\n---\nfoo: 1\n", "camera_matrix"),
    ],
)
def test_malformed_files_name_path_and_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=message):
        mvcore.load(tmp_path)


def test_truncated_binary_colmap(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, 1, 64, 48))
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(FormatError, match="ends early"):
        mvcore.load(tmp_path)


def test_missing_and_wrong_images(tmp_path, cameras):
    mvcore.save_calibration(tmp_path / "cameras.json", scene_of(cameras, tmp_path))
    cv2.imwrite(str(tmp_path / "images" / "00000001.png"), np.zeros((10, 20, 3), np.uint8))
    with pytest.raises(FormatError, match=r"20 x 10 pixels, its camera 64 x 48"):
        mvcore.load(tmp_path)
    (tmp_path / "images" / "00000001.png").unlink()
    scene = mvcore.load(tmp_path)
    assert [f.name for f in scene.frames] == ["00000000.png", "00000002.png"]
    assert "1 of 3 views left out, as their images do not exist: images/00000001.png" in scene.warnings[0]
    assert len(mvcore.load(tmp_path, images=False)) == 3
    with pytest.raises(FormatError, match="known formats"):
        mvcore.load(tmp_path / "images")
    with pytest.raises(FileNotFoundError):
        mvcore.load(tmp_path / "nowhere")


def test_a_non_rotation_in_a_file_is_named(tmp_path, cameras):
    mvcore.save_calibration(tmp_path / "cameras.json", scene_of(cameras, tmp_path))
    data = json.loads((tmp_path / "cameras.json").read_text())
    data["views"][2]["R"][0][0] = 5
    (tmp_path / "cameras.json").write_text(json.dumps(data))
    with pytest.raises(FormatError, match=r"cameras.json.*R: expected a rotation"):
        mvcore.load(tmp_path)


def test_undistortion_straightens(cameras):
    c = mvcore.Camera(cameras[0].K, cameras[0].R, cameras[0].t, 64, 48, distortion=[-0.3, 0.05, 0, 0])
    grid = c.pixel_grid()
    image = np.repeat(grid[..., :1] * 3, 3, 2).astype(np.uint8)
    flat = undistort(image, c)
    x = np.array([[[40.0, 10.0]]])
    there = cv2.undistortPoints(x, c.K, c.distortion, P=c.K)[0, 0]
    assert abs(float(flat[round(there[1]), round(there[0]), 0]) - 3 * 40) < 6


def test_frames_of_another_kind_are_refused(cameras):
    with pytest.raises(InvalidInputError, match=r"frames\[3\].*uint8"):
        load_frame(np.zeros((48, 64, 3)), cameras[0], 3)
    with pytest.raises(InvalidInputError, match=r"64 x 48 pixels as its camera, got 48 x 64"):
        load_frame(np.zeros((64, 48, 3), np.uint8), cameras[0], 0)


def test_maps_come_back(tmp_path):
    depth = np.random.default_rng(0).uniform(1, 5, (7, 9)).astype(np.float32)
    depth[0, 0] = 0
    maps.write_pfm(tmp_path / "d.pfm", depth)
    assert (maps.read_pfm(tmp_path / "d.pfm") == depth).all()
    scale = maps.write_depth_png(tmp_path / "d.png", depth)
    read = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED) * scale
    assert np.abs(read - depth).max() <= scale
    (tmp_path / "x.pfm").write_bytes(b"Pf\n3 3\n-1\nabc")
    with pytest.raises(FormatError, match=r"x.pfm"):
        maps.read_pfm(tmp_path / "x.pfm")


def test_the_shared_sets_are_found(shared):
    kinds = {
        "fountain-P11": ("mvcore", 11),
        "templeRing": ("mvcore", 47),
        "templeRing/templeR_par.txt": ("Middlebury", 47),
        "dtu-scan24": ("mvcore", 49),
        "desk-board": ("mvcore", 7),
        "synthetic/helmet-ring": ("mvcore", 20),
    }
    for name, (format, count) in kinds.items():
        scene = mvcore.load(shared / name)
        assert scene.format.startswith(format)
        assert len(scene) == count
    strecha = mvcore.load(shared / "formats" / "strecha", images=False)
    ours = mvcore.load(shared / "fountain-P11")
    for a, b in zip(strecha.calib, ours.calib):
        assert np.allclose(a.center, b.center, atol=1e-5)
        assert np.allclose(a.R, b.R, atol=1e-5)
    par = mvcore.load(shared / "templeRing" / "templeR_par.txt")
    assert np.allclose(par.bounds, mvcore.load(shared / "templeRing").bounds)
