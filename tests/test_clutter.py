"""What lies in people's folders beside a calibration changes nothing: file managers' files, other folders, other names' case."""

import json
import shutil
from pathlib import Path

import cv2
import mvcore
import numpy as np
import pytest
from fuzz import seeds
from fuzz.readers import CALIBRATIONS

NAMES = ("native", *seeds.BUILDERS, *seeds.TOOLS)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Every format's data set, and what is read of it."""
    scenes = seeds.scenes(tmp_path_factory.mktemp("clutter"))
    return {name: (folder, mvcore.load(folder)) for name, folder in scenes.items()}


def picture(path):
    cv2.imwrite(str(path), np.full((7, 9, 3), 200, np.uint8))


def left_by_file_managers(root, scene):
    rng = np.random.default_rng(0)
    for name in ("Thumbs.db", ".DS_Store", "desktop.ini", "README.txt", "README.md"):
        (root / name).write_bytes(rng.bytes(90) if name in ("Thumbs.db", ".DS_Store") else b"Images of 3 May\nsee notes\n")
    for file in [f for f in root.rglob("*") if f.is_file() and not f.name.startswith(".")]:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X" + rng.bytes(40))


def other_folders_of_images(root, scene):
    for name in ("masks_old", "previews", "thumbnails", "depth", "results", "backup", ".ipynb_checkpoints", "@eaDir"):
        (root / name).mkdir(exist_ok=True)
        for frame in scene.frames:
            picture(root / name / f"{Path(frame).stem}.png")


def other_files_of_the_same_kinds(root, scene):
    texts = {"notes.json": '{"a": 1}', "config.yaml": "a: 1\nb: [1, 2]\n", "docker-compose.yml": "services:\n  a:\n    image: x\n"}
    texts |= {"settings.toml": "[a]\nb = 1\n", "log.csv": "a,b\n1,2\n", "project.xml": "<a/>", "times.txt": "0.1\n", "x.out": "x"}
    for name, text in texts.items():
        (root / name).write_text(text)
    np.savez(root / "x.npz", a=np.eye(3))
    np.save(root / "x.npy", np.eye(3))


def upper_case_suffixes(root, scene):
    for file in [f for f in root.rglob("*") if f.is_file() and f.suffix in CALIBRATIONS]:
        file.rename(file.with_suffix(file.suffix.upper()))


def a_name_with_blanks_and_umlauts(root, scene):
    return root.rename(root.with_name("Größe 3 (neu) ü"))


CHANGES = (
    left_by_file_managers,
    other_folders_of_images,
    other_files_of_the_same_kinds,
    upper_case_suffixes,
    a_name_with_blanks_and_umlauts,
)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", CHANGES, ids=lambda c: c.__name__)
def test_clutter_changes_nothing(tmp_path, built, name, change):
    folder, expected = built[name]
    inner = "office0" if name == "Replica" else "."
    root = tmp_path / "set"
    shutil.copytree(folder.parent if name == "Replica" else folder, root)
    root = change(root, expected) or root
    scene = mvcore.load(root / inner)
    assert scene.format == expected.format
    assert scene.masks == expected.masks
    assert [c.name for c in scene.calib] == [c.name for c in expected.calib]
    place = lambda s, base: [Path(f).relative_to(base).as_posix() for f in s.frames]  # noqa: E731
    assert place(scene, root / inner) == place(expected, folder)
    for a, b in zip(scene.calib, expected.calib):
        assert (a.width, a.height) == (b.width, b.height)
        np.testing.assert_allclose(a.projection, b.projection, rtol=0, atol=1e-9)
    if change is other_files_of_the_same_kinds and name == "opencv":
        assert "3 files without a camera matrix left out: config.yaml" in scene.warnings[0]
    else:
        assert len(scene.warnings) == len(expected.warnings)


def test_images_with_upper_case_suffixes(tmp_path, built):
    for name, (folder, expected) in built.items():
        root = tmp_path / name
        shutil.copytree(folder.parent if name == "Replica" else folder, root)
        for image in [f for f in root.rglob("*") if f.suffix in (".png", ".jpg")]:
            image.rename(image.with_suffix(image.suffix.upper()))
        scene = mvcore.load(root / "office0" if name == "Replica" else root)
        assert [Path(f).stem for f in scene.frames] == [Path(f).stem for f in expected.frames], name


def test_clips_with_clutter(tmp_path):
    cameras = mvcore.load(seeds.scenes(tmp_path / "seeds")["native"]).calib
    names = [f"cam{n}" for n in range(len(cameras))]
    views = [
        {"name": n, "width": 32, "height": 24, "K": c.K.tolist(), "R": c.R.tolist(), "t": c.t.tolist()} for n, c in zip(names, cameras)
    ]
    root = tmp_path / "clips"
    for name in names:
        (root / "images" / name).mkdir(parents=True)
        for n in range(2):
            cv2.imwrite(str(root / "images" / name / f"{n}.png"), np.zeros((24, 32, 3), np.uint8))
    (root / "cameras.json").write_text(json.dumps({"views": views}))
    (root / "masks_old").mkdir()
    (root / "previews").mkdir()
    picture(root / "masks_old" / "cam0.png")
    picture(root / "previews" / "cam0.png")
    left_by_file_managers(root, None)
    (root / "._making of.mp4").write_bytes(b"x")
    clips = mvcore.load_video(root)
    assert [(c.name, c.frames) for c in clips.clips] == [(n, 2) for n in names]
