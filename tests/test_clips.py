import json

import cv2
import mvcore
import numpy as np
import pytest
from conftest import look_at, rig, write_clips
from mvcore import FormatError, InvalidInputError
from mvcore.io import load_video

QUALISYS = """<?xml version='1.0'?>
<calibration><cameras>
<camera serial="a1" viewrotation="0"><fov_video bottom="479" left="0" right="639" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0" x="100" y="-2000" z="300"/>
<intrinsic centerPointU="20480" centerPointV="15360" focalLengthU="38400" focalLengthV="38464" radialDistortion1="-3.2"
 radialDistortion2="0.64" radialDistortion3="0" tangentalDistortion1="0.064" tangentalDistortion2="0"/></camera>
</cameras></calibration>"""

KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  intrinsics: [460.0, 461.0, 320.5, 239.5]
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1e-05]
  resolution: [640, 480]
cam1:
  T_cn_cnm1:
  - [0.0, 0.0, 1.0, -0.11]
  - [0.0, 1.0, 0.0, 0.02]
  - [-1.0, 0.0, 0.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_model: equidistant
  intrinsics: [450.0, 450.0, 322.0, 238.0]
  distortion_coeffs: [0.01, 0.0, 0.0, 0.0]
  resolution: [640, 480]
"""


def test_qualisys(tmp_path):
    (tmp_path / "rig.qca.txt").write_text(QUALISYS)
    (camera,) = mvcore.load(tmp_path, images=False).calib
    assert camera.name == "a1"
    assert (camera.width, camera.height) == (640, 480)
    assert np.allclose(camera.center, [100, -2000, 300])
    assert np.allclose(camera.distortion, [-0.05, 0.01, 0.001, 0])
    # The sensor's axes: x along the world's x, "up" along z; it looks along +y, so a point ahead and above lands in the upper half.
    (x,) = camera.project([[100, 0, 500]])
    assert np.allclose(x, [320, 240 - 601 * 200 / 2000])
    (tmp_path / "rig.qca.txt").write_text(QUALISYS.replace('centerPointU="20480"', 'centerPointU="?"'))
    with pytest.raises(FormatError, match=r"a1: intrinsic centerPointU: expected a number"):
        mvcore.load(tmp_path, images=False)
    (tmp_path / "rig.qca.txt").write_text(QUALISYS[:200])
    with pytest.raises(FormatError, match=r"rig\.qca\.txt:\d+"):
        mvcore.load(tmp_path, images=False)


def test_kalibr(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    a, b = mvcore.load(tmp_path, images=False).calib
    assert np.allclose(a.R, np.eye(3))
    assert a.distortion.tolist() == [-0.28, 0.07, 0.0002, 1e-05]
    assert b.fisheye
    assert np.allclose(b.to_camera([[1.0, 2, 3]]), [[3 - 0.11, 2.02, -1 + 0.03]])
    path.write_text(KALIBR.replace("camera_model: pinhole\n  distortion_model: equi", "camera_model: ds\n  distortion_model: equi"))
    with pytest.raises(FormatError, match=r"cam1: expected a pinhole camera"):
        mvcore.load(path, images=False)
    path.write_text(KALIBR.replace("cam0:", "cam0: ["))
    with pytest.raises(FormatError, match=r"camchain\.yaml:\d"):
        mvcore.load(path, images=False)


def write_easymocap(folder, cameras, sizes=True):
    names = [f"{n + 1:02d}" for n in range(len(cameras))]
    inside, outside = (cv2.FileStorage(str(folder / f), cv2.FILE_STORAGE_WRITE) for f in ("intri.yml", "extri.yml"))
    for storage in (inside, outside):
        storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in names:
            storage.write("", name)
        storage.endWriteStruct()
    for name, c in zip(names, cameras):
        inside.write(f"K_{name}", c.K)
        inside.write(f"dist_{name}", np.array([[0.1, 0, 0, 0, 0]]))
        if sizes:
            inside.write(f"H_{name}", float(c.height))
            inside.write(f"W_{name}", float(c.width))
        outside.write(f"R_{name}", cv2.Rodrigues(c.R)[0])
        outside.write(f"Rot_{name}", np.ascontiguousarray(c.R))
        outside.write(f"T_{name}", c.t.reshape(3, 1))
    inside.release()
    outside.release()
    return names


def test_easymocap(tmp_path):
    cameras = rig(3)
    names = write_easymocap(tmp_path, cameras)
    found = mvcore.load(tmp_path, images=False).calib
    assert [c.name for c in found] == names
    for a, b in zip(found, cameras):
        assert np.allclose(a.project([[0.1, 0.2, 0.3]]), b.project([[0.1, 0.2, 0.3]]), atol=1e-9)
        assert a.distortion[0] == 0.1
    # Sizes may come from the clips beside the files.
    other = tmp_path / "other"
    for name in names:
        (other / "images" / name).mkdir(parents=True)
        cv2.imwrite(str(other / "images" / name / "000000.jpg"), np.zeros((120, 160, 3), np.uint8))
    write_easymocap(other, cameras, sizes=False)
    clips = load_video(other)
    assert (clips.calib[0].width, len(clips)) == (160, 1)


def test_image_folders_are_clips_with_their_plates(tmp_path):
    cameras = rig(3)
    write_clips(tmp_path, cameras, [np.eye(4)] * 11)
    clips = load_video(tmp_path, start=1, stride=4)
    assert [c.name for c in clips.clips] == ["cam00", "cam01", "cam02"]
    assert clips.numbers.tolist() == [[1] * 3, [5] * 3, [9] * 3]
    assert all(c.plate.name == "background.png" for c in clips.clips)
    assert clips.clips[0].source[9].name == "frame0009.png"
    instants = list(clips)
    assert [i.number for i in instants] == [0, 1, 2]
    assert np.array_equal(instants[2].frames[1], clips.frame(1, 2))


def test_a_reader_that_is_dropped_stops_its_thread(tmp_path):
    import threading

    frames = {n: np.zeros((50, 20, 30, 3), np.uint8) for n in "ab"}
    camera = look_at((2, 0, 0), (0, 0, 0), (30, 20), 25)
    running = iter(load_video(frames, [camera, look_at((0, 2, 0), (0, 0, 0), (30, 20), 25)]))
    next(running)
    running.close()
    assert not [t for t in threading.enumerate() if t.name == "mvcore-read-ahead"]


def test_video_frames_are_the_same_in_any_order(tmp_path):
    path = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, (64, 48))
    for n in range(90):
        writer.write(np.full((48, 64, 3), 2 * n, np.uint8))
    writer.release()
    cameras = [look_at((2, 0, 0), (0, 0, 0), (64, 48), 50), look_at((0, 2, 0), (0, 0, 0), (64, 48), 50)]
    clips = load_video({"a": path, "b": path}, cameras, offsets={"b": 0.2})
    assert clips.clips[0].rate == 25
    assert clips.numbers[0].tolist() == [0, 5]
    assert len(clips) == 85
    forward = [clips.frame(0, n).mean() for n in range(85)]
    for n in (80, 3, 84, 40, 39, 0):
        assert clips.frame(0, n).mean() == forward[n]
    assert np.ptp((np.array(forward) - 2 * np.arange(85))[5:]) <= 2  # up to the codec's offset, each frame is its own
    with pytest.raises(FormatError, match="ends after"):
        clips.clips[0].frame(200)


def test_rates_and_counts_that_differ_are_named():
    a, b = np.zeros((20, 12, 16, 3), np.uint8), np.zeros((9, 12, 16, 3), np.uint8)
    cameras = [look_at((2, 0, 0), (0, 0, 0), (16, 12), 14), look_at((0, 2, 0), (0, 0, 0), (16, 12), 14)]
    clips = load_video({"a": a, "b": b}, cameras, rates={"a": 50, "b": 25})
    assert clips.numbers[:3].tolist() == [[0, 0], [2, 1], [4, 2]]
    assert any("frame rates differ (a 50, b 25)" in w for w in clips.warnings)
    assert any("frame counts differ (a 20, b 9)" in w for w in clips.warnings)
    with pytest.raises(InvalidInputError, match="overlap"):
        load_video({"a": a, "b": b}, cameras, rates=25, offsets={"a": 100})
    with pytest.raises(InvalidInputError, match="rates"):
        load_video({"a": a, "b": b}, cameras, offsets={"a": 0.1})
    with pytest.raises(InvalidInputError, match="camera names"):
        load_video({"a": a, "b": b}, cameras, rates={"c": 5})
    with pytest.raises(InvalidInputError, match="start, stop"):
        load_video({"a": a, "b": b}, cameras, start=30)


def test_sizes_that_do_not_fit_the_calibration_are_named():
    a, b = np.zeros((3, 480, 636, 3), np.uint8), np.zeros((3, 240, 320, 3), np.uint8)
    cameras = [look_at((2, 0, 0), (0, 0, 0), (640, 480), 500), look_at((0, 2, 0), (0, 0, 0), (640, 480), 500)]
    clips = load_video({"a": a, "b": b}, cameras)
    assert "a: frames have 636 x 480 pixels, the calibration 640 x 480; taken as cut off" in clips.warnings[0]
    assert "another size" in clips.warnings[1]
    assert np.array_equal(clips.calib[0].K, cameras[0].K)
    assert clips.calib[1].K[0, 0] == 250
    with pytest.raises(FormatError, match="neither cut"):
        load_video({"a": np.zeros((3, 480, 480, 3), np.uint8), "b": b}, cameras)


def test_clips_and_cameras_must_belong_together(tmp_path):
    cameras = rig(3)
    write_clips(tmp_path, cameras, [np.eye(4)])
    with pytest.raises(InvalidInputError, match="one a camera"):
        load_video(tmp_path, cameras[:2])
    with pytest.raises(FileNotFoundError):
        load_video(tmp_path / "nowhere")
    with pytest.raises(FormatError, match="expected video files"):
        load_video(tmp_path / "images" / "cam00", cameras)
    data = json.loads((tmp_path / "cameras.json").read_text())
    data["views"].reverse()
    (tmp_path / "cameras.json").write_text(json.dumps(data))
    assert [c.name for c in load_video(tmp_path).clips] == ["cam02", "cam01", "cam00"]


def test_a_real_clip_with_a_defect(shared):
    clips = load_video(shared / "pose2sim-single")
    assert len(clips) == 100
    named = [w.split(":")[0] for w in clips.warnings]
    assert named == ["cam01", "cam02"]
    qca = mvcore.load(shared / "pose2sim-single" / "calibration", images=False).calib
    ours = mvcore.load(shared / "pose2sim-single" / "cameras.json", images=False).calib
    for a, b in zip(qca, ours):
        assert np.allclose(a.K, b.K, atol=1e-6)
        assert np.allclose(a.R, b.R)
        assert np.allclose(a.t / 1000, b.t)
        assert np.allclose(a.distortion, b.distortion)
