import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import mvcore
import numpy as np
import pytest
from conftest import look_at, render_target, rig, turned, write_clips
from hypothesis import given
from hypothesis import strategies as st
from mvcore import InvalidInputError, ReconstructionError
from mvcore.cli.main import app
from mvcore.config import BackgroundConfig, VolumeConfig
from mvcore.geometry.registration import Cloud, find_poses
from mvcore.io import load_video
from mvcore.io.meshes import animated
from mvcore.mesh.hull_parts import find_targets, motions, moved, on_targets
from mvcore.mesh.surface import isosurface
from mvcore.pipeline.store import Store, digest
from mvcore.silhouettes.background_subtraction import Background, foreground, learn_backgrounds
from mvcore.silhouettes.visual_hull import Occupancy, carve_silhouettes, shadow
from mvcore.video.api import reconstruct_video
from mvcore.video.tracking import Tracker
from mvcore.video.writer import read_index
from mvcore.viewer.page import write_page
from mvcore.volume.photo_hull import visual_hull
from typer.testing import CliRunner

POSES = [turned(4.0 * t, (0.05 * t, -0.03 * t, 0.02 * t)) for t in range(4)]
SETTINGS = {"texture": {"least_patch": 8}, "video": {"segment": 2}, "volume": {"solid_smoothing": 0.7}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clip"), rig(12), POSES)


def errors(result, pose):
    """Distances of the mesh from the true surface of the balls at a pose."""
    from conftest import BALLS

    back = np.linalg.inv(pose)
    own = result.vertices @ back[:3, :3].T + back[:3, 3]
    return np.min([np.abs(np.linalg.norm(own - c, axis=1) - r) for c, r in BALLS], 0)


def tree_digest(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and "work" not in p.relative_to(folder).parts)
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def local(folder, tmp_path_factory):
    """The rigid run of the command, with its workdir."""
    out = tmp_path_factory.mktemp("out")
    run = reconstruct_video(load_video(folder), target="rigid", config=SETTINGS, workdir=out / "work")
    run.save(out)
    return out, run


def test_every_instant_and_the_whole_target(local, folder):
    out, run = local
    index = read_index(out)
    assert [i["instant"] for i in index["instants"]] == [0, 1, 2, 3]
    for n, pose in enumerate(POSES):
        import trimesh

        mesh = trimesh.load(out / f"instant{n:04d}.glb", force="mesh", process=False)
        away = errors(mesh, pose)
        assert np.median(away) < 0.008
        assert (away < 0.04).mean() > 0.97
    for found, true in zip(run.trajectory, POSES):
        off = found @ np.linalg.inv(true)
        assert np.linalg.norm(off[:3, 3]) < 0.01
        assert np.degrees(np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1))) < 1.5
    assert np.median(errors(run.model, np.eye(4))) < 0.01
    assert index["rigid"]["poses"][2] == run.trajectory[2].tolist()


