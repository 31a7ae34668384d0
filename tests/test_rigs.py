"""Calibrations that name cameras and no images, as rigs write them: what lies where, and what is refused."""

import json

import cv2
import mvcore
import numpy as np
import pytest
from conftest import rig
from fuzz import seeds
from mvcore.errors import FormatError
from mvcore.io.scene import Scene


@pytest.fixture
def scene():
    return Scene(frames=(), calib=mvcore.Calibration(tuple(rig(3, (32, 24)))))


def picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((24, 32, 3), np.uint8))
    return path


@pytest.mark.parametrize("place", ["{}.png", "images/{}.png", "images/{}/0.jpg", "{}/0.jpg", "{}/data/0.jpg"])
def test_where_a_cameras_image_lies(tmp_path, scene, place):
    for n in range(3):
        picture(tmp_path / f"{n}.png")
    seeds._kalibr(tmp_path, scene)
    for n in range(3):
        (tmp_path / f"cam{n}.png").unlink()
    images = [picture(tmp_path / place.format(f"cam{n}")) for n in range(3)]
    assert list(mvcore.load(tmp_path).frames) == images
    if "/0" in place:
        picture(images[0].with_name("1.jpg"))
        with pytest.raises(FormatError, match="several instants are a clip"):
            mvcore.load(tmp_path)
        assert len(mvcore.load(tmp_path, images=False)) == 3


def test_easymocap_with_one_image_a_camera_and_names_without_quotes(tmp_path, scene):
    for n in range(3):
        picture(tmp_path / f"{n}.png")
    seeds._easymocap(tmp_path, scene)
    for n in range(3):
        picture(tmp_path / "images" / f"0{n}" / "000000.jpg")
    for file in ("intri.yml", "extri.yml"):
        text = (tmp_path / file).read_text()
        for n in range(3):
            text = text.replace(f'"{n}"', f"0{n}").replace(f"_{n}:", f"_0{n}:")
        (tmp_path / file).write_text(text.replace("%YAML 1.2", "%YAML:1.0"))
    read = mvcore.load(tmp_path)
    assert [c.name for c in read.calib] == ["00", "01", "02"]
    assert [f.relative_to(tmp_path).as_posix() for f in read.frames] == [f"images/0{n}/000000.jpg" for n in range(3)]
    for a, b in zip(read.calib, scene.calib):
        np.testing.assert_allclose(a.project([[0.1, 0.2, 0.3]]), b.project([[0.1, 0.2, 0.3]]), atol=1e-9)
    text = (tmp_path / "intri.yml").read_text()
    for name in ('""', '".."', '"../a"', "/etc/passwd", "a\\\\b"):
        (tmp_path / "intri.yml").write_text(text.replace("- 00", f"- {name}"))
        with pytest.raises(FormatError, match=r"intri\.yml: expected a list 'names' of cameras"):
            mvcore.load(tmp_path)
    (tmp_path / "intri.yml").write_text(text.replace("W_01: 32", "W_01: 1e300"))
    with pytest.raises(FormatError, match=r"intri\.yml: W_01: expected a number of pixels"):
        mvcore.load(tmp_path)


def test_kalibr_by_its_content_and_a_fisheye_without_distortion(tmp_path, scene):
    for n in range(3):
        picture(tmp_path / f"{n}.png")
    seeds._kalibr(tmp_path, scene)
    for n in range(3):
        (tmp_path / f"cam{n}.png").unlink()
        picture(tmp_path / f"cam{n}" / "data" / "0001.jpg")
    text = (tmp_path / "camchain.yaml").read_text()
    (tmp_path / "camchain.yaml").unlink()
    (tmp_path / "result.yaml").write_text(text.replace("[0.1, 0.0", "[0.0, 0.0"))
    (tmp_path / "other.yaml").write_text("a: 1\n")
    for path in (tmp_path, tmp_path / "result.yaml"):
        read = mvcore.load(path)
        assert [f.relative_to(tmp_path).as_posix() for f in read.frames] == [f"cam{n}/data/0001.jpg" for n in range(3)]
        assert all(c.fisheye and c.distortion.tolist() == [0, 0, 0, 0] for c in read.calib)
    for old, new, message in (
        ("resolution: [32", "resolution: [1e9", "resolution: expected 1 to"),
        ("intrinsics: [", "intrinsics: [.nan, ", "intrinsics: expected 4 finite numbers"),
        ("cam1:", "cam7:", "expected cameras cam0, cam1"),
    ):
        (tmp_path / "result.yaml").write_text(text.replace(old, new))
        with pytest.raises(FormatError, match=rf"result\.yaml: .*{message}"):
            mvcore.load(tmp_path / "result.yaml")


