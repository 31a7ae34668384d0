"""Where images and masks lie, and which paths of a calibration are followed."""

import json
import struct

import cv2
import mvcore
import numpy as np
import pytest
from conftest import look_at
from mvcore import FormatError
from mvcore.io.formats.places import dataset_root

SIZE = (64, 48)


def image(path, size=SIZE, value=9):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((size[1], size[0], 3), value, np.uint8))
    return path


def rig(count=3):
    return [look_at((2 * np.cos(a), 2 * np.sin(a), 0.4), (0, 0, 0), SIZE, 60.0) for a in np.linspace(0, 1, count)]


def colmap(folder, names, blank=True, points=False):
    """A text model of cameras in a row."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    lines = []
    for n, name in enumerate(names):
        lines.append(f"{n + 1} 1 0 0 0 {n} 0 0 1 {name}")
        lines += ["1.5 2.5 -1 3 4 17"] if points else [""] if blank else []
    (folder / "images.txt").write_text("# a comment\n" + "\n".join(lines) + "\n")
    return folder


def native(folder, names, **view):
    folder.mkdir(parents=True, exist_ok=True)
    views = []
    for c, name in zip(rig(len(names)), names):
        one = {"K": c.K.tolist(), "R": c.R.tolist(), "t": c.t.tolist(), "width": 64, "height": 48}
        views.append(one | ({"image": name} if name else {}) | view)
    (folder / "cameras.json").write_text(json.dumps({"views": views}))
    return folder


NAMES = ["a.png", "b.png", "c.png"]


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "colmap/sparse/0", "dense/0/sparse", ".", "distorted/sparse/0"])
@pytest.mark.parametrize("images", ["images", "images_2", "input", "photos_of_mine"])
def test_colmap_trees(tmp_path, model, images):
    colmap(tmp_path / model, NAMES)
    for n in NAMES:
        image(tmp_path / images / n)
    for path in (tmp_path, tmp_path / model):
        scene = mvcore.load(path)
        assert [f.relative_to(tmp_path).as_posix() for f in scene.frames] == [f"{images}/{n}" for n in NAMES]
        assert not scene.warnings


def test_the_nearest_images_of_a_dense_model(tmp_path):
    colmap(tmp_path / "dense" / "0" / "sparse", NAMES)
    for n in NAMES:
        image(tmp_path / "images" / n)
        image(tmp_path / "dense" / "0" / "images" / n)
    assert mvcore.load(tmp_path).frames[0] == tmp_path / "dense" / "0" / "images" / "a.png"


def test_the_largest_of_several_models_is_read(tmp_path):
    for n in NAMES:
        image(tmp_path / "images" / n)
    colmap(tmp_path / "sparse" / "0", NAMES[:2])
    colmap(tmp_path / "sparse" / "1", NAMES)
    scene = mvcore.load(tmp_path)
    assert len(scene) == 3
    assert "2 models (images of each: 0: 2, 1: 3); 1 is read" in scene.warnings[0]
    assert len(mvcore.load(tmp_path / "sparse" / "0")) == 2


@pytest.mark.parametrize("layout", [{"blank": True}, {"blank": False}, {"points": True}])
def test_colmap_text_with_and_without_lines_of_points(tmp_path, layout):
    names = [*NAMES, "d e 1 2 3.png"]
    for n in names:
        image(tmp_path / "images" / n)
    scene = mvcore.load(colmap(tmp_path, names, **layout))
    assert [c.name for c in scene.calib] == names
    assert [c.t[0] for c in scene.calib] == [0, 1, 2, 3]


def test_damaged_colmap_models_are_refused(tmp_path):
    colmap(tmp_path, NAMES)
    (tmp_path / "images.txt").write_text("1 0 0 0 0 0 0 0 1 a.png\n\n")
    with pytest.raises(FormatError, match=r"images.txt:1: image 'a.png': expected a quaternion"):
        mvcore.load(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 64, 48, 60, 60, 32, 24))
    pose = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 1)
    for data, message in (
        (struct.pack("<Q", 10**18), "entries"),
        (struct.pack("<Q", 1) + pose + b"a.png\0" + struct.pack("<Q", 2**40), "1099511627776 entries of 24 bytes, but the file has 0 left"),
        (struct.pack("<Q", 1) + pose + b"a" * 90, "an image's name"),
    ):
        (tmp_path / "images.bin").write_bytes(data)
        with pytest.raises(FormatError, match=message):
            mvcore.load(tmp_path)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 1) + pose + b"a.png\0" + struct.pack("<Q", 1) + bytes(24))
    image(tmp_path / "images" / "a.png")
    assert len(mvcore.load(tmp_path)) == 1


def test_the_root_of_a_data_set(tmp_path):
    for inner in ("sparse/0", "colmap/sparse/0", "dense/0/sparse", "cams"):
        assert dataset_root(tmp_path / "set" / inner) == tmp_path / "set"
    assert dataset_root(tmp_path / "set" / "0") == tmp_path / "set" / "0"


def test_a_folder_of_images_that_the_caller_names(tmp_path):
    native(tmp_path / "calib", [None, None, None])
    for n in NAMES:
        image(tmp_path / "elsewhere" / "of" / f"photo_{n}")
    with pytest.raises(FormatError, match=r"does not say where its images are.*--images DIR"):
        mvcore.load(tmp_path / "calib")
    scene = mvcore.load(tmp_path / "calib", images=tmp_path / "elsewhere")
    assert [f.name for f in scene.frames] == ["photo_a.png", "photo_b.png", "photo_c.png"]
    assert "in order" in scene.warnings[0]
    with pytest.raises(FileNotFoundError, match=r"no such folder of images"):
        mvcore.load(tmp_path / "calib", images=tmp_path / "nowhere")
    native(tmp_path / "named", ["x.png", "y.png", "z.png"])
    with pytest.raises(FormatError, match=r"no image for x.png"):
        mvcore.load(tmp_path / "named", images=tmp_path / "elsewhere")
    image(tmp_path / "elsewhere" / "more.png")
    with pytest.raises(FormatError, match=r"no image for"):
        mvcore.load(tmp_path / "calib", images=tmp_path / "elsewhere")


def test_one_image_in_each_cameras_folder(tmp_path):
    native(tmp_path, [None, None])
    data = json.loads((tmp_path / "cameras.json").read_text())
    for n, view in enumerate(data["views"]):
        view["name"] = f"cam{n}"
        image(tmp_path / f"cam{n}" / "data" / "0001.png")
    (tmp_path / "cameras.json").write_text(json.dumps(data))
    assert [f.parent.parent.name for f in mvcore.load(tmp_path).frames] == ["cam0", "cam1"]
    image(tmp_path / "cam1" / "data" / "0002.png")
    with pytest.raises(FormatError, match=r"cam1: expected one image of a camera, got 2"):
        mvcore.load(tmp_path)


def test_paths_that_lead_out_are_refused(tmp_path):
    folder = tmp_path / "set" / "run"
    image(tmp_path / "secret" / "a.png")
    for n in NAMES:
        image(folder / n)
    for path in ("../../secret/a.png", str(tmp_path / "secret" / "a.png"), "x/../../../secret/a.png"):
        native(folder, [path, "b.png"])
        with pytest.raises(FormatError, match=r"lies outside"):
            mvcore.load(folder)
        assert len(mvcore.load(folder, allow_outside=True)) == 2
        assert len(mvcore.load(folder, images=False)) == 2  # no image is opened
    native(folder, ["a.png", "b.png"], mask="../../secret/a.png")
    with pytest.raises(FormatError, match=r"mask '../../secret/a.png' lies outside"):
        mvcore.load(folder)


def test_usual_folders_beside_the_calibration_and_links_are_followed(tmp_path):
    for n in NAMES:
        image(tmp_path / "images" / n)
        image(tmp_path / "store" / n)
    native(tmp_path / "run1", [f"../images/{n}" for n in NAMES])
    assert mvcore.load(tmp_path / "run1").frames[2] == tmp_path / "images" / "c.png"
    native(tmp_path / "linked", [f"images/{n}" for n in NAMES])
    (tmp_path / "linked" / "images").symlink_to("../store")
    assert mvcore.load(tmp_path / "linked").frames[0] == tmp_path / "linked" / "images" / "a.png"
    (tmp_path / "linked" / "images").unlink()
    (tmp_path / "linked" / "images").write_text("../store")
    with pytest.raises(FormatError, match=r"no folder but a file with the text '../store', a link that was not restored"):
        mvcore.load(tmp_path / "linked")


def test_absolute_paths_of_another_machine(tmp_path):
    for n in NAMES[:2]:
        image(tmp_path / "images" / "cam" / n)
    native(tmp_path, [f"C:\\scans\\today\\cam\\{n}" for n in NAMES])
    scene = mvcore.load(tmp_path)
    assert [f.name for f in scene.frames] == ["a.png", "b.png"]
    native(tmp_path, [f"/home/other/scans/{n}" for n in NAMES])
    assert len(mvcore.load(tmp_path)) == 2


def test_images_of_one_name_in_several_folders(tmp_path):
    names = ["cam0/1.png", "cam1/1.png", "cam2/1.png"]
    for n in names[::2]:
        image(tmp_path / "images" / n)
    scene = mvcore.load(colmap(tmp_path / "sparse" / "0", names))
    assert [f.parent.name for f in scene.frames] == ["cam0", "cam2"]


def test_masks_beside_the_images(tmp_path):
    for n in ("v1", "v2", "v10"):
        image(tmp_path / "images" / f"{n}.png")
    for n in ("v1", "v10"):
        image(tmp_path / "masks" / f"{n}.png", value=255)
    scene = mvcore.load(native(tmp_path, ["images/v1.png", "images/v2.png", "images/v10.png"]))
    assert [m and m.name for m in scene.masks] == ["v1.png", None, "v10.png"]


def test_a_byte_order_mark_and_sizes_as_floats(tmp_path):
    for n in NAMES:
        image(tmp_path / n)
    native(tmp_path, NAMES, width=64.0, height="48")
    text = (tmp_path / "cameras.json").read_text()
    (tmp_path / "cameras.json").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert mvcore.load(tmp_path).calib[0].width == 64


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ({"width": "wide"}, r"views\[0\]: width: expected a number, got 'wide'"),
        ({"width": -64}, "width: expected a whole number of pixels"),
        ({"K": "x"}, "K: expected 3 x 3 numbers"),
        ({"t": [1, 2]}, "t: expected 3 numbers"),
        ({"dist": "none"}, "dist: expected numbers"),
        ({"image": 7}, "image: expected a path"),
    ],
)
def test_wrong_values_of_cameras_json_are_named(tmp_path, view, message):
    with pytest.raises(FormatError, match=message):
        mvcore.load(native(tmp_path, NAMES, **view), images=False)


def test_bare_and_mirrored_projection_matrices(tmp_path):
    cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 0.5), (0, 0, 0), SIZE, 60.0) for a in range(6)]
    for n in range(6):
        image(tmp_path / f"{n}.png")

    def written(flip, bounds=None):
        views = [{"image": f"{n}.png", "P": (2.5 * c.projection @ flip).tolist()} for n, c in enumerate(cameras)]
        (tmp_path / "cameras.json").write_text(json.dumps({"views": views, "bounds": bounds}))
        return mvcore.load(tmp_path)

    scene = written(np.eye(4))
    assert not scene.mirrored
    assert scene.mirror is None
    assert np.allclose(scene.calib[3].projection, cameras[3].projection)
    flip = np.diag([-1.0, 1, 1, 1])
    scene = written(flip, bounds=[[-1, -2, -3], [1, 2, 4]])
    assert scene.mirrored
    assert "left-handed" in scene.warnings[0]
    assert scene.bounds.tolist() == [[-1, -2, -3], [1, 2, 4]]
    point = np.array([0.1, 0.2, -0.1, 1])
    working = np.linalg.inv(scene.mirror) @ point
    caller = cameras[2].projection @ flip @ point
    assert np.allclose(scene.calib[2].project(working[None, :3]), caller[:2] / caller[2])
    assert (scene.calib[2].to_camera(working[None, :3])[:, 2] > 0).all()
    assert scene.subset([0, 2]).mirrored


def test_a_mirrored_world_of_an_archive(tmp_path):
    cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 0.5), (0, 0, 0), SIZE, 60.0) for a in range(6)]
    for n in range(6):
        image(tmp_path / "image" / f"{n:03d}.png")
    for flip in (np.eye(4), np.diag([1.0, 1, -1, 1])):
        matrices = {f"world_mat_{n}": np.vstack([c.projection @ flip, [0, 0, 0, 1]]) for n, c in enumerate(cameras)}
        np.savez(tmp_path / "cameras_sphere.npz", **matrices)
        scene = mvcore.load(tmp_path)
        assert scene.mirrored == (flip[2, 2] < 0)
        assert np.allclose(scene.calib[3].R, cameras[3].R)


def test_reflections_as_k_r_t_are_read_as_a_mirrored_world(tmp_path):
    cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 0.5), (0, 0, 0), SIZE, 60.0) for a in range(6)]
    views = []
    for n, c in enumerate(cameras):
        image(tmp_path / f"{n}.png")
        views.append({"image": f"{n}.png", "K": c.K.tolist(), "R": (c.R @ np.diag([1, -1, 1])).tolist(), "t": c.t.tolist()})
    (tmp_path / "cameras.json").write_text(json.dumps({"views": views}))
    assert mvcore.load(tmp_path).mirrored


def test_mvsnet_numbers_and_reduced_intrinsics(tmp_path):
    (tmp_path / "cams").mkdir()
    for n in (0, 2, 10):
        text = "extrinsic\n1 0 0 {n}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n\nintrinsic\n15 0 7.6\n0 15 5.6\n0 0 1\n"
        (tmp_path / "cams" / f"{n:08d}_cam.txt").write_text(text.replace("{n}", str(n)))
        image(tmp_path / "blended_images" / f"{n:04d}.png")
    scene = mvcore.load(tmp_path)
    assert [f.stem for f in scene.frames] == ["0000", "0002", "0010"]
    # The principal point is a quarter of the image's: K is of images reduced by 4, as DTU's training set has it.
    assert np.allclose(scene.calib[0].K, [[60, 0, 31.9], [0, 60, 23.9], [0, 0, 1]])
    assert "smaller by 4" in scene.warnings[0]
    (tmp_path / "cams" / "00000000_cam.txt").write_text("extrinsic\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 0\nintrinsic\n1 0 0\n0 1 0\n0 0 1\n")
    with pytest.raises(FormatError, match=r"cam.txt:5: expected '0 0 0 1'"):
        mvcore.load(tmp_path)


def test_middlebury_names_in_quotes(tmp_path):
    camera = rig(1)[0]
    numbers = " ".join(f"{v:.17g}" for v in [*camera.K.ravel(), *camera.R.ravel(), *camera.t])
    names = ["a view.png", "b.png"]
    (tmp_path / "x_par.txt").write_text("\n2\n" + "".join(f'"{n}" {numbers}\n\n' for n in names))
    for n in names:
        image(tmp_path / n)
    assert [c.name for c in mvcore.load(tmp_path).calib] == names
    (tmp_path / "x_par.txt").write_text(f'3\n"a view.png" {numbers}\n')
    with pytest.raises(FormatError, match=r"x_par.txt:2: expected 3 views, got 1"):
        mvcore.load(tmp_path)


@pytest.mark.parametrize("offset", [(500_000.0, 5_600_000.0, 200.0), (3_900_000.0, 700_000.0, 4_970_000.0)])
def test_absolute_coordinates_lose_nothing(tmp_path, offset):
    cameras = rig(3)
    views = []
    for n, c in enumerate(cameras):
        name = image(tmp_path / f"{n}.png").name
        r = np.round(c.R, 6)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = r.T * [1, -1, -1], c.center + offset
        views.append({"file_path": name, "transform_matrix": pose.tolist(), "fl_x": 60, "w": 64, "h": 48})
        text = lambda m: "\n".join(" ".join(f"{v:.17g}" for v in row) for row in np.atleast_2d(m))  # noqa: E731
        strecha = tmp_path / "strecha" / f"{n}.png.camera"
        image(tmp_path / "strecha" / f"{n}.png")
        strecha.write_text(f"{text(c.K)}\n0 0 0\n{text(r.T)}\n{text(c.center + offset)}\n64 48\n")
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": views}))
    for scene in (mvcore.load(tmp_path), mvcore.load(tmp_path / "strecha")):
        for camera, true in zip(scene.calib, cameras):
            assert np.abs(camera.center - true.center - offset).max() < 1e-8
            shift = camera.project([offset]) - true.project([[0, 0, 0]])
            assert np.abs(shift - shift.round()).max() < 0.5  # nerf's centre of the image differs by half a pixel only