def test_the_animated_file_moves_as_the_target_does(local):
    out, run = local
    data = (out / "animated.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + size])
    (animation,) = tree["animations"]
    body = data[20 + size + 8 :]

    def values(accessor, width):
        a = tree["accessors"][accessor]
        view = tree["bufferViews"][a["bufferView"]]
        return np.frombuffer(body, "<f4", a["count"] * width, view["byteOffset"]).reshape(-1, width)

    by_path = {c["target"]["path"]: animation["samplers"][c["sampler"]] for c in animation["channels"]}
    assert np.allclose(values(by_path["translation"]["output"], 3), run.trajectory[:, :3, 3], atol=1e-6)
    x, y, z, w = values(by_path["rotation"]["output"], 4)[3]
    r = run.trajectory[3]
    assert np.allclose([1 - 2 * (y * y + z * z), 2 * (x * y + z * w)], [r[0, 0], r[1, 0]], atol=1e-5)
    assert len(data) == struct.unpack_from("<I", data, 8)[0]
    with pytest.raises(mvcore.FormatError):
        animated(b"nonsense....", np.zeros(1), np.eye(4)[None])


def test_other_processes_give_the_same_bytes(local, folder, tmp_path):
    out, _ = local
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as executor:
        run = reconstruct_video(load_video(folder), target="rigid", config=SETTINGS, executor=executor, workdir=tmp_path / "work")
        run.save(tmp_path)
    assert tree_digest(tmp_path) == tree_digest(out)


SCRIPT = """
import sys
from mvcore.io import load_video
from mvcore.video.api import reconstruct_video
if __name__ == "__main__":
    folder, out, settings = sys.argv[1], sys.argv[2], eval(sys.argv[3])
    reconstruct_video(load_video(folder), target="rigid", config=settings, workdir=out + "/work").save(out)
"""


def test_a_killed_run_goes_on_and_ends_with_the_same_bytes(local, folder, tmp_path):
    out, _ = local
    script = tmp_path / "run.py"
    script.write_text(SCRIPT)
    target = tmp_path / "out"
    rng = np.random.default_rng(5)
    kills = 0
    for _ in range(40):
        process = subprocess.Popen([sys.executable, script, folder, target, repr(SETTINGS)], stderr=subprocess.DEVNULL)
        try:
            assert process.wait(rng.uniform(1.5, 5.0) if kills < 6 else 300) == 0
            break
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
    assert kills >= 2
    assert tree_digest(target) == tree_digest(out)


def test_a_finished_run_is_not_done_again(local, folder):
    out, _ = local
    stamps = {p: p.stat().st_mtime_ns for p in (out / "work").rglob("*.entry")}
    again = reconstruct_video(load_video(folder), target="rigid", config=SETTINGS, workdir=out / "work")
    assert len(list(again)) == 4
    assert {p: p.stat().st_mtime_ns for p in (out / "work").rglob("*.entry")} == stamps
    # Another setting is another result.
    other = reconstruct_video(load_video(folder, stop=1), config=SETTINGS | {"surface": {"max_faces": 500}}, workdir=out / "work")
    (result,) = other
    assert len(result.faces) <= 600
    assert set((out / "work").rglob("*.entry")) > set(stamps)


def test_a_real_cluster_gives_the_same_bytes_and_survives_a_lost_worker(local, folder, tmp_path):
    distributed = pytest.importorskip("distributed")
    out, _ = local
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--no-dashboard", "--nanny-port", "0"]
    with distributed.LocalCluster(n_workers=0, scheduler_port=0, dashboard_address=None, protocol="tcp") as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tcp://")
        workers = [
            subprocess.Popen([*command[:-2], "--no-nanny", address], env=env, cwd=tmp_path, stderr=subprocess.DEVNULL) for _ in range(2)
        ]
        try:
            with distributed.Client(address) as client:
                client.wait_for_workers(2, timeout=60)
            run = reconstruct_video(load_video(folder), target="rigid", config=SETTINGS, scheduler=address, workdir=tmp_path / "work")
            import threading

            def kill():
                while len(list((tmp_path / "work").rglob("*.entry"))) < 20:
                    time.sleep(0.05)
                workers[0].kill()

            killer = threading.Thread(target=kill)
            killer.start()
            run.save(tmp_path / "result")
            killer.join()
            assert workers[0].wait(10) != 0
        finally:
            for worker in workers:
                worker.kill()
                worker.wait()
    assert tree_digest(tmp_path / "result") == tree_digest(out)


def test_the_page_opens_in_a_browser_and_shows_the_mesh(local, tmp_path):
    out, _ = local
    page = write_page(out, tmp_path / "view.html")
    text = page.read_text()
    assert "http://" not in text.split("<script>")[0]
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    shot = tmp_path / "shot.png"
    flags = [
        "--headless=new",
        "--no-sandbox",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--hide-scrollbars",
    ]
    size = ["--window-size=1000,700", "--virtual-time-budget=8000", f"--user-data-dir={tmp_path / 'profile'}"]
    subprocess.run([browser, *flags, *size, f"--screenshot={shot}", page.as_uri()], check=True, timeout=120, stderr=subprocess.DEVNULL)
    picture = cv2.imread(str(shot))
    stage = picture[:600, :640].reshape(-1, 3).astype(int)
    background = np.median(stage, 0)
    shown = (np.abs(stage - background).max(1) > 12).mean()
    assert 0.03 < shown < 0.9
    assert stage[np.abs(stage - background).max(1) > 12].std() > 15  # textured, not one colour
    side = picture[60:, 680:].reshape(-1, 3)
    assert len(np.unique(side, axis=0)) > 500  # the depth maps


def test_the_commands(folder, tmp_path):
    runner = CliRunner()
    done = runner.invoke(app, ["video", str(folder), "-o", str(tmp_path / "o"), "--stop", "1", "--max-faces", "800"])
    assert done.exit_code == 0, done.output
    assert "1 instants of 12 cameras" in done.output
    assert runner.invoke(app, ["view", str(tmp_path / "o")]).exit_code == 0
    assert (tmp_path / "o" / "view.html").stat().st_size > 500_000
    wrong = runner.invoke(app, ["view", str(tmp_path)])
    assert wrong.exit_code == 2
    assert "index.json" in wrong.output
    wrong = runner.invoke(app, ["video", str(folder), "-o", str(tmp_path / "p"), "--target", "soft"])
    assert wrong.exit_code == 2
    assert "free or rigid" in wrong.output


def test_wide_cameras_carve_and_say_so(tmp_path):
    write_clips(tmp_path, rig(5), POSES[:1])
    (result,) = reconstruct_video(load_video(tmp_path))
    assert result.report["surface"] == "visual hull"
    assert any("too far for stereo" in w for w in result.warnings)
    assert np.median(errors(result, POSES[0])) < 0.06
    assert len(np.unique(result.texture.reshape(-1, 3), axis=0)) > 100


def test_an_instant_without_a_target_is_empty(tmp_path):
    write_clips(tmp_path, rig(12), [None, POSES[0]])
    empty, full = reconstruct_video(load_video(tmp_path), config=SETTINGS)
    assert len(empty.faces) == 0
    assert "no target" in empty.warnings[0]
    assert np.median(errors(full, POSES[0])) < 0.01


def test_equal_instants_in_several_chains_do_not_take_each_others_results_away():
    cameras = rig(12, (96, 72))
    frames = {f"c{n}": np.stack([render_target(c, POSES[0])[0]] * 12) for n, c in enumerate(cameras)}
    plates = {f"c{n}": render_target(c)[0] for n, c in enumerate(cameras)}
    settings = SETTINGS | {"video": {"segment": 3, "chains": 3}}
    found = list(reconstruct_video(load_video(frames, cameras, rates=25), background=plates, config=settings))
    assert len(found) == 12
    assert all(len(r.faces) for r in found)


def test_masks_bounds_and_calibration_may_be_given(folder):
    cameras = rig(12)
    masks = {f"cam{n:02d}": np.stack([render_target(c, p)[1] for p in POSES]) for n, c in enumerate(cameras)}
    clips = load_video(folder, stop=1)
    (result,) = reconstruct_video(clips, cameras, masks=masks, background=False, bounds=[[-0.6] * 3, [0.8] * 3], config=SETTINGS)
    assert np.median(errors(result, POSES[0])) < 0.008
    with pytest.raises(InvalidInputError, match="calib"):
        reconstruct_video(clips, cameras[:3])
    with pytest.raises(InvalidInputError, match="at least 4 frames"):
        reconstruct_video(load_video(folder), masks={k: v[:2] for k, v in masks.items()})
    with pytest.raises(InvalidInputError, match="one of them"):
        reconstruct_video(clips, executor=ProcessPoolExecutor(1), scheduler="tcp://x:1")
    with pytest.raises(ReconstructionError, match="two instants"):
        list(reconstruct_video(clips, target="rigid", config=SETTINGS))


def test_two_targets_are_two_meshes_that_keep_their_numbers(tmp_path):
    cameras = rig(12, (200, 150))
    # One goes round the other: left and right change places, and which hull is the larger one changes with the views.
    places = [(-0.5, 0.15 * t) for t in range(-1, 2)]
    for t, (x, y) in enumerate(places):
        apart = [turned(10 * t, (x, y, 0)), turned(0, (-x, -y, 0))]
        for n, c in enumerate(cameras):
            own = tmp_path / "images" / f"cam{n:02d}"
            own.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(own / f"frame{t}.png"), render_small(c, apart)[..., ::-1])
            if not t:
                cv2.imwrite(str(own / "background.png"), render_target(c)[0][..., ::-1])
    run = reconstruct_video(load_video(tmp_path, cameras), config=SETTINGS)
    run.save(tmp_path / "out")
    files = sorted(p.name for p in (tmp_path / "out").glob("*.glb"))
    assert files == [f"instant{t:04d}_target{k}.glb" for t in range(3) for k in range(2)]
    ways: dict[int, list[float]] = {}
    for instant in read_index(tmp_path / "out")["instants"]:
        for target in instant["report"]["targets"]:
            ways.setdefault(target["id"], []).append(target["middle"])
    assert sorted(ways) == [0, 1]
    for way in np.array([ways[0], ways[1]]):
        side = np.sign(way[0, 0])
        assert (np.sign(way[:, 0]) == side).all()  # each stays on its side
        assert (np.diff(-side * way[:, 1]) > 0.1).all()  # and goes its way


