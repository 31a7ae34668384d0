"""The task graph: content keys, resuming, lost and damaged results, the same bytes through every entry point."""

import ast
import contextlib
import hashlib
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import mvcore
import numpy as np
import pytest
from conftest import render_target, rig, turned, write_scene
from hypothesis import given
from hypothesis import strategies as st
from mvcore import ReconstructionError
from mvcore.geometry.local_frame import LocalFrame
from mvcore.io import load_video
from mvcore.pipeline.build import build, contents
from mvcore.pipeline.cache import Cache
from mvcore.pipeline.executors import open_pool
from mvcore.pipeline.stages import Findings
from mvcore.pipeline.tasks import ATTEMPTS, Ledger, Place, Runner, task
from mvcore.pipeline.values import pack, unpack
from mvcore.types import DepthMap

PACKAGE = Path(mvcore.__file__).parent
POSE = turned(4.0, (0.05, -0.03, 0.02))
SETTINGS = {"texture": {"least_patch": 8}, "depth": {"planes": 48}, "volume": {"footprints": 1.8}}

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda x: st.lists(x) | st.dictionaries(st.text(), x) | st.tuples(x, x),
    max_leaves=8,
)


@given(plain, st.integers(0, 5))
def test_values_survive_packing(value, n):
    arrays, tree = pack([value, np.arange(n, dtype=np.float32), DepthMap(np.ones((n, 2)), np.zeros(n))])
    back, array, depth = unpack(arrays, tree)
    assert back == value
    assert array.dtype == np.float32
    assert (depth.depth == 1).all()
    assert isinstance(depth, DepthMap)


def test_only_own_classes_are_unpacked():
    with pytest.raises(ValueError, match="not a class of this package"):
        unpack({}, {"class": "subprocess:Popen", "fields": [["args", "true"]]})
    with pytest.raises(ValueError, match="not a dataclass"):
        unpack({}, {"class": "mvcore.pipeline.values:pack", "fields": []})
    with pytest.raises(TypeError, match="got object"):
        pack(object())


COUNTS: dict[str, int] = {}


def source(name: str, n: int) -> np.ndarray:
    COUNTS[name] = COUNTS.get(name, 0) + 1
    return np.full(1000, n)


def total(parts) -> int:
    COUNTS["total"] = COUNTS.get("total", 0) + 1
    return int(sum(parts[k].sum() for k in range(len(parts))))


def failing(_part) -> None:
    raise ValueError("no result")


@pytest.fixture
def runner(tmp_path):
    COUNTS.clear()
    with Runner(Place(tmp_path, 1 << 20, True), None, 2) as found:
        yield found


def test_each_task_runs_once_and_errors_arrive(runner):
    parts = [task(source, "a", 1), task(source, "b", 2)]
    ledger = Ledger()
    assert runner.value(task(total, [*parts, *parts]), ledger) == 6000
    assert runner.value(task(total, [*parts, *parts]), ledger) == 6000
    assert COUNTS == {"a": 1, "b": 1, "total": 1}
    assert ledger.run == 3
    with pytest.raises(ValueError, match="no result"):
        runner.value(task(total, [task(failing, parts[0])]), ledger)


def test_a_result_that_is_there_needs_no_inputs(tmp_path):
    COUNTS.clear()
    wanted = task(total, [task(source, "a", 1), task(source, "b", 2)])
    for _ in range(2):
        with Runner(Place(tmp_path, 1 << 20, True), None, 2) as runner:
            assert runner.value(wanted, Ledger()) == 3000
            runner.drop(wanted.inputs())
    assert COUNTS == {"a": 1, "b": 1, "total": 1}


def test_what_vanishes_or_is_damaged_is_made_again(tmp_path):
    COUNTS.clear()
    parts = [task(source, "a", 1), task(source, "b", 2)]
    place = Place(tmp_path, 0, True)  # nothing stays in memory
    with Runner(place, None, 2) as runner:
        for one in parts:
            runner.value(one, Ledger())
        runner.cache.store.path(parts[0].key).unlink()
        path = runner.cache.store.path(parts[1].key)
        path.write_bytes(path.read_bytes()[:-40])
        assert runner.value(task(total, parts), Ledger()) == 3000
    assert COUNTS["a"] == 2
    assert COUNTS["b"] == 2


