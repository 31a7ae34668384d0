"""Images and masks of every kind people have."""

import json
import struct
import sys
import zlib

import cv2
import mvcore
import numpy as np
import pytest
from mvcore import Camera, FormatError, InvalidInputError
from mvcore.io.decode import decode, read_header, turn
from mvcore.io.images import find_masks, load_frame, load_mask, mask_warnings, read_image, read_mask
from PIL import Image, ImageOps

RAMP = np.linspace(0, 1, 64 * 48).reshape(48, 64)


def camera(width=64, height=48):
    return Camera([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], np.eye(3), np.zeros(3), width, height)


def disc(width=64, height=48):
    y, x = np.mgrid[:height, :width]
    return (x / width - 0.5) ** 2 + (y / height - 0.5) ** 2 < 0.09


def scene(folder, names, size=(64, 48), **view):
    views = []
    for n, name in enumerate(names):
        one = {"image": name, "width": size[0], "height": size[1], "K": camera().K.tolist(), "R": np.eye(3).tolist(), "t": [n, 0, 0]}
        views.append(one | view)
    (folder / "cameras.json").write_text(json.dumps({"views": views}))
    return folder


def test_grey_colour_and_transparent_images(tmp_path):
    grey = (RAMP * 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "g.png"), grey)
    assert (read_image(tmp_path / "g.png") == grey[..., None]).all()
    colour = np.dstack([grey, grey[::-1], grey[:, ::-1]])
    Image.fromarray(colour).save(tmp_path / "c.png")
    assert (read_image(tmp_path / "c.png") == colour).all()
    Image.fromarray(np.dstack([colour, disc() * np.uint8(255)])).save(tmp_path / "a.png")
    assert (read_image(tmp_path / "a.png") == colour * disc()[..., None]).all()
    Image.fromarray(grey).convert("P").save(tmp_path / "p.gif")
    assert (read_image(tmp_path / "p.gif") == grey[..., None]).all()


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_sixteen_bit_images_are_scaled_by_the_folders_maximum(tmp_path, bits):
    bright = (RAMP * (2**bits - 1)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "bright.png"), bright)
    cv2.imwrite(str(tmp_path / "dark.png"), bright // 8)
    assert abs(read_image(tmp_path / "bright.png").max() - 255) <= 1
    assert np.abs(read_image(tmp_path / "bright.png")[..., 0] - RAMP * 255).max() <= 1
    assert abs(read_image(tmp_path / "dark.png").max() - 255 / 8) <= 1  # as dark beside the other as it was taken


def test_float_images(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    value = np.dstack([RAMP] * 3).astype(np.float32)
    cv2.imwrite(str(tmp_path / "f.tif"), value)
    assert np.abs(read_image(tmp_path / "f.tif")[..., 0] - RAMP * 255).max() <= 1
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": value * 7}).write(str(tmp_path / "e.exr"))
    OpenEXR.File(header, {"Y": (value[..., 0] * 7).astype(np.float16)}).write(str(tmp_path / "y.exr"))
    white = np.percentile(value, 99.5)
    linear = np.clip(RAMP / white, 0, 1)
    expected = 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)  # sRGB's curve
    for name in ("e.exr", "y.exr"):
        assert np.abs(read_image(tmp_path / name)[..., 0] - expected).max() <= 2
        assert (read_header(tmp_path / name).width, read_header(tmp_path / name).height) == (64, 48)
    (tmp_path / "bad.exr").write_bytes(b"v/1\x01" + bytes(100))
    with pytest.raises(FormatError, match=r"bad.exr: not an EXR image"):
        read_image(tmp_path / "bad.exr")


def test_heic_without_its_package_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(20))
    with pytest.raises(FormatError, match=r"a.heic: HEIC images need the package pillow-heif: pip install 'mvcore\[heic\]'"):
        mvcore.load(scene(tmp_path, ["a.heic"]))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_turns(tmp_path, orientation):
    stored = np.dstack([(RAMP * 255).astype(np.uint8)] * 3)
    image = Image.fromarray(stored)
    image.getexif()[0x0112] = orientation
    image.save(tmp_path / "a.png", exif=image.getexif())
    shown = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    assert (turn(decode(tmp_path / "a.png"), orientation) == shown).all()
    assert read_header(tmp_path / "a.png").turned == shown.shape[1::-1]
    if orientation >= 5:
        found = mvcore.load(scene(tmp_path, ["a.png"], size=(48, 64)))
        assert f"turned by the EXIF orientation {orientation}" in found.warnings[0]
        assert (load_frame(found.frames[0], found.calib[0], 0) == shown).all()
    found = mvcore.load(scene(tmp_path, ["a.png"]))
    assert (load_frame(found.frames[0], found.calib[0], 0) == stored).all()
    assert ("EXIF orientation is not applied" in " ".join(found.warnings)) == (orientation != 1)


def test_a_calibration_at_another_scale(tmp_path):
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.zeros((24, 32, 3), np.uint8))
    found = mvcore.load(scene(tmp_path, ["0.png", "1.png"]))
    assert found.warnings == (
        "0.png and 1 more: images have 32x24 pixels, the calibration 64x48; taken as the same images at another size",
    )
    point = [[0.1, 0.2, 2.0]]
    assert np.allclose(found.calib[0].project(point), (camera().project(point) + 0.5) / 2 - 0.5)
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((27, 48, 3), np.uint8))
    with pytest.raises(FormatError, match=r"image 1.png has 48 x 27 pixels, its camera 64 x 48"):
        mvcore.load(tmp_path)