def test_targets_are_told_apart_by_their_ways():
    def target(x, y, volume=1.0):
        return {"middle": [x, y, 0.0], "box": [[x - 0.5, y - 0.5, -0.5], [x + 0.5, y + 0.5, 0.5]], "volume": volume}

    tracker = Tracker()
    # Two cross at a right angle, listed by size, which changes; a third comes later, and the first is hidden for an instant.
    seen = [
        [target(-1.2, 0), target(0, -1.0)],
        [target(0, -0.5, 1.1), target(-0.6, 0)],
        [target(0.0, 0.0), target(0.05, 0.02)],
        [target(0.6, 0), target(0, 0.5)],
        [target(0, 1.0), target(3, 3)],
        [target(3, 3), target(1.8, 0), target(0, 1.5)],
    ]
    named = [tracker.follow(t, found) for t, found in enumerate(seen)]
    assert [t["id"] for t in named[0]] == [0, 1]
    assert [t["id"] for t in named[1]] == [1, 0]
    assert [t["id"] for t in named[3]] == [0, 1]
    assert [t["id"] for t in named[4]] == [1, 2]
    assert [t["id"] for t in named[5]] == [2, 0, 1]


def test_phantoms_of_few_silhouettes_are_no_targets():
    # Two boxes and two cameras at a right angle: two more boxes throw the same shadows.
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 3, indexing="ij"), -1)

    def box(center, side):
        return (np.abs(x - center) < side).all(-1)

    real = box([-0.5, -0.5, 0], 0.22) | box([0.5, 0.5, 0], 0.21)
    cameras = [look_at((40, 0, 0), (0, 0, 0), (200, 150), 3000.0), look_at((0, 40, 0), (0, 0, 0), (200, 150), 3000.0)]
    masks = [shadow(Occupancy(np.full(3, -1.0), 0.05, real), c, 0.1) for c in cameras]
    hull = carve_silhouettes(masks, cameras, np.array([[-1.0] * 3, [1.0] * 3]), voxel=0.05, tolerance=0.0)
    targets, hulls = find_targets(hull, masks, cameras, 0.1)
    assert len(targets) == 2
    assert {tuple(np.sign(np.round(t["middle"], 1))) for t in targets} in ({(1, 1, 0), (-1, -1, 0)}, {(1, -1, 0), (-1, 1, 0)})
    surface = isosurface(visual_hull(masks, cameras, np.array([[-1.0] * 3, [1.0] * 3]), VolumeConfig(voxel=0.05)))
    kept = on_targets(surface, hulls)
    assert 0.4 * len(surface.faces) < len(kept.faces) < 0.6 * len(surface.faces)