def test_values_beyond_the_budget_go_to_disk_and_come_back(tmp_path):
    cache = Cache(tmp_path, 20_000, through=False)
    for n in range(10):
        cache.put(f"{n:040d}", np.full(1000, n))
    assert 0 < len(list(tmp_path.rglob("*.*"))) < 10
    assert all(cache.get(f"{n:040d}")[0] == n for n in range(10))


def test_keys_tell_different_work_apart():
    keys = {
        task(source, "a", 1).key,
        task(source, "a", 2).key,
        task(total, [task(source, "a", 1)]).key,
        task(total, [task(source, "a", 2)]).key,
        task(failing, task(source, "a", 1)).key,
    }
    assert len(keys) == 5
    assert task(source, "a", 1).key == task(source, "a", 1).key


def test_each_stage_is_defined_once():
    stages = ast.parse((PACKAGE / "pipeline" / "stages.py").read_text())
    names = {n.name for n in stages.body if isinstance(n, ast.FunctionDef) and not n.name.startswith("_")}
    for path in (*PACKAGE.glob("pipeline/*.py"), *PACKAGE.glob("video/*.py")):
        if path.name != "stages.py":
            own = {n.name for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)}
            assert not own & names, path


def test_no_stage_reads_a_report():
    """Lower functions may write into a report of their own; what they wrote is returned."""
    source = (PACKAGE / "pipeline" / "stages.py").read_text()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_") and node.name != "of":
            assert "report" not in {a.arg for a in node.args.args}, node.name


# ---- the same bytes


@pytest.fixture(scope="module")
def scene():
    """Eight views of a target, near enough to each other for stereo."""
    cameras = [replace(c, name=f"cam{n:02d}") for n, c in enumerate(rig(12, (96, 72))[:8])]
    frames, masks = zip(*(render_target(c, POSE) for c in cameras))
    return cameras, list(frames), list(masks)


def glb(result, path: Path) -> bytes:
    result.save(path)
    return path.read_bytes()


@pytest.fixture(scope="module")
def expected(scene, tmp_path_factory):
    cameras, frames, masks = scene
    return glb(mvcore.reconstruct(frames, cameras, masks=masks, config=SETTINGS), tmp_path_factory.mktemp("e") / "a.glb")


def test_photographs_are_a_clip_of_one_frame(scene, expected, tmp_path):
    cameras, frames, masks = scene
    clips = {c.name: f[None] for c, f in zip(cameras, frames)}
    cut = {c.name: m[None] for c, m in zip(cameras, masks)}
    (result,) = mvcore.reconstruct_video(load_video(clips, cameras), masks=cut, config=SETTINGS)
    assert glb(result, tmp_path / "a.glb") == expected
    photographs = mvcore.reconstruct(frames, cameras, masks=masks, config=SETTINGS)
    assert set(photographs.report) | {"instant", "time", "targets"} == set(result.report)


def test_an_executor_and_a_workdir_give_the_same_bytes(scene, expected, tmp_path):
    cameras, frames, masks = scene
    with ThreadPoolExecutor(3) as executor:
        result = mvcore.reconstruct(frames, cameras, masks=masks, config=SETTINGS, executor=executor, workdir=tmp_path / "w")
    assert glb(result, tmp_path / "a.glb") == expected
    assert result.report["tasks"]["run"] > 20
    again = mvcore.reconstruct(frames, cameras, masks=masks, config=SETTINGS, workdir=tmp_path / "w")
    assert again.report["tasks"]["run"] == 0
    assert glb(again, tmp_path / "b.glb") == expected
    # Another texture keeps the depth maps.
    other = mvcore.reconstruct(frames, cameras, masks=masks, config=SETTINGS | {"texture": {"seam": 2.0}}, workdir=tmp_path / "w")
    assert other.report["tasks"]["run"] == 1


def test_little_memory_gives_the_same_bytes(scene, expected, tmp_path):
    cameras, frames, masks = scene
    result = mvcore.reconstruct(frames, cameras, masks=masks, config=SETTINGS, max_memory=160 << 20)
    assert glb(result, tmp_path / "a.glb") == expected
    with pytest.raises(mvcore.InvalidInputError, match=r"max_memory: expected at least \d+ MiB"):
        mvcore.reconstruct(frames, cameras, masks=masks, max_memory=1000)


SCRIPT = """
import sys, mvcore
scene = mvcore.load(sys.argv[1])
result = mvcore.reconstruct(scene, masks=sys.argv[1] + "/masks", config=eval(sys.argv[3]), workdir=sys.argv[2] + "/work")
result.save(sys.argv[2] + "/a.glb")
print(result.report["tasks"]["run"])
"""


