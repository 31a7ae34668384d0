import json
import os
import subprocess
import sys

import cv2
import mvcore
import numpy as np
import pytest
import trimesh
from conftest import write_scene
from mvcore import InvalidInputError, ReconstructionError
from mvcore.cli.main import app
from mvcore.depth.occlusion import continued
from mvcore.evaluation import metrics
from typer.testing import CliRunner

SETTINGS = {"texture": {"least_patch": 8}}


@pytest.fixture(scope="module")
def result(ring):
    cameras, images, _, masks = ring
    return mvcore.reconstruct(images, cameras, masks=masks, config=SETTINGS)


def test_a_sphere_is_reconstructed(result):
    radius = np.linalg.norm(result.vertices, axis=1)
    assert np.median(np.abs(radius - 0.5)) < 0.01
    assert result.report["left_out"] == []
    assert set(result.report["seconds"]) == {
        "io",
        "sparse",
        "silhouettes",
        "depth",
        "consistency",
        "volume",
        "surface",
        "texture",
    }
    json.dumps(result.report, default=str)


def test_without_masks_too(ring):
    cameras, images, _depths, _masks = ring
    found = mvcore.reconstruct(images, cameras, bounds=[[-0.7] * 3, [0.7] * 3])
    radius = np.linalg.norm(found.vertices, axis=1)
    assert np.median(np.abs(radius - 0.5)) < 0.01
    assert np.allclose(found.bounds, [[-0.7] * 3, [0.7] * 3], atol=1e-12)


def test_sides_that_no_photograph_shows_are_left_open_unless_asked_for(ring):
    cameras, images, _, masks = (part[:5] for part in ring)
    meshes = {}
    for reach in (None, 1.0):
        found = mvcore.reconstruct(images, cameras, masks=masks, config=SETTINGS | {"surface": {"unseen_reach": reach}})
        meshes[reach] = trimesh.Trimesh(found.vertices, found.faces)  # joins the vertices that charts split
        assert (found.report.get("unseen_left_open", 0) > 0) == (reach is not None)
    assert meshes[None].is_watertight
    assert not meshes[1.0].is_watertight
    assert meshes[1.0].area < 0.9 * meshes[None].area


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_saved_meshes_are_read_back(result, tmp_path, suffix):
    path = tmp_path / f"ball{suffix}"
    result.save(path)
    scene = trimesh.load(path, process=False, force="scene")
    (mesh,) = scene.geometry.values()
    assert len(mesh.faces) == len(result.faces)
    assert np.abs(np.sort(mesh.vertices, 0) - np.sort(result.vertices, 0)).max() < 1e-5
    if suffix != ".ply":
        assert mesh.visual.uv is not None
    names = {".glb": 1, ".ply": 1, ".obj": 3}
    assert len(list(tmp_path.iterdir())) == names[suffix]


def test_glb_is_unlit_and_holds_the_texture(result, tmp_path):
    result.save(tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    assert b"KHR_materials_unlit" in data
    (mesh,) = trimesh.load(tmp_path / "a.glb", force="scene").geometry.values()
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    assert (picture == result.texture).all()


def test_depth_and_report_are_saved(result, tmp_path):
    result.save_depth(tmp_path / "d", "npz")
    with np.load(tmp_path / "d" / "view003.npz") as saved:
        assert (saved["depth"] == result.depths[3].depth).all()
    result.save_report(tmp_path / "r.json")
    assert json.loads((tmp_path / "r.json").read_text())["views"] == 12
    with pytest.raises(InvalidInputError, match="path"):
        result.save(tmp_path / "a.stl")


def test_a_failing_save_leaves_nothing(result, tmp_path, monkeypatch):
    (tmp_path / "a.glb").write_bytes(b"before")
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        result.save(tmp_path / "a.glb")
    assert [p.name for p in tmp_path.iterdir()] == ["a.glb"]
    assert (tmp_path / "a.glb").read_bytes() == b"before"


def test_the_same_bytes_for_one_and_two_threads(ring, tmp_path):
    cameras, images, _, _ = ring
    folder = write_scene(tmp_path / "scene", cameras[:5], images[:5])
    outs = []
    for n, threads in enumerate(("1", "2", "2")):
        out = tmp_path / f"{n}.glb"
        command = [sys.executable, "-m", "mvcore.cli.main", "reconstruct", str(folder), "-o", str(out)]
        subprocess.run(command, check=True, env={**os.environ, "RAYON_NUM_THREADS": threads}, capture_output=True)
        outs.append(out.read_bytes())
    assert outs[0] == outs[1] == outs[2]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"frames": 11}, "frames: expected 12"),
        ({"bounds": [1, 2, 3]}, "bounds"),
        ({"bounds": [[1, 1, 1], [0, 0, 0]]}, "bounds"),
        ({"masks": 3}, "masks: expected 12"),
        ({"config": {"depht": {}}}, "did you mean 'depth'"),
    ],
)
def test_bad_input_is_named(ring, change, named):
    cameras, images, _, masks = ring
    frames = images[: change.pop("frames", 12)]
    if "masks" in change:
        change["masks"] = masks[: change["masks"]]
    with pytest.raises(InvalidInputError, match=named):
        mvcore.reconstruct(frames, cameras, **change)


