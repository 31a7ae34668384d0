"""What is said before any work."""

import os
from dataclasses import replace

import cv2
import mvcore
import numpy as np
import pytest
from conftest import look_at, rig, write_clips, write_scene
from mvcore import Config, InvalidInputError
from mvcore.io import load_video
from mvcore.pipeline import checks
from mvcore.pipeline.checks import check_writable
from mvcore.pipeline.preflight import BASE_BYTES, candidate_sources, preflight, preflight_clips


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Twelve grey images around the origin, with masks of a disc."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, rig(12), [np.full((120, 160, 3), 90, np.uint8)] * 12)
    (folder / "masks").mkdir()
    for n in range(12):
        mask = cv2.circle(np.zeros((120, 160), np.uint8), (80, 60), 40, 255, -1)
        cv2.imwrite(str(folder / "masks" / f"{n:03d}.png"), mask)
    return folder


def test_a_good_scene_has_an_outlook(scene):
    done = mvcore.check(scene, masks=scene / "masks")
    assert done.errors == []
    assert not [w for w in done.warnings if not w.startswith("installation")]
    plan = done.outlook
    assert (plan.views, plan.frames, plan.width, plan.height) == (12, 1, 160, 120)
    assert all(1 <= len(s) <= 6 for s in plan.sources)
    assert plan.minutes > 0
    assert plan.memory > 1 << 20
    assert done.as_dict()["good"]
    done.require_good()


def test_time_grows_with_views_pixels_and_moments(scene):
    cameras = rig(12)
    one = preflight(None, cameras).outlook
    assert preflight(None, cameras, moments=10).outlook.minutes == pytest.approx(10 * one.minutes, rel=0.1)
    small = preflight(None, cameras, config={"depth": {"max_image_size": 40}}).outlook
    assert (small.width, small.height) == (40, 30)
    assert small.minutes < one.minutes
    assert small.memory < one.memory
    assert preflight(None, rig(6)).outlook.minutes < one.minutes


def test_sources_by_poses_alone():
    """On a circle of 24 cameras neighbours come first, and none beyond 65 degrees."""
    cameras = [look_at((3 * np.cos(a), 3 * np.sin(a), 0), (0, 0, 0)) for a in np.radians(np.arange(0, 360, 15))]
    for n, sources in enumerate(candidate_sources(cameras, Config())):
        assert {(n - 1) % 24, (n + 1) % 24} == set(sources[:2])
        assert all(min((n - s) % 24, (s - n) % 24) <= 4 for s in sources)
    back_to_back = [look_at((0, 0, 0), (1, 0, 0)), look_at((0.1, 0, 0), (-1, 0, 0))]
    assert any("no two views" in w for w in preflight(None, back_to_back).warnings)


def test_cameras_in_doubt():
    cameras = rig(4)
    strange = [
        replace(cameras[0], K=np.array([[1.2, 0, 80], [0, 1.2, 60], [0, 0, 1.0]])),
        replace(cameras[1], K=np.array([[200, 0, 80], [0, 120, 60], [0, 0, 1.0]])),
        replace(cameras[2], K=np.array([[200, 0, 800], [0, 200, 60], [0, 0, 1.0]])),
        replace(cameras[0], name="twin"),
        *cameras[3:],
    ]
    said = " ".join(preflight(None, strange).warnings)
    for part in ("view 0: a focal length of 0.0075 times", "differ by more than a quarter", "outside its 160 x 120", "2 cameras stand"):
        assert part in said
    assert "coincident" in preflight(None, [cameras[0]] * 3).errors[0]
    assert "at least 2 cameras" in preflight(None, cameras[:1]).errors[0]


def test_images_are_opened_for_their_headers_alone(scene, tmp_path):
    found = mvcore.load(scene)
    files = list(found.frames)
    cut = tmp_path / "cut.png"
    cut.write_bytes(files[0].read_bytes()[:60])  # the header, and no pixels
    assert preflight([cut, *files[1:]], found.calib).errors == []
    (tmp_path / "none.png").write_bytes(b"none")
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((20, 30, 3), np.uint8))
    done = preflight([tmp_path / "none.png", tmp_path / "small.png", tmp_path / "gone.png", *files[3:]], found.calib)
    assert [e.split(" ")[1] for e in done.errors] == ["0", "1", "2"]
    assert "160 x 120" in done.errors[1]
    assert "30 x 20" in done.errors[1]
    assert "expected 12, one a camera, got 3" in preflight(files[:3], found.calib).errors[0]
    arrays = preflight([np.zeros((120, 160, 3), np.float32)] * 12, found.calib)
    assert "uint8" in arrays.errors[0]
    with pytest.raises(InvalidInputError, match=r"uint8.*and 11 more"):
        arrays.require_good()


