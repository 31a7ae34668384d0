"""Words of the command line, exit codes, what reaches the library."""

import json
import logging
import subprocess
import sys
from types import SimpleNamespace

import cv2
import mvcore.pipeline.reconstruct as pipeline
import numpy as np
import pytest
from conftest import rig, write_clips, write_scene
from mvcore.cli.main import app
from mvcore.io.selection import select_views
from typer.testing import CliRunner

GREY = np.full((120, 160, 3), 90, np.uint8)


def run(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("scene")
    write_scene(place, rig(6), [GREY] * 6)
    (place / "masks").mkdir()
    for n in range(6):
        cv2.imwrite(str(place / "masks" / f"{n:03d}.png"), cv2.circle(np.zeros((120, 160), np.uint8), (80, 60), 40, 255, -1))
    return place


@pytest.fixture
def calls(monkeypatch):
    """What `reconstruct` is called with, instead of running."""
    seen = []

    def fake(frames, calib, **arguments):
        seen.append(SimpleNamespace(frames=frames, calib=calib, **arguments))
        report = {"seconds": {"depth": {"wall": 1.0, "cpu": 2.0}}}
        return SimpleNamespace(
            report=report,
            warnings=["this was difficult"],
            faces=[1, 2],
            save=lambda path: path.write_bytes(b"mesh"),
            save_depth=lambda path: path.mkdir(),
            save_report=lambda path: path.write_text(json.dumps(report)),
        )

    monkeypatch.setattr(pipeline, "reconstruct", fake)
    return seen


def test_exit_codes(folder, tmp_path, calls, monkeypatch):
    done = run("reconstruct", folder, "-o", tmp_path / "a.glb")
    assert (done.exit_code, done.stdout) == (0, f"{tmp_path / 'a.glb'}: 2 faces from 6 views, 1 s (2 CPU seconds)\n")
    assert "warning: this was difficult" in done.stderr
    done = run("reconstruct", folder, "-o", tmp_path / "b.glb", "--strict")
    assert done.exit_code == 1
    assert (tmp_path / "b.glb").is_file()
    done = run("reconstruct", folder, "-o", tmp_path / "c.glb", "--quiet")
    assert (done.exit_code, done.output) == (0, "")
    assert "depth: 1.0 s" in run("-v", "reconstruct", folder, "-o", tmp_path / "c.glb").stderr
    monkeypatch.setattr(pipeline, "reconstruct", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    done = run("reconstruct", folder, "-o", tmp_path / "d.glb")
    assert (done.exit_code, done.stderr.splitlines()[-1]) == (130, "interrupted")
    monkeypatch.setattr(pipeline, "reconstruct", lambda *_, **__: {}["bug"])
    done = run("reconstruct", folder, "-o", tmp_path / "d.glb")
    assert done.exit_code == 2
    assert "internal error, KeyError" in done.stderr
    assert isinstance(run("reconstruct", folder, "-o", tmp_path / "d.glb", "--debug").exception, KeyError)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--foo"], "No such option: --foo"),
        (["--max-faces", "x"], "--max-faces"),
        (["--max-faces", "0"], "--max-faces: expected a whole number from 4"),
        (["--max-image-size", "3"], "--max-image-size: expected a whole number from 16"),
        (["--matcher", "magic"], "--matcher: expected one of sgm, dcnn, got 'magic'"),
        (["--device", "tpu"], "--device: expected one of cpu, cuda"),
        (["--max-memory", "lots"], "--max-memory: expected a size such as 4G"),
        (["--max-memory", "0"], "--max-memory: expected a size"),
        (["--jobs", "0"], "--jobs: expected a whole number from 1"),
        (["--bounds", "1,2"], "--bounds: expected 6 numbers, got 2"),
        (["--bounds", "1,2,3,0,0,0"], "--bounds: expected x0 < x1"),
        (["--bounds", "0,0,0,1,1,nan"], "--bounds: expected numbers"),
        (["--scheduler", "nowhere"], "--scheduler: expected an address"),
        (["--exclude", "9"], "--exclude: expected views 0 to 5, got 9"),
        (["--only", "left"], "--only: expected a view's name, pattern or number, got 'left'"),
        (["--exclude", "*"], "--only, --exclude: expected views to be left"),
        (["--masks", "nowhere"], "nowhere: no such folder of masks"),
        (["--config", "none.toml"], "none.toml: no such file of settings"),
        (["--images", "nowhere"], "nowhere"),
        (["--report", "/proc/none/r.json"], "/proc/none/r.json: expected a file that can be written"),
        (["--workdir", "/proc/none"], "/proc/none: expected a folder that can be written"),
        (["-o", "a.stl"], "--output: expected a name ending in .glb"),
        (["-o", "/proc/o.glb"], "/proc/o.glb: expected a file that can be written"),
    ],
)
def test_bad_words_cost_one_line_and_no_work(folder, tmp_path, calls, words, part):
    done = run("reconstruct", folder, *([] if "-o" in words else ["-o", tmp_path / "a.glb"]), *words)
    assert done.exit_code == 2
    lines = [x for x in done.stderr.splitlines() if "pass --masks" not in x]
    assert len(lines) == 1
    assert lines[0].startswith("mvcore: ")
    assert part.replace("--only, --exclude", "only") in lines[0].replace("--only, exclude", "only")
    assert not calls
    assert not list(tmp_path.iterdir())