def test_views_that_share_nothing_are_said(ring):
    cameras, images, _, _ = ring
    with pytest.raises(ReconstructionError, match="65 degrees"):
        mvcore.reconstruct([images[0], images[4], images[8]], [cameras[0], cameras[4], cameras[8]], bounds=[[-1] * 3, [1] * 3])
    kept = [0, 1, 2, 3, 7]
    found = mvcore.reconstruct([images[i] for i in kept], [cameras[i] for i in kept], bounds=[[-0.7] * 3, [0.7] * 3])
    assert found.report["left_out"] == [4]
    assert any("view 4" in w for w in found.warnings)


def test_disparity_of_a_synthetic_pair_and_its_errors():
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (90, 200), np.uint8), (0, 0), 1.2)
    right = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    x, y = np.meshgrid(np.arange(200, dtype=np.float32), np.arange(90, dtype=np.float32))
    truth = (6 + 0.03 * x).astype(np.float32)
    left = cv2.remap(right, x - truth, y, cv2.INTER_CUBIC)
    found, confidence = mvcore.disparity(left, right, max_disparity=20)
    inner = np.s_[6:-6, 30:-8]
    assert np.median(np.abs(found - truth)[inner]) < 0.1
    assert (np.abs(found - truth)[inner] < 1).mean() > 0.97
    assert confidence.min() >= 0
    with pytest.raises(InvalidInputError, match="right"):
        mvcore.disparity(left, right[:, :-1], max_disparity=20)
    with pytest.raises(InvalidInputError, match="max_disparity"):
        mvcore.disparity(left, right, max_disparity=0)


def test_slanted_surfaces_go_on_where_one_image_alone_shows_them():
    rng = np.random.default_rng(4)
    guide = rng.integers(0, 80, (60, 120, 3), np.uint8)
    guide[:, 70:] += 150
    x = np.arange(120, dtype=np.float32)
    # A slanted wall, and before it from column 70 on a box that hides the wall to its left.
    truth = np.broadcast_to(np.where(x < 70, 8 + 0.1 * x, 40), (60, 120)).astype(np.float32)
    seen = np.broadcast_to((x >= 24) & ((x < 50) | (x >= 70)), truth.shape)
    found = continued(np.where(seen, truth, 1).astype(np.float32), seen, guide, 0, 64)
    assert np.array_equal(found[seen], truth[seen])
    assert np.abs(found - truth).max() < 0.3
    nothing = np.zeros_like(seen)
    assert np.array_equal(continued(np.full_like(truth, 3), nothing, guide, 0, 64), np.full_like(truth, 3))
    # Slopes end at the range, and pictures narrower than a slope's reach have none.
    assert continued(np.where(seen, truth, 1).astype(np.float32), seen, guide, 10, 64).min() == 10
    narrow = np.zeros((4, 9), bool)
    narrow[:, 4:] = True
    assert np.array_equal(continued(np.full((4, 9), 2, np.float32), narrow, guide[:4, :9], 0, 64), np.full((4, 9), 2, np.float32))