def test_masks_that_are_empty_inverted_or_of_another_size(scene):
    found, disc = mvcore.load(scene), np.zeros((120, 160), np.uint8)
    disc[20:100, 30:130] = 255

    def look(masks):
        return preflight(found.frames, found.calib, masks)

    assert not [w for w in look([disc] * 12).warnings if w.startswith("masks")]
    assert any("inverted" in w for w in look([255 - disc] * 12).warnings)
    assert any("masks: 1 of 12 are empty (3)" in w for w in look([disc] * 3 + [0 * disc] + [disc] * 8).warnings)
    assert any("all are empty" in e for e in look([0 * disc] * 12).errors)
    assert any("views have none" in w for w in look([disc] * 11 + [None]).warnings)
    assert look([np.kron(disc, np.ones((2, 2), np.uint8))] * 12).errors == []
    assert len(look([disc[:50]] * 12).errors) == 12
    assert "expected 12" in look([disc] * 3).errors[0]
    assert "no such folder" in look("nowhere").errors[0]


def test_bounds_must_be_a_box_that_is_seen():
    cameras = rig(4)
    assert preflight(None, cameras, bounds=[-1, -1, -1, 1, 1, 1]).errors == []
    assert preflight(None, cameras, bounds=[-3100, -5000, -70, 5000, 3300, 90]).errors == []  # a city, of which they see a place
    for box, part in (
        ([1, 2], "2 values"),
        ([1, 1, 1, 0, 0, 0], "x0 < x1"),
        ([0, 0, 0, 1, 1, float("nan")], "x0 < x1"),
        ("abc", "expected ((x0, y0, z0), (x1, y1, z1)), got 'abc'"),
        ([1000, 1000, 1000, 1001, 1001, 1001], "no camera sees"),
    ):
        assert part in preflight(None, cameras, bounds=box).errors[0]


def test_places_are_tried_and_left_as_they_were(tmp_path):
    check_writable(tmp_path / "a.glb")
    check_writable(tmp_path / "new" / "deep" / "a.glb")
    check_writable(tmp_path / "new", folder=True)
    assert not list(tmp_path.iterdir())
    old = tmp_path / "old.glb"
    old.write_text("old")
    check_writable(old)
    assert old.read_text() == "old"
    for place, folder, part in (
        (tmp_path, False, "got a folder"),
        (old, True, "got a file"),
        (old / "in.glb", False, "which is no folder"),
        ("/proc/none/a.glb", False, "in /proc"),
    ):
        with pytest.raises(InvalidInputError, match=part):
            check_writable(place, folder=folder)
    if os.geteuid():
        (tmp_path / "ro").mkdir(mode=0o555)
        with pytest.raises(InvalidInputError, match="Permission denied"):
            check_writable(tmp_path / "ro" / "a.glb")
    done = preflight(None, rig(4), outputs=["/proc/none/a.glb"], folders=[old], workdir=old)
    assert len(done.errors) == 2


def test_a_missing_device_is_named_without_importing_torch(monkeypatch):
    monkeypatch.setattr("mvcore.network.devices.cuda_available", lambda: False)
    assert "CUDA" in preflight(None, rig(4), config={"device": "cuda"}).errors[0]
    monkeypatch.setattr(checks.importlib.util, "find_spec", lambda name: None)
    assert "torch" in preflight(None, rig(4), config={"matcher": "dcnn"}).errors[0]
    assert preflight(None, rig(4)).errors == []


def test_settings_memory_and_two_opencvs(monkeypatch):
    assert "coarsest" in preflight(None, rig(4), config={"depth": {"coarsest": 0}}).errors[0]
    monkeypatch.setattr("mvcore.pipeline.preflight.available_memory", lambda: 100 << 20)
    assert any("are needed, 0.1 GiB are free" in w for w in preflight(None, rig(4)).warnings)
    assert any("4.0 GiB are allowed" in w for w in preflight(None, rig(4), max_memory=4 << 30).warnings)

    class Package:
        def __init__(self, name):
            self.metadata = {"Name": name}

    monkeypatch.setattr(checks.metadata, "distributions", lambda: map(Package, ["opencv-python", "opencv-python-headless", "numpy"]))
    assert any("overwrite each other" in w for w in preflight(None, rig(4)).warnings)
    monkeypatch.setattr(checks.metadata, "distributions", lambda: map(Package, ["opencv-python-headless", "numpy"]))
    assert not any("overwrite" in w for w in preflight(None, rig(4)).warnings)


def test_memory_is_that_of_the_task_graph():
    """Of so many tasks at a time and results up to a bound, however many views there are."""
    few, many = (preflight(None, rig(n, (4000, 3000))).outlook.memory for n in (100, 300))
    assert few == many
    assert 1 << 30 < many < 2 << 30
    bounded = preflight(None, rig(12, (4000, 3000)), max_memory=800 << 20)
    assert bounded.errors == []
    assert bounded.outlook.memory <= BASE_BYTES + (800 << 20)
    assert "expected at least" in preflight(None, rig(12, (4000, 3000)), max_memory=100 << 20).errors[0]