def test_options_reach_the_library(folder, tmp_path, calls, monkeypatch):
    monkeypatch.setenv("RAYON_NUM_THREADS", "2")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    (tmp_path / "s.toml").write_text("[depth]\nplanes = 64\nmax_image_size = 100\n")
    words = ["--config", tmp_path / "s.toml", "--max-image-size", "120", "--closed", "--only", "0-3", "--exclude", "001", "--jobs", "3",
             "--workdir", tmp_path / "w", "--max-memory", "1.5G", "--masks", folder / "masks", "--bounds", "-1,-1,-1,1,1,1"]  # fmt: skip
    report, depth = tmp_path / "r.json", tmp_path / "d"
    done = run("reconstruct", folder, "-o", tmp_path / "a.glb", *words, "--report", report, "--save-depth", depth)
    assert done.exit_code == 0, done.output
    (call,) = calls
    assert [f.name for f in call.frames] == ["000.png", "002.png", "003.png"]
    assert [m.name for m in call.masks] == ["000.png", "002.png", "003.png"]
    assert (call.config.depth.planes, call.config.depth.max_image_size, call.config.surface.unseen_reach) == (64, 120, None)
    assert (call.workdir, call.max_memory, call.bounds) == (tmp_path / "w", 3 << 29, [-1, -1, -1, 1, 1, 1])
    assert call.executor._max_workers == 3
    assert json.loads(report.read_text())["view_numbers"] == [0, 2, 3]
    calls.clear()
    run("reconstruct", folder, "-o", tmp_path / "a.glb", "--scheduler", "tcp://host:8786")
    assert calls[0].scheduler.address == "tcp://host:8786"
    assert not hasattr(calls[0], "executor")
    assert calls[0].masks is None


def test_views_by_name_pattern_and_number():
    names = ["images/left.jpg", "images/right.jpg", "images/7/0.jpg", "images/cam10.jpg", "images/cam2.jpg"]
    assert select_views(names) == [0, 1, 2, 3, 4]
    assert select_views(names, only="left,cam*") == [0, 3, 4]
    assert select_views(names, only="1-3", exclude="2") == [1, 3]
    assert select_views(names, exclude="right.jpg, images/cam2.jpg") == [0, 2, 3]
    assert select_views(names, only="7") == [2]  # a name counts before a number
    with pytest.raises(ValueError, match="did you mean 'right'"):
        select_views(names, only="rigth")
    with pytest.raises(ValueError, match="expected views 0 to 4, got 3-9"):
        select_views(names, only="3-9")
    with pytest.raises(ValueError, match="expected views 0 to 4, got 3-1"):
        select_views(names, only="3-1")
    assert select_views(["", ""], exclude="0") == [1]


def test_what_the_library_logs_is_shown_once(folder, tmp_path, calls, monkeypatch):
    logger = logging.getLogger("mvcore")
    real = pipeline.reconstruct

    def noisy(*words, **arguments):
        logger.warning("this was difficult")
        logger.warning("the light changed")
        logger.info("a detail")
        return real(*words, **arguments)

    monkeypatch.setattr(pipeline, "reconstruct", noisy)
    done = run("reconstruct", folder, "-o", tmp_path / "a.glb", "-v")
    assert done.stderr.count("warning: this was difficult") == 1
    assert "warning: the light changed" in done.stderr
    assert "a detail" in done.stderr
    done = run("reconstruct", folder, "-o", tmp_path / "a.glb", "--quiet", "--strict")
    assert (done.exit_code, done.output) == (1, "")
    assert not [h for h in logger.handlers if type(h).__name__ == "_Logged"]


def test_check_prints_and_returns_what_it_finds(folder, tmp_path):
    done = run("check", folder, "--json", "--masks", folder / "masks", "-o", tmp_path / "a.glb")
    assert done.exit_code == 0, done.output
    values = json.loads(done.stdout)
    assert values["good"]
    assert values["outlook"]["views"] == 6
    done = run("check", folder, "-o", "/proc/none/a.glb")
    assert done.exit_code == 2
    assert "error: /proc/none/a.glb" in done.stdout
    done = run("check", folder, "--max-memory", "900T", "--strict")
    assert done.exit_code == 1
    assert "this can be reconstructed" in done.stdout
    assert run("check", tmp_path / "nowhere").exit_code == 2
    assert not list(tmp_path.iterdir())


def test_clips_and_images_are_told_apart(folder, tmp_path):
    write_clips(tmp_path, rig(3), [np.eye(4)] * 2)
    done = run("reconstruct", tmp_path, "-o", tmp_path / "a.glb")
    assert done.exit_code == 2
    assert "use 'mvcore video'" in done.stderr
    done = run("video", folder, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "use 'mvcore reconstruct'" in done.stderr
    for words, part in (
        (["--rotate", "45"], "rotation: expected auto, 0, 90, 180 or 270"),
        (["--target", "soft"], "--target: expected free or rigid"),
        (["--exclude", "cam07"], "exclude: expected a view's name"),
        (["-o", "/proc/out"], "/proc/out: expected a folder that can be written"),
    ):
        done = run("video", tmp_path, *([] if "-o" in words else ["-o", tmp_path / "out"]), *words)
        assert done.exit_code == 2
        assert part in done.stderr
    assert not (tmp_path / "out").exists()


def test_help_is_light_and_grouped():
    code = "import sys; from mvcore.cli.main import app; print([m for m in ('cv2', 'torch', 'trimesh', 'av') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    for command in ("reconstruct", "video"):
        text = run(command, "--help").output
        for group in ("Input", "Output", "Settings", "Running"):
            assert f" {group} " in text
        for option in ("--only", "--exclude", "--images", "--allow-outside", "--config", "--workdir", "--scheduler", "--masks", "--jobs"):
            assert option in text
    assert run("--version").stdout.startswith("mvcore ")
    assert run("nonsense").exit_code == 2
