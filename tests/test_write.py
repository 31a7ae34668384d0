"""Calibrations written for other tools, with sparse points: what those tools read is what was written."""

import json
from dataclasses import replace

import cv2
import mvcore
import numpy as np
import pytest
import trimesh
from conftest import look_at, render_sphere, write_scene
from mvcore import InvalidInputError, SparsePoints
from mvcore.io.formats import mvsnet
from mvcore.pipeline.convert import sparse_points
from typer.testing import CliRunner

SIZE = (64, 48)
LENS = [-0.1, 0.03, 0.002, -0.001, 0.01]


def cameras_around(distortion=(), fisheye=False):
    centers = [(2 * np.cos(a), 2 * np.sin(a), 0.4) for a in (0.0, 0.1, 0.25, 1.9)]
    plain = [look_at(c, (0, 0, 0), SIZE, 60.0) for c in centers]
    return [mvcore.Camera(c.K, c.R, c.t, c.width, c.height, list(distortion), fisheye) for c in plain]


@pytest.fixture
def points():
    """Forty points; the first three views show most, the last a few."""
    rng = np.random.default_rng(1)
    visible = np.array([rng.random(40) < share for share in (0.9, 0.9, 0.9, 0.2)])
    visible[:2] |= visible.sum(0) < 2
    return SparsePoints(rng.uniform(-0.3, 0.3, (40, 3)), visible, rng.uniform(0, 1, 40).astype(np.float32))


def scene_of(folder, cameras, colour=(10, 200, 30)):
    (folder / "images").mkdir(parents=True)
    frames = [folder / "images" / f"{n}.png" for n in range(len(cameras))]
    for frame in frames:
        cv2.imwrite(str(frame), np.full((SIZE[1], SIZE[0], 3), colour[::-1], np.uint8))
    return mvcore.Scene(frames, mvcore.Calibration(tuple(cameras)))


@pytest.mark.parametrize(("distortion", "fisheye"), [((), False), (LENS[:4], False), (LENS, False), ([0.05, 0.01, 0.0, 0.001], True)])
def test_pycolmap_reads_our_points_and_tracks(tmp_path, points, distortion, fisheye):
    pycolmap = pytest.importorskip("pycolmap")
    scene = scene_of(tmp_path, cameras_around(distortion, fisheye))
    mvcore.save_calibration(tmp_path / "sparse" / "0", scene, "colmap", points=points)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert len(model.cameras) == 1  # all share one lens
    assert len(model.points3D) == len(points)
    for number, point in model.points3D.items():
        assert (point.xyz == points.positions[number - 1]).all()
        assert point.color.tolist() == [10, 200, 30]
        assert sorted(e.image_id - 1 for e in point.track.elements) == np.flatnonzero(points.visible[:, number - 1]).tolist()
        for element in point.track.elements:
            image = model.images[element.image_id]
            pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
            x = np.asarray(model.cameras[image.camera_id].img_from_cam(pose * point.xyz)).reshape(2)
            measured = image.points2D[element.point2D_idx]
            assert measured.point3D_id == number
            assert np.abs(measured.xy - x).max() < 2e-6  # written to six digits
    again = mvcore.load(tmp_path)
    for a, b in zip(again.calib, scene.calib):
        assert np.allclose(a.R, b.R, atol=1e-15)
        assert np.abs(a.K - b.K).max() < 1e-12
        assert np.abs(a.distortion[: b.distortion.size] - b.distortion).max(initial=0) == 0


@pytest.mark.parametrize(("distortion", "fisheye"), [((), False), (LENS, False), ([0.0] * 4, True)])
def test_nerfstudio_with_points(tmp_path, points, distortion, fisheye):
    scene = scene_of(tmp_path, cameras_around(distortion, fisheye))
    shift = np.array([4.5e5, 5.4e6, 0])
    far = SparsePoints(points.positions + shift, points.visible, points.errors)
    cameras = [mvcore.Camera(c.K, c.R, -c.R @ (c.center + shift), *SIZE, c.distortion, fisheye) for c in scene.calib]
    moved = mvcore.Calibration(tuple(cameras))
    mvcore.save_calibration(tmp_path, mvcore.Scene(scene.frames, moved), "nerfstudio", points=far)
    data = json.loads((tmp_path / "transforms.json").read_text())
    cloud = trimesh.load(tmp_path / data["ply_file_path"], process=False)
    assert np.abs(cloud.vertices - far.positions).max() == 0
    assert cloud.colors[0, :3].tolist() == [10, 200, 30]
    again = mvcore.load(tmp_path)
    for a, b in zip(again.calib, moved):
        assert np.abs(a.center - b.center).max() < 1e-8
        assert np.abs(a.K - b.K).max() < 1e-12
        assert a.fisheye == fisheye
        assert np.array_equal(a.distortion, b.distortion) or not b.distortion.any()
    assert [f.name for f in again.frames] == [f.name for f in scene.frames]


