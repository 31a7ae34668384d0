"""Files made to do harm: refused in one line by mvcore's own errors, before memory or time is spent."""

import importlib
import json
import pkgutil
import re
import struct
import time
import zipfile

import cv2
import mvcore
import numpy as np
import pytest
import trimesh
from mvcore.errors import FormatError
from mvcore.evaluation.metrics import load_geometry
from mvcore.io.limits import inside, read_json, read_npz
from mvcore.io.maps import read_pfm
from mvcore.io.mesh_files import load_mesh
from mvcore.nurbs.obj import load_obj
from mvcore.viewer.page import write_page


def npy(header: bytes, data: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def archive(path, **entries):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in entries.items():
            file.writestr(f"{name}.npy", data)
    return path


HEADER = b"{'descr': '%s', 'fortran_order': False, 'shape': %s, }\n"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (npy(HEADER % (b"<f8", b"(4294967296, 4)"), bytes(128)), "its header declares 4294967296 x 4 of float64"),
        (npy(HEADER % (b"<f8", b"(" + b"9" * 400 + b",)"), bytes(128)), "its header declares"),
        (npy(HEADER % (b"|O", b"(1,)"), b"cos\nsystem\n(S'false'\ntR."), "plain numbers"),
        (npy(b"(" * 3000), "plain numbers"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f", "a header of"),
        (b"\x93NUMPY\x02\x00", "not an archive of number arrays"),
        (b"", "not an array file"),
    ],
)
def test_an_npz_that_declares_what_it_does_not_hold(tmp_path, data, message):
    path = archive(tmp_path / "a.npz", x=data)
    with pytest.raises(FormatError, match=message):
        read_npz(path)


