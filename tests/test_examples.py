"""The examples, the docstrings' examples and the README's code run."""

import doctest
import importlib
import re
import runpy
import subprocess
import sys

import cv2
import numpy as np
import pytest
from conftest import ROOT, rig, write_clips, write_scene

EXAMPLES = sorted(p for p in (ROOT / "examples").glob("*.py") if "nurbs" not in p.stem and "video" not in p.stem)


@pytest.fixture(scope="module")
def small(ring, tmp_path_factory):
    cameras, images, _, _ = ring
    return write_scene(tmp_path_factory.mktemp("small") / "scene", cameras[:6], images[:6])


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_an_example_runs(path, small, tmp_path):
    suffix = ".ply" if "step" in path.stem else ".glb"
    subprocess.run([sys.executable, str(path), str(small), str(tmp_path / f"a{suffix}")], check=True, capture_output=True)
    assert (tmp_path / f"a{suffix}").stat().st_size > 1000


def test_the_video_example_saves_its_instants(tmp_path):
    write_clips(tmp_path / "clips", rig(6, (120, 90)), [np.eye(4)] * 2)
    command = [sys.executable, str(ROOT / "examples" / "05_video.py"), str(tmp_path / "clips"), str(tmp_path / "out")]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert out.count("visual hull") == 2
    assert (tmp_path / "out" / "0001.glb").stat().st_size > 1000


def test_the_nurbs_example_draws_a_picture(tmp_path):
    command = [sys.executable, str(ROOT / "examples" / "03_nurbs.py"), str(tmp_path / "a.png")]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "within the tolerance" in out
    picture = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_GRAYSCALE)
    assert 0.1 < (picture < 250).mean() < 0.6
    assert (tmp_path / "nurbs.step").is_file()


def test_the_descent_example_gains_by_moving_knots(tmp_path):
    command = [sys.executable, str(ROOT / "examples" / "04_nurbs_descent.py"), str(tmp_path / "a.obj")]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    first, second = (float(x) for x in re.findall(r"distance ([\d.]+)", out))
    assert second < 0.7 * first
    assert (tmp_path / "a.obj").is_file()


DOCUMENTED = (
    "config",
    "depth.stereo",
    "geometry.cameras",
    "geometry.projections",
    "io.clips",
    "io.pairing",
    "io.selection",
    "mesh.surface",
    "pipeline.cluster",
    "pipeline.preflight",
    "pipeline.store",
    "silhouettes.visual_hull",
)


@pytest.mark.parametrize("module", DOCUMENTED)
def test_docstrings(module):
    result = doctest.testmod(importlib.import_module(f"mvcore.{module}"), extraglobs={"np": np})
    assert result.attempted > 0
    assert result.failed == 0


def test_the_readme_code(small, tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 3
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fountain").symlink_to(small)
    for n, block in enumerate(blocks):
        (tmp_path / f"block{n}.py").write_text(block)
        runpy.run_path(str(tmp_path / f"block{n}.py"))
    assert (tmp_path / "fountain.glb").is_file()