def test_disparity_outside_the_right_image_follows_a_slanted_wall():
    rng = np.random.default_rng(7)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (120, 260), np.uint8), (0, 0), 1.2)
    right = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    x, y = np.meshgrid(np.arange(260, dtype=np.float32), np.arange(120, dtype=np.float32))
    truth = (46 - 0.15 * x).astype(np.float32)
    left = cv2.remap(right, x - truth, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    found, confidence = mvcore.disparity(left, right, max_disparity=64)
    outside = (x < truth - 2) & (y > 5) & (y < 114)
    assert np.median(np.abs(found - truth)[outside]) < 1
    assert (confidence[outside] < 0.5).all()


def test_middlebury_is_no_worse_than_opencv_and_confidence_tells_what_is_wrong(shared):
    sets = shared / "middlebury-stereo"
    ours, theirs, told = [], [], []
    for name, left, right, true, scale, most in (
        ("cone", "im2.png", "im6.png", "disp2.png", 4, 64),
        ("teddy", "im2.png", "im6.png", "disp2.pgm", 4, 64),
    ):
        read = lambda n, kind: cv2.imread(str(sets / name / n), kind)  # noqa: B023, E731
        a, b = read(left, cv2.IMREAD_COLOR), read(right, cv2.IMREAD_COLOR)
        truth = read(true, cv2.IMREAD_GRAYSCALE).astype(np.float32) / scale
        found, confidence = mvcore.disparity(a[..., ::-1].copy(), b[..., ::-1].copy(), max_disparity=most)
        wrong = (np.abs(found - truth) > 2)[truth > 0]
        doubtful = confidence[truth > 0] <= np.quantile(confidence[truth > 0], 0.1)
        told.append(wrong[doubtful].sum() / wrong.sum())
        peer = cv2.StereoSGBM_create(0, most, 5, 8 * 75, 32 * 75, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH).compute(a, b) / 16
        ours.append(metrics.disparity_metrics(found, truth)["bad_2"])
        theirs.append(metrics.disparity_metrics(peer, truth)["bad_2"])
    assert np.mean(ours) <= np.mean(theirs)
    assert min(told) > 1 / 3


def test_commands(ring, tmp_path):
    cameras, images, _, masks = ring
    folder = write_scene(tmp_path / "scene", cameras, images)
    (folder / "masks").mkdir()
    for n, m in enumerate(masks):
        cv2.imwrite(str(folder / "masks" / f"{n:03d}.png"), (m * 255).astype(np.uint8))
    run = CliRunner().invoke
    out = run(app, ["reconstruct", str(folder), "-o", str(tmp_path / "a.glb"), "--exclude", "3", "--masks", str(folder / "masks"),
                    "--report", str(tmp_path / "r.json"), "--save-depth", str(tmp_path / "d"), "--closed"])  # fmt: skip
    assert out.exit_code == 0, out.output
    report = json.loads((tmp_path / "r.json").read_text())
    assert 3 not in report["view_numbers"]
    assert report["peak_memory_mib"] > 0
    assert report["config"]["surface"]["unseen_reach"] is None
    assert (tmp_path / "a.glb").stat().st_size > 10_000
    out = run(app, ["info", str(folder)])
    assert out.exit_code == 0
    assert "12 views of 240 x 180" in out.output
    assert "target box" in out.output
    assert run(app, ["convert", str(folder), str(tmp_path / "colmap")]).exit_code == 0
    assert (tmp_path / "colmap" / "images.txt").is_file()
    mesh = trimesh.creation.icosphere(4, 0.5)
    mesh.export(tmp_path / "truth.ply")
    out = run(app, ["eval", str(tmp_path / "a.glb"), str(tmp_path / "truth.ply"), "--thresholds", "0.02", "--samples", "20000"])
    assert json.loads(out.output)["at 0.02"]["precision"] > 0.9


@pytest.mark.parametrize(
    "arguments",
    [
        ["reconstruct", "nowhere", "-o", "a.glb"],
        ["reconstruct", ".", "-o", "a.stl"],
        ["info", "nowhere"],
        ["disparity", "a.png", "b.png", "-o", "d.pfm", "--max-disparity", "4"],
        ["eval", "a.ply", "b.ply", "--thresholds", "0.1"],
    ],
)
def test_errors_are_one_line_with_exit_code_2(arguments, tmp_path):
    command = [sys.executable, "-m", "mvcore.cli.main", *arguments]
    out = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert out.returncode == 2
    assert len(out.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_the_sample_is_whole(sample):
    scene = mvcore.load(sample)
    assert len(scene) == 16
    assert scene.masks is not None