def test_npz(tmp_path):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.asfortranarray(np.eye(3, dtype=np.float32)),
        "c": np.array(3),
        "d": np.zeros((0, 2)),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        read = read_npz(tmp_path / "a.npz")
        for name, value in arrays.items():
            np.testing.assert_array_equal(read[name], value)
            assert read[name].dtype == value.dtype
    assert list(read_npz(tmp_path / "a.npz", lambda n: n == "a")) == ["a"]
    bomb = archive(tmp_path / "bomb.npz", x=npy(HEADER % (b"|u1", b"(50000000,)"), bytes(50_000_000)))
    assert bomb.stat().st_size < 100_000
    with pytest.raises(FormatError, match="more than the allowed 1000000"):
        read_npz(bomb, most=1_000_000)
    (tmp_path / "no.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(FormatError, match=r"no\.npz"):
        read_npz(tmp_path / "no.npz")
    with pytest.raises(FileNotFoundError):
        read_npz(tmp_path / "missing.npz")


def test_json_limits(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("\ufeff" + json.dumps({"a": [1, 2.5, "x"]}), encoding="utf-8")
    assert read_json(path) == {"a": [1, 2.5, "x"]}
    path.write_text('{"a": ' + "9" * 10_000 + "}")
    assert read_json(path) == {"a": float("inf")}
    for text, message in (("[" * 100_000, "a.json:1: nested too deep"), ("{\n]", "a.json:2: "), ('"\x00"', "a.json:1: ")):
        path.write_text(text)
        with pytest.raises(FormatError, match=message):
            read_json(path)


def test_a_path_stays_in_its_folder(tmp_path):
    folder = tmp_path / "folder"
    (folder / "a").mkdir(parents=True)
    (tmp_path / "secret").write_text("x")
    (folder / "link").symlink_to(tmp_path / "secret")
    assert inside(folder, "a/../a/b.png", folder) == folder / "a" / "b.png"
    for name in ("../secret", "/etc/passwd", "link", "", "a\0b", None, 3):
        with pytest.raises(FormatError, match="expected the path of a file in"):
            inside(folder, name, folder / "index.json")


def index(folder, **changes):
    """The index of one instant with one mesh."""
    report = {"mesh": {"faces": 12}, "warnings": []}
    instant = {"instant": 0, "time": 0.0, "files": ["a.glb"], "depth": {"cam": "a.jpg"}, "report": report}
    content = {"format": "mvcore sequence", "version": 1, "warnings": [], "instants": [instant | changes.pop("instant", {})]}
    folder.mkdir(exist_ok=True)
    (folder / "index.json").write_text(json.dumps(content | changes))
    trimesh.creation.box().export(folder / "a.glb")
    cv2.imwrite(str(folder / "a.jpg"), np.zeros((4, 4, 3), np.uint8))
    return folder


def test_the_page_escapes_what_it_shows(tmp_path):
    folder = index(tmp_path / "<img src=x onerror=alert(1)>", warnings=["<!--<script>", "</script><script>alert(2)</script>"])
    html = write_page(folder).read_text()
    assert "<img src=x" not in html
    assert "&lt;img src=x onerror=alert(1)&gt;" in html
    data = html.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    assert "<" not in data
    assert json.loads(data)["warnings"] == ["<!--<script>", "</script><script>alert(2)</script>"]


@pytest.mark.parametrize(
    "changes",
    [
        {"instant": {"files": ["../a.glb"]}},
        {"instant": {"depth": {"cam": "/etc/hostname"}}},
        {"instant": {"files": "a.glb"}},
        {"instant": {"depth": ""}},
        {"instant": {"report": None}},
        {"instant": {"report": {"mesh": {"faces": "<b>"}}}},
        {"instant": {"instant": "<b>"}},
        {"instants": []},
        {"instants": {}},
        {"warnings": None},
        {"rigid": {"model": "../../a.glb", "poses": []}},
        {"rigid": {"model": "a.glb", "poses": [-1]}},
        {"rigid": []},
    ],
)
def test_an_index_that_is_none_is_refused(tmp_path, changes):
    folder = index(tmp_path / "out", **changes)
    with pytest.raises(FormatError, match=r"index\.json: expected"):
        write_page(folder)
    assert not (folder / "view.html").exists()


def test_meshes_that_are_none(tmp_path):
    box = trimesh.creation.box()
    for suffix in ("ply", "glb", "off"):
        path = tmp_path / f"a.{suffix}"
        box.export(path)
        assert len(load_geometry(path)[1]) == 12
        data = path.read_bytes()
        for cut in (0, 1, len(data) // 3, len(data) // 2):
            path.write_bytes(data[:cut])
            with pytest.raises(FormatError, match=f"a.{suffix}"):
                load_mesh(path)
    gltf = {"asset": {"version": "2.0"}, "buffers": [{"uri": "../../secret", "byteLength": 4}]}
    (tmp_path / "a.gltf").write_text(json.dumps(gltf))
    with pytest.raises(FormatError):
        load_mesh(tmp_path / "a.gltf")


@pytest.mark.parametrize("header", [b"Pf\n-2 -3\n-1\n", b"Pf\n99999999999 99999999999\n-1\n", b"Pf\n0 3\n-1\n", b"Pf\n1e9 1\n-1\n", b""])
def test_pfm(tmp_path, header):
    (tmp_path / "a.pfm").write_bytes(header + bytes(64))
    with pytest.raises(FormatError, match=r"a\.pfm:1"):
        read_pfm(tmp_path / "a.pfm")


@pytest.mark.parametrize("lines", ["parm kind 1 2", "parm deg 1.5 2.5\nparm type 1", "deg 3\ncurv 0 1 1 2\nparm\nend", "v 1e400 nan x"])
def test_nurbs_obj(tmp_path, lines):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\ncstype bspline\ndeg 1\ncurv 0 1 1 2\n" + lines + "\nparm u 0 0 1 1\nend\n")
    with pytest.raises(FormatError, match=r"a\.obj:\d+: not a B-spline"):
        load_obj(path)


def patterns():
    """Every regular expression that a module of the package holds, by its place."""
    out = {}
    for module in pkgutil.walk_packages(mvcore.__path__, "mvcore."):
        if not module.name.startswith(("mvcore.network", "mvcore.nurbs.torch")):
            for name, value in vars(importlib.import_module(module.name)).items():
                if isinstance(value, re.Pattern):
                    out[f"{module.name}.{name}"] = value
    return out


@pytest.mark.parametrize("place", sorted(patterns()))
def test_the_time_of_a_regular_expression_grows_with_the_length_alone(place):
    pattern = patterns()[place]
    # Patterns of lines are searched for in whole files, the others are matched with a line, a word or a name.
    apply = pattern.findall if pattern.flags & re.MULTILINE else pattern.match
    for start in ("", "(", '"', "<a ", "cam"):
        for part in (" ", "\n", "\t", "1", "1 ", "1.", ".", "1e1", "-", "a", "a.", "a=", "( 1", "(", "[", '"', "_", "\\", "a: "):
            text = start + part * 20_000 + "\x01"
            begin = time.process_time()
            apply(text.encode() if isinstance(pattern.pattern, bytes) else text)
            assert time.process_time() - begin < 1, f"{start}{part} .."  # milliseconds where it does; tens of seconds by the square


def test_reading_takes_little_time(tmp_path):
    """Files of which the time to read grew with the square of their size."""
    (tmp_path / "README.txt").write_text("\n" * 60_000 + "(" + "1" * 60_000)
    (tmp_path / "x_par.txt").write_text("0\n")
    start = time.process_time()
    with pytest.raises(FormatError):
        mvcore.load(tmp_path)
    assert time.process_time() - start < 2