def store_digests(folder: Path) -> dict[str, str]:
    found = {}
    for parent, folders, names in os.walk(folder):
        folders[:] = [f for f in folders if not f.startswith(".")]  # what is being written
        for name in (n for n in names if len(Path(n).stem) == 40):
            with contextlib.suppress(FileNotFoundError):  # dropped meanwhile
                found[name] = hashlib.sha256(Path(parent, name).read_bytes()).hexdigest()
    return found


def test_killed_photographs_go_on_and_end_with_the_same_bytes(scene, tmp_path):
    import cv2

    cameras, frames, masks = scene
    write_scene(tmp_path / "s", cameras, frames)
    (tmp_path / "s" / "masks").mkdir()
    for n, mask in enumerate(masks):
        cv2.imwrite(str(tmp_path / "s" / "masks" / f"{n:03d}.png"), mask.astype(np.uint8) * 255)

    def start(out: Path, threads: str) -> subprocess.Popen:
        out.mkdir(exist_ok=True)
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / "s"), str(out), repr(SETTINGS)]
        env = os.environ | {"RAYON_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env)

    def finish(process: subprocess.Popen) -> int:
        text, _ = process.communicate(timeout=600)
        assert process.returncode == 0
        return int(text)

    whole = finish(start(tmp_path / "whole", "2"))
    rng = np.random.default_rng(1)
    out, kills, seen = tmp_path / "killed", 0, set()
    for _ in range(10):
        process = start(out, "1")
        wanted = len(seen) + int(rng.integers(1, 5))
        while process.poll() is None and len(seen) < wanted:
            seen |= store_digests(out).keys()  # intermediate results come and go
            time.sleep(0.02)
        time.sleep(float(rng.uniform(0, 0.2)))
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            kills += 1
        process.wait()
    done = finish(start(out, "1"))
    assert kills >= 3
    assert done < whole
    assert (out / "a.glb").read_bytes() == (tmp_path / "whole" / "a.glb").read_bytes()
    # Every task's result is the same for one thread and two, in parts and at once.
    one, two = store_digests(tmp_path / "whole" / "work"), store_digests(tmp_path / "killed" / "work")
    assert len(one) > 20
    assert {k: v for k, v in one.items() if k in two} == {k: v for k, v in two.items() if k in one}


# ---- absolute coordinates


@pytest.mark.parametrize("offset", [(5e5, 5.4e6, 120.0), (4.1e6, 6.5e5, 4.8e6)])
def test_absolute_coordinates_lose_nothing(scene, offset):
    cameras, frames, masks = scene
    here = mvcore.reconstruct(frames, cameras, masks=masks, config=SETTINGS)
    shift = np.array(offset)
    moved = [replace(c, t=-c.R @ (c.center + shift)) for c in cameras]
    there = mvcore.reconstruct(frames, moved, masks=masks, config=SETTINGS)
    size = float(np.ptp(here.vertices, axis=0).max())
    assert len(here.faces) == len(there.faces)
    assert np.abs(there.vertices - shift - here.vertices).max() < 1e-6 * size
    assert np.abs(there.bounds - shift - here.bounds).max() < 1e-6 * size
    assert np.allclose(there.cameras[0].t, moved[0].t)


def test_a_mirrored_world_gives_the_mirrored_mesh(scene):
    cameras, frames, masks = scene
    box = np.array([[-0.6, -0.6, -0.6], [0.6, 0.6, 0.7]])
    here = mvcore.reconstruct(frames, cameras, masks=masks, bounds=box, config=SETTINGS)
    mirrored = mvcore.Calibration(tuple(cameras), mirrored=True)
    box[:, 2] = -box[::-1, 2]
    there = mvcore.reconstruct(frames, mirrored, masks=masks, bounds=box, config=SETTINGS)
    assert (there.vertices == here.vertices * [1, 1, -1]).all()
    assert (there.faces == here.faces[:, ::-1]).all()  # counter-clockwise from outside again
    assert (there.bounds[:, :2] == here.bounds[:, :2]).all()
    assert (there.bounds[:, 2] == -here.bounds[::-1, 2]).all()
    assert there.mesh.volume > 0
    assert there.cameras.mirrored


@given(st.floats(-180, 180), st.tuples(*[st.floats(-1e6, 1e6)] * 3), st.booleans())
def test_a_pose_of_the_local_frame_is_one_of_the_world(angle, origin, mirrored):
    frame, pose = LocalFrame(np.array(origin), mirrored), turned(angle, (0.3, -0.2, 0.1))
    x = np.array([0.5, 1.0, -2.0])
    world = frame.pose(pose) @ np.append(frame.world(x), 1)
    assert np.allclose(world[:3], frame.world(pose[:3, :3] @ x + pose[:3, 3]), atol=1e-8)


def test_findings_are_plain_values():
    assert pack(Findings({"a": 1.5}, ["b"]))[0] == {}


# ---- warnings, and the build of the package


def doubtful(n: int) -> Findings:
    return Findings({}, ["the images are dark", f"view {n} is left out"])


def test_warnings_are_logged_when_a_task_is_done_and_once_a_run(tmp_path, caplog):
    said = ["the images are dark", "view 1 is left out", "view 2 is left out"]
    for _ in range(2):  # the second time from the store
        caplog.clear()
        with Runner(Place(tmp_path, 0, True), None, 1) as runner:
            runner.start(task(doubtful, 1), Ledger()).result()
            assert [r.getMessage() for r in caplog.records] == said[:2]
            runner.value(task(doubtful, 2), Ledger())
            runner.value(task(doubtful, 1), Ledger())
        assert [r.getMessage() for r in caplog.records] == said
        assert {r.name for r in caplog.records} == {"mvcore"}


def test_warnings_of_other_processes_are_logged_here(tmp_path, caplog):
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor,
        open_pool(executor) as pool,
        Runner(Place(tmp_path, 0, True), pool, 2) as runner,
    ):
        runner.start(task(doubtful, 1), Ledger()).result()
        assert caplog.messages == ["the images are dark", "view 1 is left out"]
        # An array of an input that is damaged is found where it is read.
        caplog.clear()
        part = task(np.ones, 3000)
        runner.start(part, Ledger()).result()
        path = runner.cache.store.path(part.key)
        path.write_bytes(path.read_bytes()[:-1] + b"x")
        assert runner.value(task(np.sum, part), Ledger()) == 3000.0
        assert caplog.messages == [
            f"{path}: this stored result is damaged, an array does not have its digest; it is removed and computed again"
        ]