def test_a_target_on_its_own_stands_apart_for_most_cameras():
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 3, indexing="ij"), -1)
    large, small = (np.abs(x) < 0.35).all(-1), (np.abs(x - (0.85, 0, 0)) < 0.12).all(-1)
    hull = Occupancy(np.full(3, -1.0), 0.05, large | small)

    def targets(*centers):
        cameras = [look_at(c, (0, 0, 0), (300, 200), 3000.0) for c in centers]
        return find_targets(hull, [shadow(hull, c, 0.1) for c in cameras], cameras, 0.01)[0]

    # Seen along x the small one is before or behind the large one.
    along, across = [(40, 0, 0), (-40, 0, 0)], [(0, 40, 0), (0, -40, 0), (0, 28, 28)]
    assert len(targets(*along, *across[:2])) == 1
    assert len(targets(*along, *across)) == 2
    assert len(targets(*across)) == 2


@given(st.floats(-8, 8), st.tuples(*[st.floats(-0.3, 0.3)] * 3))
def test_the_motion_of_a_hull_is_found(angle, shift):
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 3, indexing="ij"), -1)
    full = (np.abs(x) < [0.8, 0.4, 0.3]).all(-1) | (np.abs(x - [0.4, 0, 0.5]) < [0.2, 0.3, 0.3]).all(-1)
    hull = Occupancy(np.full(3, -1.0), 0.05, full)
    camera = rig(1)[0]
    targets, hulls = find_targets(hull, [shadow(hull, camera)], [camera], 0.1)
    assert len(targets) == 1
    pose = turned(angle, shift)
    points = hulls.vertices @ pose[:3, :3].T + pose[:3, 3]
    after = [{**targets[0], "middle": points.mean(0).tolist()}]
    found = motions(targets, after, hulls, replace(hulls, vertices=points))
    assert np.abs(moved(hulls.vertices, found, hulls) - points).max() < 0.02


