import numpy as np
import pytest
import trimesh
from mvcore import FormatError, InvalidInputError
from mvcore.evaluation import metrics


def square(z=0.0):
    return np.array([[-1, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]], float), np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def test_a_shifted_plane():
    out = metrics.mesh_metrics(square(0.03), square(), [0.02, 0.04], samples=200_000)
    assert abs(out["accuracy"] - 0.03) < 0.001
    assert abs(out["overall"] - 0.03) < 0.001
    assert out["at 0.02"]["f_score"] == 0
    assert out["at 0.04"]["f_score"] > 0.999


def test_only_what_is_visible_counts():
    rng = np.random.default_rng(0)
    seen = np.column_stack([rng.uniform(-1, 0, 20_000), rng.uniform(-1, 1, 20_000), np.zeros(20_000)])
    half = square()[0] * [0.5, 1, 1] - [0.5, 0, 0], square()[1]
    out = metrics.mesh_metrics(half, square(), [0.02], visible=seen, samples=100_000)
    assert out["at 0.02"]["f_score"] > 0.99
    assert metrics.mesh_metrics(half, square(), [0.02], samples=100_000)["at 0.02"]["recall"] < 0.55


def test_distances_equal_scipy_like_brute_force():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(200, 3)), rng.normal(size=(300, 3))
    brute = np.linalg.norm(a[:, None] - b[None], axis=2).min(1)
    assert np.allclose(metrics.nearest_distance(a, b), brute)
    assert np.isinf(metrics.nearest_distance(a, np.zeros((0, 3)))).all()


def test_depth_and_disparity_figures():
    truth = np.random.default_rng(0).uniform(1, 5, (60, 80))
    result = truth * 1.015
    result[:15] = 0
    d = metrics.depth_metrics(result, truth)
    assert d["coverage"] == 0.75
    assert abs(d["abs_rel"] - 0.015) < 1e-12
    assert d["within_1_percent"] == 0
    assert d["within_2_percent"] == 0.75
    p = metrics.disparity_metrics(truth * 10 + 2.5, truth * 10)
    assert abs(p["epe"] - 2.5) < 1e-9
    assert p["bad_2"] == 1
    assert p["bad_4"] == 0
    with pytest.raises(InvalidInputError, match="result"):
        metrics.depth_metrics(result[1:], truth)


def test_ssim_of_a_picture_with_itself_is_one():
    picture = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    assert np.allclose(metrics.ssim(picture, picture), 1)
    assert metrics.ssim(picture, 255 - picture).mean() < 0


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_geometry_from_files(tmp_path, suffix):
    mesh = trimesh.creation.icosphere(2)
    mesh.export(tmp_path / f"a{suffix}")
    vertices, faces = metrics.load_geometry(tmp_path / f"a{suffix}")
    assert len(faces) == len(mesh.faces)
    assert np.allclose(np.linalg.norm(vertices, axis=1), 1, atol=1e-5)


def test_files_that_are_no_mesh(tmp_path):
    (tmp_path / "a.obj").write_text("f 1 2 3\n")
    with pytest.raises(FormatError, match=r"a\.obj"):
        metrics.load_geometry(tmp_path / "a.obj")
    with pytest.raises(FileNotFoundError):
        metrics.load_geometry(tmp_path / "b.ply")