def test_bombs_and_damaged_images_are_refused(tmp_path):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b""))
    with pytest.raises(FormatError, match=r"bomb.png: declares too many pixels"):
        read_image(tmp_path / "bomb.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(FormatError, match=r"text.png: not an image"):
        read_image(tmp_path / "text.png")
    with pytest.raises(FileNotFoundError, match=r"no such image"):
        read_image(tmp_path / "none.png")


LABELS = np.where(disc(), 1, 0) + np.where(disc() & (RAMP > 0.5), 2, 0)


@pytest.mark.parametrize(
    "mask",
    [
        disc() * np.uint8(1),
        disc() * np.uint8(255),
        disc() * np.uint8(127),
        disc() * np.uint16(65535),
        LABELS.astype(np.uint8),
        (LABELS * 80).astype(np.uint8),
        np.where(LABELS == 1, 1, LABELS * 70).astype(np.uint8),
        cv2.GaussianBlur(disc() * np.uint8(255), (3, 3), 0.5),
    ],
    ids=["0/1", "0/255", "0/127", "16 bit", "labels", "spread labels", "labels with 1", "soft"],
)
def test_values_of_masks(tmp_path, mask):
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    assert ((read_mask(tmp_path / "m.png") > 0) == disc()).mean() > 0.98  # a soft border may move by a pixel
    if mask.dtype == np.uint8:
        assert (load_mask(mask, camera(), 0) == read_mask(tmp_path / "m.png")).all()


def test_masks_of_other_files(tmp_path):
    cv2.imwrite(str(tmp_path / "black.jpg"), np.random.default_rng(0).integers(0, 4, (48, 64)).astype(np.uint8))
    assert not read_mask(tmp_path / "black.jpg").any()
    palette = Image.fromarray(LABELS.astype(np.uint8)).convert("P")
    palette.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0])
    palette.save(tmp_path / "p.png")
    assert ((read_mask(tmp_path / "p.png") > 0) == disc()).all()
    opaque = np.dstack([np.repeat((disc() * np.uint8(255))[..., None], 3, 2), np.full((48, 64), 255, np.uint8)])
    Image.fromarray(opaque).save(tmp_path / "o.png")
    assert ((read_mask(tmp_path / "o.png") > 0) == disc()).all()


@pytest.mark.parametrize("factor", [2, 3, 0.5])
def test_masks_at_another_size(factor):
    size = int(64 * factor), int(48 * factor)
    mask = load_mask(disc(*size) * np.uint8(1), camera(), 0)
    assert mask.shape == (48, 64)
    assert ((mask > 0) == disc()).mean() > 0.98
    with pytest.raises(InvalidInputError, match=r"masks\[3\]: expected 64 x 48 pixels as its camera, got 64 x 64"):
        load_mask(np.zeros((64, 64), np.uint8), camera(), 3)


def test_alpha_is_taken_for_the_mask(tmp_path):
    for n in range(3):
        alpha = np.full((48, 64), 255, np.uint8) if n == 2 else disc() * np.uint8(255)
        Image.fromarray(np.dstack([np.full((48, 64, 3), 90, np.uint8), alpha])).save(tmp_path / f"{n}.png")
    found = mvcore.load(scene(tmp_path, ["0.png", "1.png", "2.png"]))
    assert found.alpha
    assert "3 of 3 images have an alpha channel" in found.warnings[0]
    assert ((load_mask(found.masks[1], found.calib[1], 1) > 0) == disc()).all()
    for n in range(3):
        Image.fromarray(np.full((48, 64, 4), 255, np.uint8)).save(tmp_path / f"{n}.png")
    assert mvcore.load(tmp_path).masks is None


def test_masks_pair_by_number(tmp_path):
    for n in (1, 2, 10):
        cv2.imwrite(str(tmp_path / f"mask_{n}.png"), np.zeros((4, 4), np.uint8))
    masks = find_masks(tmp_path, ["images/v02.jpg", "images/v10.jpg", "images/v01.jpg"])
    assert [m.stem for m in masks] == ["mask_2", "mask_10", "mask_1"]
    assert find_masks(tmp_path, ["mask_10.jpg", "mask_3.jpg"]) == [tmp_path / "mask_10.png", None]
    with pytest.raises(FormatError, match=r"no mask for a.jpg"):
        find_masks(tmp_path, ["a.jpg", "b.jpg"])


def test_what_is_suspicious_about_masks():
    good, inverted, full = (m * np.uint8(255) for m in (disc(), ~disc(), np.ones((48, 64), bool)))
    cut = np.zeros((48, 64), np.uint8)
    cut[:, 20:] = 255  # a target that leaves the image
    assert mask_warnings([good, cut, good]) == []
    assert mask_warnings([cut] * 3) == []
    assert "inverted" in mask_warnings([inverted] * 3)[0]
    assert "masks: 1 of 3 views have none, or one that is all target (1)" in mask_warnings([good, None, good])[0]
    assert "2 of 3 views" in mask_warnings([good, full, None])[0]
    assert "masks: 1 of 2 are empty (1)" in mask_warnings([good, 0 * good])[0]