def test_mvsnet_ranges_and_pairs_come_from_points(tmp_path, points):
    cameras = cameras_around()
    mvcore.save_calibration(tmp_path, scene_of(tmp_path, cameras), "mvsnet", points=points)
    for n, camera in enumerate(cameras):
        z = camera.to_camera(points.positions[points.visible[n]])[:, 2] if n < 3 else camera.to_camera(points.positions)[:, 2]
        near, step, planes, far = map(float, (tmp_path / "cams" / f"{n:08d}_cam.txt").read_text().split()[-4:])
        assert near == pytest.approx(np.quantile(z, 0.01) / 1.25) or points.visible[n].sum() >= 10
        assert near < z.min()
        assert far > z.max()
        assert near + step * (planes - 1) == pytest.approx(far)
    pairs = mvsnet.read_pairs(tmp_path / "pair.txt")
    to = [points.positions - c.center for c in cameras]
    both = points.visible[0] & points.visible[1]
    cosine = (to[0] * to[1]).sum(1) / np.linalg.norm(to[0], axis=1) / np.linalg.norm(to[1], axis=1)
    angle = np.degrees(np.arccos(cosine))[both]
    expected = np.exp(-((angle - 5) ** 2) / np.where(angle <= 5, 2, 200)).sum()  # MVSNet 4.1
    assert dict(pairs[0])[1] == pytest.approx(expected, rel=1e-5)
    assert [j for j, _ in pairs[0]] == [1, 2, 3]  # by shared points under small angles


def test_mvsnet_without_points_or_a_place_to_look_at_is_refused(tmp_path):
    pair = [mvcore.Camera([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.eye(3), [-0.1 * n, 0, 0], *SIZE) for n in range(2)]
    scene = scene_of(tmp_path, pair)
    with pytest.raises(InvalidInputError, match="expected points or bounds for its MVSNet depth range"):
        mvcore.save_calibration(tmp_path / "out", scene, "mvsnet")
    mvcore.save_calibration(
        tmp_path / "out", mvcore.Scene(scene.frames, scene.calib, bounds=np.array([[-1.0, -1, 2], [1, 1, 4]])), "mvsnet"
    )
    near, _, _, far = map(float, (tmp_path / "out" / "cams" / "00000000_cam.txt").read_text().split()[-4:])
    assert (near, far) == (2, 4)


def test_points_of_other_views_are_refused(tmp_path, points):
    scene = scene_of(tmp_path, cameras_around()[:3])
    with pytest.raises(InvalidInputError, match=r"points: expected visible of shape \(3, N\)"):
        mvcore.save_calibration(tmp_path, scene, "colmap", points=points)
    skewed = mvcore.Camera([[60, 1, 32], [0, 60, 24], [0, 0, 1]], np.eye(3), [0, 0, 2], *SIZE)
    with pytest.raises(InvalidInputError, match="no skew"):
        mvcore.save_calibration(tmp_path, mvcore.Scene([None], mvcore.Calibration((skewed,))), "nerfstudio")


def test_convert_takes_points_from_the_images(tmp_path):
    cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 0), (0, 0, 0)) for a in (0.0, 0.04, 0.08)]  # a narrow rig: 2.3 degrees apart
    write_scene(tmp_path / "set", cameras, [render_sphere(c)[0] for c in cameras])
    scene = mvcore.load(tmp_path / "set")
    points = sparse_points(scene)
    assert len(points) > 30
    assert points.visible.shape == (3, len(points))
    gone = mvcore.Scene([None, *scene.frames[1:]], scene.calib)
    assert not sparse_points(gone).visible[0].any()
    assert sparse_points(mvcore.Scene([None] * 3, scene.calib)) is None
    from mvcore.cli.main import app

    run = CliRunner().invoke(app, ["convert", str(tmp_path / "set"), str(tmp_path / "out"), "--to", "mvsnet"])
    assert run.exit_code == 0, run.output
    near, _, _, far = map(float, (tmp_path / "out" / "cams" / "00000001_cam.txt").read_text().split()[-4:])
    assert near < 1.6 < far  # the sphere's front; the wall is at six
    run = CliRunner().invoke(app, ["convert", str(tmp_path / "set"), str(tmp_path / "colmap"), "--to", "colmap"])
    assert run.exit_code == 0, run.output
    assert len((tmp_path / "colmap" / "points3D.txt").read_text().splitlines()) > 30


