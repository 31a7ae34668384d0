"""Video files as cameras and phones write them: any frame, real times, turns, broken ends."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import mvcore
import numpy as np
import pytest
from conftest import look_at
from mvcore import FormatError, InvalidInputError
from mvcore.io import load_video
from mvcore.io.media import media_size
from mvcore.io.streams import open_stream, video_frame
from mvcore.video.api import _plates, with_calibration
from PIL import Image

SIZE = (64, 48)
CODECS = {"libx264": {"bf": "2", "g": "12", "sc_threshold": "0"}, "libvpx": {"qmin": "0", "qmax": "4"}, "mpeg4": {}}


def picture(n: int, size=SIZE) -> np.ndarray:
    """An image that tells its number (modulo 60): its brightness is 4 n + 8; and which way is up: a dark bar at its top."""
    image = np.full((size[1], size[0], 3), 4 * (n % 60) + 8, np.uint8)
    image[:8] = 0
    return image


def number(image: np.ndarray) -> int:
    return round((float(np.median(image)) - 8) / 4)


def write_video(path, count=40, codec="libx264", times=None, rate=25, options=None, size=SIZE, file=None) -> Path:
    """Frame n is `picture(n)`, shown at n / rate or at times[n] (ms)."""
    form = {".mts": "mpegts", ".webm": "webm"}.get(path.suffix.lower())
    with av.open(file or str(path), "w", format=form) as container:
        stream = container.add_stream(codec, rate=rate, options=options or CODECS[codec])
        stream.bit_rate = 4_000_000
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        if times is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for n in range(count):
            frame = av.VideoFrame.from_ndarray(picture(n, size), format="rgb24")
            frame.pts = n if times is None else times[n]
            frame.time_base = Fraction(1, rate) if times is None else Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def turned_by_tag(path: Path) -> Path:
    """Asks players to turn an MP4 clockwise by 90 degrees, as phones do."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    data[at : at + 20] = b"".join(int(v * 65536).to_bytes(4, "big", signed=True) for v in (0, 1, 0, -1, 0))
    path.write_bytes(data)
    return path


def cameras(*names, size=SIZE):
    return [replace(look_at((2, n, 0), (0, 0, 0), size, 50), name=name) for n, name in enumerate(names)]


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "libx264"), ("a.MTS", "libx264"), ("a.webm", "libvpx"), ("a.avi", "mpeg4"), ("b.avi", "libx264")]
)
def test_any_frame_of_any_container(tmp_path, name, codec):
    path = write_video(tmp_path / name, codec=codec)
    stream = open_stream(path)
    assert (len(stream), stream.width, stream.height, stream.steady) == (40, 64, 48, True)
    assert abs(stream.rate - 25) < 1e-9
    forward = [video_frame(path, n) for n in range(40)]
    assert [number(f) for f in forward] == list(range(40))
    for n in (39, 3, 38, 12, 11, 13, 0, 25):
        assert np.array_equal(video_frame(path, n), forward[n])
    with pytest.raises(FormatError, match="ends after 40 frames, before frame 40"):
        video_frame(path, 40)


def test_frames_are_found_by_key_frames_not_from_the_start(tmp_path, monkeypatch):
    path = write_video(tmp_path / "long.mp4", 200, options={"bf": "2", "g": "10", "sc_threshold": "0"})
    open_stream(path)
    import mvcore.io.streams as streams

    decoded = []
    frames = streams._frames
    monkeypatch.setattr(streams, "_frames", lambda *a: (decoded.append(1) or f for f in frames(*a)))
    video_frame(path, 150)
    video_frame(path, 65)
    assert len(decoded) <= 2 * 16  # a group of ten pictures each, and what the decoder reorders


def test_a_pipe_writes_no_length(tmp_path):
    path = tmp_path / "a.webm"
    with open(path, "wb") as file:
        pipe = type("Pipe", (), {"write": lambda _, data: file.write(data)})()
        write_video(path, 30, "libvpx", file=pipe)
    with av.open(str(path)) as container:
        assert container.streams.video[0].frames == 0
        assert container.duration is None
    assert len(open_stream(path)) == 30
    assert open_stream(path).rate == 25