def render_small(camera, poses):
    """Two targets a third the size."""
    image = render_target(camera)[0].copy()
    order = sorted(poses, key=lambda p: -np.linalg.norm(camera.center - p[:3, 3]))
    for pose in order:
        small = pose.copy()
        small[:3, 3] = 2.2 * pose[:3, 3]
        far = mvcore.Camera(camera.K, camera.R, -camera.R @ (2.2 * camera.center), camera.width, camera.height)
        picture, mask = render_target(far, small, 12.0)
        image[mask] = picture[mask]
    return image


def test_masks_with_a_clean_plate_leave_shadows_out():
    camera = rig(1, (320, 240))[0]
    image, mask = render_target(camera, np.eye(4))
    plate, _ = render_target(camera)
    y, x = np.mgrid[:240, :320]
    shade = 1 - 0.5 / (1 + np.exp(((x - 210) ** 2 / 2500 + (y - 190) ** 2 / 600 - 1) * 6))
    image = np.where(mask[..., None], image, image * shade[..., None]).astype(np.uint8)
    noise = np.random.default_rng(0).normal(0, 2, image.shape)
    (found,) = foreground([np.clip(image + noise, 0, 255).astype(np.uint8)], [camera], [Background.from_plate(plate)])
    both, either = ((found > 0) & mask).sum(), ((found > 0) | mask).sum()
    assert both > 0.95 * either