def test_names_start_at_the_folder_of_all_images(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    for place, expected in (
        ("images/scene/images/cam{}/0001.jpg", "cam{}/0001.jpg"),  # the name of an image folder twice
        ("photos dir/cäm {}/a b.jpg", "cäm {}/a b.jpg"),
        ("other/{}.png", "{}.png"),
        ("rgb/left/{}.png", "left/{}.png"),
    ):
        home = tmp_path / place.partition("{")[0].replace("/", "_")
        frames = [home / place.format(n) for n in range(4)]
        root = home / "images" / "scene" if "scene" in place else home
        calib = mvcore.Calibration(tuple(cameras_around()), str(root / "cameras.json"))
        mvcore.save_calibration(home / "colmap", mvcore.Scene(frames, calib), "colmap")
        read = pycolmap.Reconstruction(str(home / "colmap"))
        assert sorted(i.name for i in read.images.values()) == [expected.format(n) for n in range(4)]


def test_names_with_blanks_make_a_binary_model(tmp_path, points):
    pycolmap = pytest.importorskip("pycolmap")
    scene = scene_of(tmp_path / "set", cameras_around(LENS))
    for form in ("plain", "with blanks"):
        frames = [f.rename(f.with_name(f"{form} {n}.png" if form != "plain" else f.name)) for n, f in enumerate(scene.frames)]
        mvcore.save_calibration(tmp_path / form, replace(scene, frames=frames), "colmap", points=points)
    plain, blanks = (pycolmap.Reconstruction(str(tmp_path / form)) for form in ("plain", "with blanks"))
    assert {i.name for i in blanks.images.values()} == {f"with blanks {n}.png" for n in range(4)}
    assert (tmp_path / "with blanks" / "images.bin").is_file()
    for number, image in plain.images.items():
        other = blanks.images[number]
        assert [p.point3D_id for p in image.points2D] == [p.point3D_id for p in other.points2D]
        np.testing.assert_array_equal([p.xy for p in image.points2D], [p.xy for p in other.points2D])
        np.testing.assert_array_equal(image.camera.params, other.camera.params)
    for number, point in plain.points3D.items():
        other = blanks.points3D[number]
        np.testing.assert_array_equal([*point.xyz, *point.color], [*other.xyz, *other.color])
        assert [(e.image_id, e.point2D_idx) for e in point.track.elements] == [(e.image_id, e.point2D_idx) for e in other.track.elements]
    read = mvcore.load(tmp_path / "with blanks", images=tmp_path / "set" / "images")
    assert [f.name for f in read.frames] == [f"with blanks {n}.png" for n in range(4)]


def test_our_own_file_keeps_masks_names_and_a_mirrored_world(tmp_path):
    cameras = tuple(replace(c, name=f"cam {n}") for n, c in enumerate(cameras_around()))
    scene = scene_of(tmp_path / "set", cameras)
    masks = [tmp_path / "set" / "mattes of mine" / f.name for f in scene.frames]
    masks[0].parent.mkdir()
    for mask in masks:
        cv2.imwrite(str(mask), np.zeros((SIZE[1], SIZE[0]), np.uint8))
    bounds = np.array([[-1.0, -1, -0.5], [1, 1, 2]])
    for mirrored in (False, True):
        calib = mvcore.Calibration(cameras, mirrored=mirrored)
        mvcore.save_calibration(tmp_path / "set" / "cameras.json", mvcore.Scene(scene.frames, calib, masks, bounds))
        read = mvcore.load(tmp_path / "set")
        assert read.mirrored == mirrored
        assert list(read.masks) == masks
        assert [c.name for c in read.calib] == [c.name for c in cameras]
        np.testing.assert_allclose(read.bounds, bounds)
        for a, b in zip(read.calib, cameras):
            np.testing.assert_allclose(a.project([[0.1, 0.2, 0.3]]), b.project([[0.1, 0.2, 0.3]]), atol=1e-9)
    *_, far = map(float, _mvsnet_range(tmp_path, mvcore.Scene(scene.frames, mvcore.Calibration(cameras, mirrored=True), None, bounds)))
    depths = cameras[0].to_camera(np.array(np.meshgrid([-1.0, 1], [-1.0, 1], [-2.0, 0.5])).reshape(3, -1).T)[:, 2]
    assert far == pytest.approx(depths.max())


def _mvsnet_range(folder, scene):
    mvcore.save_calibration(folder / "mvs", scene, "mvsnet")
    return (folder / "mvs" / "cams" / "00000000_cam.txt").read_text().split()[-4:]