@pytest.mark.parametrize("key", ["T_imu_cam", "T_cam_imu"])
def test_openvins_chain_of_cameras_and_an_imu(tmp_path, scene, key):
    for n in range(3):
        picture(tmp_path / f"{n}.png")
    seeds._kalibr(tmp_path, scene)
    text, imu = "%YAML:1.0\n\n", np.vstack([np.column_stack([cv2.Rodrigues(np.array([0.3, 1, -2]))[0], [1, 2, 3]]), [0, 0, 0, 1]])
    for n, c in enumerate(scene.calib):  # the IMU in the world: X_imu = imu X
        pose = np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]]) @ np.linalg.inv(imu)
        rows = (pose if key == "T_cam_imu" else np.linalg.inv(pose)).tolist()
        text += f"cam{n}:\n  {key}: #a comment\n" + "".join(f"    - {row}\n" for row in rows)
        text += "  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]\n"
        text += f"  intrinsics: {[*map(float, c.K[[0, 1, 0, 1], [0, 1, 2, 2]])]}\n  resolution: [{c.width}, {c.height}]\n"
        text += f"  rostopic: /cam{n}/image_raw\n  timeshift_cam_imu: 0.01\n"
    (tmp_path / "camchain.yaml").rename(tmp_path / "old.txt")
    (tmp_path / "kalibr_imucam_chain.yaml").write_text(text)
    point = np.array([0.1, 0.2, 0.3])
    for a, b in zip(mvcore.load(tmp_path).calib, scene.calib):
        np.testing.assert_allclose(a.project([imu[:3, :3] @ point + imu[:3, 3]]), b.project([point]), atol=1e-9)
    (tmp_path / "kalibr_imucam_chain.yaml").write_text(text.replace(key, "T_xyz", 1))
    with pytest.raises(FormatError, match="cam1: T_cn_cnm1: expected 4 x 4 finite numbers"):
        mvcore.load(tmp_path)


def test_strechas_cameras_in_a_folder_of_their_own(tmp_path, scene):
    for n in range(3):
        picture(tmp_path / "fountain_dense_images" / f"{n}.png")
    (tmp_path / "fountain_dense_cameras").mkdir()
    seeds._strecha(tmp_path / "fountain_dense_cameras", scene)
    read = mvcore.load(tmp_path)
    assert [f.relative_to(tmp_path).as_posix() for f in read.frames] == [f"fountain_dense_images/{n}.png" for n in range(3)]
    for a, b in zip(read.calib, scene.calib):
        np.testing.assert_allclose(a.project([[0.1, 0.2, 0.3]]), b.project([[0.1, 0.2, 0.3]]), atol=1e-5)


def test_our_file_with_matrices_as_lists(tmp_path, scene):
    views = []
    for n, c in enumerate(scene.calib):
        picture(tmp_path / f"{n}.png")
        views.append({"image": f"{n}.png", "K": c.K.ravel().tolist(), "R": c.R.ravel().tolist(), "t": c.t.tolist()})
    (tmp_path / "cameras.json").write_text(json.dumps({"views": views}))
    for a, b in zip(mvcore.load(tmp_path).calib, scene.calib):
        np.testing.assert_allclose(a.projection, b.projection, atol=1e-12)


def test_qualisys_images_and_numbers(tmp_path, scene):
    for n in range(3):
        picture(tmp_path / f"{n}.png")
    seeds._qualisys(tmp_path, scene)
    assert [f.name for f in mvcore.load(tmp_path).frames] == ["0.png", "1.png", "2.png"]
    path = tmp_path / "a.qca.txt"
    text = path.read_text()
    for old, new in (('right="31"', 'right="1e300"'), ('right="31"', 'right="nan"'), ('right="31"', 'right="-5"')):
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(FormatError, match=r"a\.qca\.txt: camera 0: fov_video"):
            mvcore.load(tmp_path)


@pytest.mark.parametrize(
    ("keys", "images"), [((0, 1, 3), ("000", "001", "003")), ((1, 2, 3), ("000", "001", "002")), ((0, 1, 2), ("a", "b", "c"))]
)
def test_idr_keys_and_images(tmp_path, scene, keys, images):
    for name in images:
        picture(tmp_path / "image" / f"{name}.png")
    (tmp_path / "image" / f"._{images[0]}.png").write_bytes(b"left by a file manager")
    np.savez(tmp_path / "cameras_sphere.npz", **{f"world_mat_{k}": c.projection for k, c in zip(keys, scene.calib)})
    read = mvcore.load(tmp_path)
    assert [f.stem for f in read.frames] == list(images)
    for a, b in zip(read.calib, scene.calib):
        np.testing.assert_allclose(a.center, b.center, atol=1e-9)
    picture(tmp_path / "image" / "extra.png")
    if keys != (0, 1, 3):
        with pytest.raises(FormatError, match="3 cameras, but 4 images"):
            mvcore.load(tmp_path)