def test_a_background_is_learnt_from_the_clip():
    camera = rig(1, (200, 150))[0]
    path = [turned(9 * t, (0.0, 0.9 - 0.15 * t, 0)) for t in range(13)]
    frames = [render_target(camera, p)[0] for p in path]
    (learnt,) = learn_backgrounds([frames], [camera], config=BackgroundConfig())
    plate, _ = render_target(camera)
    assert (np.abs(learnt.plate.astype(int) - plate).max(2) < 12)[learnt.known].mean() > 0.98
    (found,) = foreground([frames[6]], [camera], [learnt])
    mask = render_target(camera, path[6])[1]
    assert ((found > 0) & mask).sum() > 0.93 * ((found > 0) | mask).sum()


def test_masks_of_real_size_match_the_true_ones(shared):
    clips = load_video(shared / "synthetic" / "truck-video")
    cameras = [c.pinhole() for c in clips.calib]
    from mvcore.geometry.rig import common_volume
    from mvcore.io.images import read_image, read_mask

    backgrounds = [Background.from_plate(read_image(c.plate)) for c in clips.clips]
    images = [clips.undistorted(n, 2) for n in range(8)]
    for n, found in enumerate(foreground(images, cameras, backgrounds, common_volume(cameras))):
        true = read_mask(shared / "synthetic" / "truck-video" / "masks" / f"cam{n:02d}" / "frame0002.png") > 0
        assert ((found > 0) & true).sum() >= 0.95 * ((found > 0) | true).sum()


@given(st.floats(-25, 25), st.floats(-0.15, 0.15), st.integers(0, 100))
def test_poses_of_a_cloud_are_found(angle, shift, seed):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # An ellipsoid: no turn leaves it as it is.
    axes = np.array([0.9, 0.6, 0.4])
    points, directions = normals * axes, normals / axes
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    poses = [turned(angle * t, (shift, -shift * t, 0.1 * t)) for t in range(3)]
    clouds = [Cloud(points, directions).moved(p) for p in poses]
    clouds = [Cloud(c.points + rng.normal(0, 0.002, c.points.shape), c.normals) for c in clouds]
    found, shares = find_poses(clouds, 2.0)
    assert (shares > 0.9).all()
    relative = [p @ np.linalg.inv(poses[0]) for p in poses]
    for f, t in zip(found, relative):
        assert np.abs(f - t).max() < 0.01


def test_the_store_keeps_whole_entries_only(tmp_path):
    store = Store(tmp_path)
    key = digest("a", np.arange(3), {"b": 1.5})
    assert store.load(key) is None
    store.save(key, {"x": np.arange(4)}, {"n": 1})
    entry = store.load(key)
    assert entry is not None
    assert entry.arrays["x"].tolist() == [0, 1, 2, 3]
    assert entry.meta == {"n": 1}
    path = store.path(key)
    path.write_bytes(path.read_bytes()[:-30])  # as after a disk has filled up
    assert store.load(key) is None
    assert key not in store


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.text() | st.binary(), lambda x: st.lists(x), max_leaves=8), st.data())
def test_different_content_has_different_keys(value, data):
    other = data.draw(
        st.recursive(st.none() | st.booleans() | st.integers() | st.text() | st.binary(), lambda x: st.lists(x), max_leaves=8)
    )
    same = repr(value) == repr(other)
    assert (digest(value) == digest(other)) == same


def test_a_frame_that_vanishes_is_an_error_not_a_wait(tmp_path):
    write_clips(tmp_path, rig(12), POSES[:3])
    clips = load_video(tmp_path)
    (tmp_path / "images" / "cam03" / "frame0001.png").unlink()
    run = iter(reconstruct_video(clips, config=SETTINGS))
    next(run)
    with pytest.raises(FileNotFoundError, match=r"frame0001\.png"):
        next(run)


def test_a_run_that_is_dropped_ends(folder):
    run = iter(reconstruct_video(load_video(folder), config=SETTINGS | {"video": {"segment": 1}}))
    next(run)
    run.close()