def test_results_of_another_build_are_not_taken(tmp_path, monkeypatch):
    before = task(source, "a", 1).key
    monkeypatch.setattr("mvcore.pipeline.tasks.build", lambda: "another")
    assert task(source, "a", 1).key != before
    with (
        Runner(Place(tmp_path, 0, True, "that of the caller"), None, 1) as runner,
        pytest.raises(ReconstructionError, match="the same mvcore"),
    ):
        runner.value(task(source, "a", 1), Ledger())


def test_a_build_is_told_by_what_results_depend_on(tmp_path):
    for name in ("pipeline/stages.py", "network/a.safetensors", "cli/app.py", "network/training/train.py", "py.typed"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
    before = contents(tmp_path)
    assert sorted(before) == ["network/a.safetensors", "pipeline/stages.py"]
    (tmp_path / "pipeline" / "stages.py").write_text("2")
    assert contents(tmp_path)["pipeline/stages.py"] != before["pipeline/stages.py"]
    assert len(build()) == 40
    assert build() == build()


def test_many_damaged_inputs_of_damaged_inputs_are_made_again(tmp_path, caplog):
    """More of them than attempts, each found when it is read alone."""
    COUNTS.clear()
    parts = [task(source, f"{n}", n) for n in range(2 * ATTEMPTS)]
    middle = [task(total, [p, q]) for p, q in pairwise(parts)]
    wanted = task(summed, middle)
    with Runner(Place(tmp_path, 0, True), None, 2) as runner:
        right = runner.value(wanted, Ledger())
    paths = [Cache(tmp_path, 0, True).store.path(t.key) for t in (*parts, *middle, wanted)]
    for path in paths:
        data = bytearray(path.read_bytes())
        data[-2 if path.stat().st_size > 1000 else 90] ^= 1
        path.write_bytes(data)
    with Runner(Place(tmp_path, 0, True), None, 2) as runner:
        assert runner.value(wanted, Ledger()) == right
    assert all(COUNTS[f"{n}"] == 2 for n in range(2 * ATTEMPTS))
    assert all(str(path) in caplog.text for path in paths)


def summed(parts) -> int:
    return sum(parts[k] for k in range(len(parts)))
