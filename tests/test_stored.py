"""Stored work that can be trusted: runs on a cluster that loses workers, side by side, on damaged results."""

import contextlib
import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import mvcore
import numpy as np
import pytest
from conftest import Network, render_target, rig, turned, write_scene
from mvcore.io import load_video
from mvcore.pipeline.cache import Cache, Missing
from mvcore.pipeline.store import Store
from mvcore.pipeline.values import pack

FLIPS = int(os.environ.get("MVCORE_FLIPS", "400"))
"""Bits turned over in the results of a finished run; there are a hundredth as many damaged runs."""
SETTINGS = {"texture": {"least_patch": 8}, "depth": {"planes": 32}, "volume": {"footprints": 2.5}}
OTHERS = SETTINGS | {"depth": {"planes": 48}, "texture": {"seam": 2.0}}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder of eight small photographs, near enough for stereo, with masks beside them."""
    folder = tmp_path_factory.mktemp("photographs")
    cameras = [replace(c, name=f"cam{n:02d}") for n, c in enumerate(rig(12, (80, 60))[:8])]
    frames, masks = zip(*(render_target(c, turned(4.0, (0.05, -0.03, 0.02))) for c in cameras))
    write_scene(folder, cameras, frames)
    (folder / "masks").mkdir()
    for n, mask in enumerate(masks):
        cv2.imwrite(str(folder / "masks" / f"{n:03d}.png"), mask.astype(np.uint8) * 255)
    return folder


def photographs(scene: Path, out: Path, config=SETTINGS, **how) -> bytes:
    found = mvcore.load(scene)
    mvcore.reconstruct(found, masks=scene / "masks", config=config, **how).save(out)
    return out.read_bytes()


@pytest.fixture(scope="module")
def expected(scene, tmp_path_factory):
    """Of an undisturbed run in memory."""
    return photographs(scene, tmp_path_factory.mktemp("memory") / "a.glb")


def entries(folder: Path) -> list[Path]:
    return sorted(folder.glob("??/*.entry"))


@contextlib.contextmanager
def killing(worker: subprocess.Popen, workdir: Path, count: int):
    """Kills a worker as soon as there are so many results; it is an error if the run ends before."""
    over, killed = threading.Event(), threading.Event()

    def watch():
        while not over.wait(0.02):
            if len(entries(workdir)) >= count:
                worker.kill()
                killed.set()
                return

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
        assert killed.is_set()
        assert worker.wait(10) != 0
    finally:
        over.set()
        watcher.join()


# ---- lost workers


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_photographs_on_a_cluster_that_loses_a_worker(scene, expected, network: Network, tmp_path):
    workers = network.work(2)
    with killing(workers[0], tmp_path / "work", 30):
        found = photographs(scene, tmp_path / "a.glb", scheduler=network.address, workdir=tmp_path / "work")
    assert found == expected


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_a_real_instant_is_the_same_everywhere(shared, network: Network, tmp_path):
    truck = shared / "synthetic" / "truck-video"
    clips = load_video(truck, stop=1)
    settings = {"depth": {"max_image_size": 160, "planes": 32}, "texture": {"least_patch": 8}, "volume": {"footprints": 2.5}}
    names = [c.name for c in clips.clips]
    frames, masks = ([truck / kind / n / f"frame0000{end}" for n in names] for kind, end in (("images", ".jpg"), ("masks", ".png")))

    def still(**how):
        return mvcore.reconstruct(frames, clips.calib, masks=masks, config=settings, **how)

    def moving(**how):
        (found,) = mvcore.reconstruct_video(clips, masks=truck / "masks", config=settings, **how)
        return found

    def glb(found):
        found.save(tmp_path / "a.glb")
        return (tmp_path / "a.glb").read_bytes()

    memory = still()
    assert len(memory.faces) > 300
    assert glb(moving()) == glb(memory)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        assert glb(moving(executor=executor, workdir=tmp_path / "processes")) == glb(memory)
    workers = network.work(2)
    with killing(workers[0], tmp_path / "cluster", 30):
        lost = still(scheduler=network.address, workdir=tmp_path / "cluster")
    assert glb(lost) == glb(memory)
    again = still(workdir=tmp_path / "cluster")
    assert again.report["tasks"]["run"] == 0
    assert glb(again) == glb(memory)


# ---- two runs in one workdir

RUN = """
import sys, mvcore
scene, workdir, out, settings = sys.argv[1:]
found = mvcore.load(scene)
print("ready", flush=True)
sys.stdin.readline()
mvcore.reconstruct(found, masks=scene + "/masks", config=eval(settings), workdir=workdir).save(out)
"""


@pytest.mark.parametrize("settings", [(SETTINGS, SETTINGS), (SETTINGS, OTHERS)], ids=["same", "different"])
def test_runs_side_by_side_in_one_workdir(scene, expected, tmp_path, settings):
    command = [sys.executable, "-c", RUN, str(scene), str(tmp_path / "work")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    runs = [subprocess.Popen([*command, str(tmp_path / f"{n}.glb"), repr(s)], **pipes) for n, s in enumerate(settings)]
    for run in runs:
        assert run.stdout.readline() == "ready\n"
    for run in runs:
        run.stdin.write("\n")
        run.stdin.flush()
    for run in runs:
        _, errors = run.communicate(timeout=600)
        assert run.returncode == 0, errors
        assert "Traceback" not in errors
    for n, config in enumerate(settings):
        alone = expected if config is SETTINGS else photographs(scene, tmp_path / "alone.glb", config)
        assert (tmp_path / f"{n}.glb").read_bytes() == alone


# ---- damaged results


@pytest.fixture(scope="module")
def finished(scene, expected, tmp_path_factory):
    """The workdir of a finished run, with all results that the run had, intermediate ones as well."""
    folder = tmp_path_factory.mktemp("finished")
    with Store(folder / "work").lease():  # what another run may need is not dropped
        assert photographs(scene, folder / "a.glb", workdir=folder / "work") == expected
    found = entries(folder / "work")
    assert len(found) > 60
    return folder / "work", {p.stem: p.read_bytes() for p in found}


def plain(value):
    arrays, tree = pack(value)
    return tree, {n: (a.dtype, a.shape, a.tobytes()) for n, a in arrays.items()}


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """With one bit turned over, half of the time in the first kilobyte."""
    out, size = bytearray(data), 8 * len(data)
    bit = int(rng.integers(min(size, 8192) if rng.random() < 0.5 else size))
    out[bit // 8] ^= 1 << (bit % 8)
    return bytes(out)


def test_no_turned_bit_of_a_real_run_gives_a_wrong_result(finished, tmp_path, caplog):
    _, wholes = finished
    store, rng = Store(tmp_path), np.random.default_rng(11)
    keys, right, refused = sorted(wholes), {}, 0
    for n in range(FLIPS):
        key = keys[n % len(keys)]  # all of them in turn
        path = store.path(key)
        path.parent.mkdir(exist_ok=True)
        cache = Cache(tmp_path, 0, through=True)
        if key not in right:
            path.write_bytes(wholes[key])
            right[key] = plain(cache.get(key))
        path.write_bytes(flipped(wholes[key], rng))
        caplog.clear()
        try:
            found = plain(cache.get(key))
        except Missing:
            refused += 1
            assert str(path) in caplog.text
            assert not path.exists()
        else:  # between two arrays nothing is written
            assert found == right[key]
    assert refused > 0.9 * FLIPS


def damaged(path: Path, wholes: dict[str, bytes], rng: np.random.Generator) -> None:
    """Turned over, cut off, emptied, another result in its place, other bytes, gone, or a folder."""
    data, other = wholes[path.stem], wholes[sorted(wholes)[int(rng.integers(len(wholes)))]]
    cut, noise = int(rng.integers(len(data))), rng.integers(0, 256, len(data), np.uint8).tobytes()
    damages = [flipped(data, rng), data[:cut], b"", other, noise, data[:cut] + noise[cut:], data + b"\0", None, ...]
    damage = damages[int(rng.integers(len(damages)))]
    path.unlink()
    if damage is ...:
        path.mkdir()
    elif damage is not None:
        path.write_bytes(damage)


def test_runs_go_on_from_damaged_results(scene, expected, finished, tmp_path, caplog):
    _, wholes = finished
    rng, store = np.random.default_rng(12), Store(tmp_path / "work")
    for n in range(max(3, FLIPS // 100)):
        for key, data in wholes.items():
            path = store.path(key)
            path.parent.mkdir(exist_ok=True)
            if path.is_dir():
                path.rmdir()
            path.write_bytes(data)
        last = [k for k in wholes if str(store.load(k, ()).meta["value"]).startswith("{'class': 'mvcore.pipeline.stages:Textured'")]
        assert len(last) == 1
        share = (0.1, 0.5, 1.0)[n % 3]
        hit = {k for k in wholes if rng.random() < share} | set(last)
        for key in sorted(hit):
            damaged(store.path(key), wholes, rng)
        caplog.clear()
        assert photographs(scene, tmp_path / "a.glb", workdir=tmp_path / "work") == expected
        named = {Path(text.split(": ")[0]).stem for text in caplog.messages if "is damaged" in text}
        assert named <= hit
        assert share < 1 or len(named) > 0.3 * len(hit)


# ---- warnings


def test_a_command_shows_each_warning_once(scene, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    cv2.imwrite(str(folder / "masks" / "003.png"), np.zeros((60, 80), np.uint8))
    (tmp_path / "s.toml").write_text("texture.least_patch = 8\ndepth.planes = 32\nvolume.footprints = 2.5\n")
    command = [sys.executable, "-m", "mvcore.cli.main", "reconstruct", str(folder), "-o", str(tmp_path / "a.glb")]
    command += ["--masks", str(folder / "masks"), "--config", str(tmp_path / "s.toml"), "--workdir", str(tmp_path / "work")]
    for _ in range(2):  # the second time all results are there
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        said = [text for text in done.stderr.splitlines() if text.startswith("warning: ")]
        assert any("masks: 1 of 8 are empty (3)" in text for text in said)
        assert any("too few sure matches" in text for text in said)  # of a stage
        parts = [text.removeprefix("warning: ").removeprefix("masks: ") for text in said]
        assert len(parts) == len(set(parts))