def test_clips_are_checked_at_both_ends(tmp_path):
    write_clips(tmp_path, rig(3), [np.eye(4)] * 3)
    done = mvcore.check(tmp_path)
    assert (done.errors, done.format, done.outlook.frames) == ([], "clips", 3)
    clips = load_video(tmp_path)
    (tmp_path / "images" / "cam01" / "frame0002.png").write_bytes(b"damaged")
    assert preflight_clips(clips).errors[0].startswith("cam01: ")


def test_what_cannot_be_read_is_an_error_not_an_exception(tmp_path):
    assert "no such file or folder" in mvcore.check(tmp_path / "nowhere", outputs=[tmp_path]).errors[0]
    assert len(mvcore.check(tmp_path / "nowhere", outputs=[tmp_path]).errors) == 2
    assert mvcore.check(tmp_path).errors


class Worked(Exception):
    """Work began."""


@pytest.fixture
def no_work(monkeypatch):
    def begin(*_, **__):
        raise Worked

    monkeypatch.setattr("mvcore.pipeline.reconstruct.open_session", begin)
    monkeypatch.setattr("mvcore.video.run.open_session", begin)
    monkeypatch.setattr("mvcore.io.images.decode", begin)  # of an image or mask


def test_calls_from_python_are_checked_before_any_work(scene, tmp_path, monkeypatch, no_work):
    found = mvcore.load(scene)
    frames = list(found.frames)
    with pytest.raises(Worked):
        mvcore.reconstruct(found, masks=scene / "masks", workdir=tmp_path / "work", bounds=[-1, -1, -1, 1, 1, 1])
    assert not (tmp_path / "work").exists()
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((12, 16), np.uint8))
    (tmp_path / "file").write_text("x")
    (tmp_path / "text.png").write_text("x")
    arrays = [np.zeros((120, 160, 3), np.uint8)] * 11
    for message, changed in (
        (r"view 0 \(.*gone.png: no such image", {"frames": [tmp_path / "gone.png", *frames[1:]]}),
        (
            r"view 3 \(.*expected 160 x 120 pixels as its camera, got 16 x 12 \(and 1 more",
            {"frames": [*arrays[:3], *[tmp_path / "small.png"] * 2, *arrays[4:]]},
        ),
        (r"text.png: not an image", {"frames": [tmp_path / "text.png", *frames[1:]]}),
        (r"frames\[11\]: expected \(h, w, 3\) of uint8", {"frames": [*arrays, np.zeros((120, 160))]}),
        (r"view 0 \(.*text.png: not an image", {"masks": [tmp_path / "text.png", *[None] * 11]}),
        (r"bounds: no camera sees the box", {"bounds": [900, 900, 900, 901, 901, 901]}),
        (r"file: expected a folder that can be written, got a file", {"workdir": tmp_path / "file"}),
        (r"device: expected a CUDA device", {"config": {"device": "cuda"}}),
    ):
        monkeypatch.setattr("mvcore.network.devices.cuda_available", lambda: False)
        arguments = {"frames": frames, "calib": found.calib} | changed
        with pytest.raises(InvalidInputError, match=message):
            mvcore.reconstruct(arguments.pop("frames"), arguments.pop("calib"), **arguments)
    with pytest.raises(Worked):  # the device is the workers'
        mvcore.reconstruct(found, config={"device": "cuda"}, scheduler="tcp://host:1")


def test_clips_from_python_are_checked_before_any_work(tmp_path, monkeypatch):
    write_clips(tmp_path / "set", rig(3), [np.eye(4)] * 3)
    clips = load_video(tmp_path / "set")
    monkeypatch.setattr("mvcore.network.devices.cuda_available", lambda: False)
    (tmp_path / "file").write_text("x")
    for message, changed in (
        (r"bounds: no camera sees the box", {"bounds": [900, 900, 900, 901, 901, 901]}),
        (r"file: expected a folder that can be written, got a file", {"workdir": tmp_path / "file"}),
        (r"device: expected a CUDA device", {"config": {"device": "cuda"}}),
    ):
        with pytest.raises(InvalidInputError, match=message):
            mvcore.reconstruct_video(clips, **changed)
    (tmp_path / "set" / "images" / "cam01" / "frame0002.png").write_bytes(b"damaged")
    with pytest.raises(InvalidInputError, match=r"cam01: .*frame0002.png: not an image"):
        mvcore.reconstruct_video(clips)


def test_what_a_preflight_notices_is_in_the_report(ring):
    cameras, images, _, _ = ring
    wide = [replace(c, K=c.K * np.array([[1.4], [1], [1]])) for c in cameras]
    config = {"depth": {"max_image_size": 48}}
    result = mvcore.reconstruct(images, wide, config=config)
    assert any("differ by more than a quarter" in w for w in result.report["warnings"])