def test_cut_files_begin_and_end_where_they_decode(tmp_path):
    data = write_video(tmp_path / "whole.mts", 60).read_bytes()
    packets = len(data) // 188
    cut = tmp_path / "cut.mts"
    cut.write_bytes(data[: 188 * 3] + data[188 * (packets // 5) : 188 * (packets * 4 // 5)])  # the tables stay
    stream = open_stream(cut)
    shown = [number(video_frame(cut, n)) for n in range(len(stream))]
    assert 12 <= len(stream) < 60
    assert shown == list(range(shown[0], shown[0] + len(stream)))
    assert shown[0] > 0
    assert number(video_frame(cut, 5)) == shown[5]
    short = tmp_path / "short.mkv"
    short.write_bytes(write_video(tmp_path / "w.mkv", 60).read_bytes()[:-600])
    assert [number(video_frame(short, n)) for n in range(len(open_stream(short)))] == list(range(len(open_stream(short))))


def test_what_is_no_video_is_named(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"no video" * 100)
    with pytest.raises(FormatError, match=r"a\.mp4: not a video that FFmpeg decodes"):
        open_stream(path)
    with pytest.raises(FileNotFoundError, match="no such video"):
        open_stream(tmp_path / "b.mp4")


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "libx264"), ("a.mts", "libx264"), ("a.webm", "libvpx")])
def test_damaged_files_are_read_or_refused(tmp_path, name, codec):
    data, rng = write_video(tmp_path / name, 20, codec).read_bytes(), np.random.default_rng(7)
    refused = 0
    for n in range(25):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 2 ** int(rng.integers(0, 6))):
            damaged[at] = rng.integers(0, 256)
        path = tmp_path / f"{n}{name}"
        end = len(data) if name == "a.mp4" else rng.integers(len(data) // 2, len(data))  # an MP4's index lies at its end
        path.write_bytes(damaged[:end])
        try:
            frame = video_frame(path, len(open_stream(path)) - 1)
            assert frame.dtype == np.uint8
        except FormatError as error:
            assert str(path) in str(error)  # noqa: PT017
            refused += 1
    assert refused < 25


def test_frames_pair_by_their_times(tmp_path):
    """Twenty frames of which the tenth to the fourteenth were not taken: the other camera's frames at the same times pair with them."""
    steady = write_video(tmp_path / "a.mkv", 24, rate=25)
    times = [40 * n for n in range(20) if not 10 <= n < 15]
    varying = write_video(tmp_path / "b.mkv", 15, rate=25, times=times)
    assert not open_stream(varying).steady
    assert np.allclose(open_stream(varying).times, np.array(times) / 1000)
    clips = load_video({"a": steady, "b": varying}, cameras("a", "b"))
    assert [tuple(map(number, i.frames)) for i in clips] == [(t // 40, n) for n, t in enumerate(times)]
    assert any(w.startswith("b: the time between frames varies") for w in clips.warnings)
    evenly = load_video({"a": steady, "b": varying}, cameras("a", "b"), rates=25)
    assert evenly.numbers.tolist() == [[n, n] for n in range(15)]


def test_milliseconds_are_no_varying_rate(tmp_path):
    path = write_video(tmp_path / "a.mkv", 30, rate=30, times=[round(1000 * n / 30) for n in range(30)])
    stream = open_stream(path)
    assert stream.steady
    assert np.isclose(stream.rate, 30, rtol=1e-3)


def test_clips_are_turned_as_the_calibration_saw_them(tmp_path):
    for name in "ab":
        turned_by_tag(write_video(tmp_path / f"{name}.mp4", 5))
    upright = load_video(tmp_path, cameras("a", "b", size=(48, 64)))
    assert (upright.clips[0].width, upright.clips[0].height) == (48, 64)
    assert any(w.startswith("a: turned clockwise by 90 degrees") for w in upright.warnings)
    frame = upright.frame(0, 2)
    assert frame.shape == (64, 48, 3)
    assert frame[:, -6:].mean() < 5 < frame[:, :-10].mean()  # the stored top is on the right
    stored = load_video(tmp_path, cameras("a", "b"))
    assert any("left as stored" in w for w in stored.warnings)
    assert stored.frame(0, 2)[:6].mean() < 5
    half = load_video(tmp_path, cameras("a", "b"), rotation={"a": 180})
    assert half.frame(0, 2)[-6:].mean() < 5
    assert half.frame(1, 2)[:6].mean() < 5
    asked = load_video(tmp_path, cameras("a", "b", size=(48, 64)), rotation=270)
    assert asked.frame(0, 2)[:, :6].mean() < 5
    arrays = load_video({n: np.stack([picture(1)] * 2) for n in "ab"}, cameras("a", "b", size=(48, 64)), rotation="90")
    assert arrays.frame(0, 0)[:, -6:].mean() < 5
    with pytest.raises(InvalidInputError, match=r"rotation: expected auto, 0, 90, 180 or 270, got 45"):
        load_video(tmp_path, cameras("a", "b"), rotation=45)
    with pytest.raises(InvalidInputError, match=r"rotation: expected camera names"):
        load_video(tmp_path, cameras("a", "b"), rotation={"c": 90})


def test_images_of_a_clip_are_turned_as_well(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        image = Image.fromarray(picture(20))
        exif = image.getexif()
        exif[0x0112] = 6
        image.save(tmp_path / name / "0.jpg", exif=exif, quality=95)
    clips = load_video(tmp_path, cameras("a", "b", size=(48, 64)))
    assert clips.frame(0, 0)[:, -6:].mean() < 10
    assert any("turned clockwise by 90 degrees" in w for w in clips.warnings)


def test_clips_pair_by_name_or_not_at_all(tmp_path):
    for n, name in enumerate(["left", "TOP", "rear"]):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), picture(n))
    clips = load_video(tmp_path, cameras("rear", "left", "top"))
    assert [c.name for c in clips.clips] == ["rear", "left", "TOP"]
    assert [number(f) for f in next(iter(clips)).frames] == [2, 0, 1]
    with pytest.raises(InvalidInputError, match=r"one a camera by name \(rear, left, above\), got left, rear, TOP: no clip for above"):
        load_video(tmp_path, cameras("rear", "left", "above"))
    with pytest.raises(InvalidInputError, match="one a camera by name"):
        load_video(tmp_path, cameras("cam1", "cam2", "cam3"))
    assert len(load_video(tmp_path, cameras("", "", "")).clips) == 3


def test_two_files_of_one_camera_are_refused(tmp_path):
    for name in ("a.mp4", "a.MOV"):
        write_video(tmp_path / name, 3)
    with pytest.raises(FormatError, match=r"expected one clip a camera, got a\.MOV as well|got a\.mp4 as well"):
        load_video(tmp_path, cameras("a", "b"))


def test_sizes_of_clips_beside_a_calibration(tmp_path):
    (tmp_path / "videos").mkdir()
    write_video(tmp_path / "videos" / "01.MTS", 12)
    assert media_size(tmp_path, "01") == SIZE
    assert media_size(tmp_path, "02") == (0, 0)


@pytest.mark.parametrize(("orientation", "turn"), [(6, 3), (3, 2), (8, 1)])
def test_clean_plates_are_turned_as_the_frames_are(tmp_path, orientation, turn):
    """Beside the frames, in a folder of the caller's with and without a turn of its own, and with the turn left out."""
    size = SIZE[::-1] if turn % 2 else SIZE
    rng = np.random.default_rng(0)
    plates = {name: rng.integers(0, 256, (SIZE[1] // 8, SIZE[0] // 8, 3), np.uint8).repeat(8, 0).repeat(8, 1) for name in "ab"}
    for name, plate in plates.items():
        (tmp_path / "images" / name).mkdir(parents=True)
        (tmp_path / "upright").mkdir(exist_ok=True)
        for file in ("0.png", "1.png", "background.png"):
            image = Image.fromarray(plate if file == "background.png" else picture(1))
            exif = image.getexif()
            exif[0x0112] = orientation
            image.save(tmp_path / "images" / name / file, exif=exif)
        Image.fromarray(np.rot90(plate, turn)).save(tmp_path / "upright" / f"{name}.png")
    clips = load_video(tmp_path, cameras("a", "b", size=size))
    for given in (None, tmp_path / "upright", {n: tmp_path / "images" / n / "background.png" for n in "ab"}):
        for found, name in zip(_plates(clips, given), "ab"):
            np.testing.assert_array_equal(found, np.rot90(plates[name], turn))
    stored = load_video(tmp_path, cameras("a", "b"), rotation=0)
    np.testing.assert_array_equal(_plates(stored, None)[0], plates["a"])


def test_masks_of_a_clip_are_read_as_masks_of_photographs_are(tmp_path):
    """Of zeros and ones, with a turn in their EXIF block."""
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[10:20, 5:50] = 1
    for name in "ab":
        (tmp_path / name).mkdir()
        image = Image.fromarray(mask)
        exif = image.getexif()
        exif[0x0112] = 6
        image.save(tmp_path / name / "0.png", exif=exif)
    clips = load_video(tmp_path, cameras("a", "b", size=SIZE[::-1]))
    np.testing.assert_array_equal(clips.clips[0].mask(0), np.rot90(mask, 3) * 255)
    assert clips.clips[0].mask(0).dtype == np.uint8


def test_a_clip_keeps_that_its_world_is_mirrored(tmp_path):
    for name in "ab":
        write_video(tmp_path / f"{name}.mp4", 3)
    rig = mvcore.Calibration(tuple(cameras("a", "b")), "rig.json", mirrored=True)
    clips = load_video(tmp_path, rig)
    assert clips.calib.mirrored
    assert clips.calib.source == "rig.json"
    assert not load_video(tmp_path, list(rig)).calib.mirrored
    assert with_calibration(clips, rig).calib.mirrored
    assert not with_calibration(clips, list(rig)).calib.mirrored
    scene = mvcore.Scene([None] * 2, rig)
    mvcore.save_calibration(tmp_path / "cameras.json", scene)
    assert load_video(tmp_path).calib.mirrored
    assert with_calibration(load_video(tmp_path, list(rig)), tmp_path / "cameras.json").calib.mirrored
