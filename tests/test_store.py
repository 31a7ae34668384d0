"""Stored results: what is read is what was written, or nothing; what a run uses stays."""

import hashlib
import json
import logging
import os
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mvcore import InvalidInputError
from mvcore.cli.main import app
from mvcore.io.files import fcntl
from mvcore.pipeline import container
from mvcore.pipeline.store import Store, digest
from typer.testing import CliRunner

FLIPS = int(os.environ.get("MVCORE_FLIPS", "300"))
"""Random bits turned over; 10,000 take about half a minute."""
locks = pytest.mark.skipif(fcntl is None, reason="files are not locked here")

RNG = np.random.default_rng(7)
ENTRIES = [
    ({"depth": RNG.normal(size=(13, 7)).astype(np.float32), "mask": RNG.random((9, 5)) > 0.5}, {"warnings": ["näher"], "n": 3}),
    ({"faces": RNG.integers(0, 99, (40, 3)).astype(np.uint32), "none": np.zeros((0, 3)), "one": np.float64(2.5)}, {}),
    ({}, {"empty": True, "nested": {"a": [1, 2.5, None]}}),
    ({"names": np.array(["left", "right"]), "far": np.arange(6, dtype=">i2").reshape(2, 3)}, {}),
]


def same(entry, arrays, meta) -> bool:
    """Whether an entry is what was saved: types, shapes, bytes and plain values."""
    return entry.meta == meta and {n: (a.dtype, a.shape, a.tobytes()) for n, a in entry.arrays.items()} == {
        n: (np.asarray(a).dtype, np.shape(a), np.asarray(a).tobytes()) for n, a in arrays.items()
    }


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "work")


@given(
    st.dictionaries(
        st.text(max_size=5),
        hnp.arrays(st.sampled_from([np.uint8, np.float32, np.bool_, ">f8"]), hnp.array_shapes(min_dims=0, min_side=0)),
        max_size=3,
    )
)
def test_what_is_saved_comes_back(tmp_path_factory, arrays):
    store = Store(tmp_path_factory.getbasetemp() / "come-back")
    key = digest(arrays)
    store.save(key, arrays, {"n": 1})
    assert same(store.load(key), arrays, {"n": 1})


def test_objects_are_refused(store):
    with pytest.raises(InvalidInputError, match="numbers, booleans or text"):
        store.save("ab12", {"x": np.array([object()])}, {})
    with pytest.raises(InvalidInputError, match="key"):
        store.save("../../ab12", {}, {})


def test_single_arrays_are_read_and_checked_alone(store):
    arrays = {"small": np.arange(5), "large": RNG.random(300_000), "other": np.ones(400_000)}
    store.save("ab12", arrays, {"n": 1})
    data = bytearray(store.path("ab12").read_bytes())
    data[-9] ^= 4  # in the last array
    store.path("ab12").write_bytes(data)
    assert same(store.load("ab12", ("small",)), {"small": arrays["small"]}, {"n": 1})
    mapped = store.load("ab12", ("large",), mapped=True).arrays["large"]
    assert (mapped == arrays["large"]).all()
    assert not mapped.flags.writeable
    assert store.load("ab12", ()).arrays == {}
    with pytest.raises(InvalidInputError, match="small, large, other, got larger"):
        store.load("ab12", ("larger",))
    assert not store.intact("ab12")
    assert "ab12" not in store


def test_turned_bits_never_give_a_wrong_result(store, caplog):
    rng = np.random.default_rng(3)
    keys = [digest(n) for n in range(len(ENTRIES))]
    wholes = []
    for key, (arrays, meta) in zip(keys, ENTRIES):
        store.save(key, arrays, meta)
        wholes.append(store.path(key).read_bytes())
    found = 0
    for _ in range(FLIPS):
        n = rng.integers(len(keys))
        data = bytearray(wholes[n])
        bit = rng.integers(8 * len(data))
        data[bit // 8] ^= 1 << (bit % 8)
        path = store.path(keys[n])
        path.write_bytes(data)
        caplog.clear()
        entry = store.load(keys[n], mapped=bool(rng.integers(2)))
        if entry is None:
            assert str(path) in caplog.text
            assert keys[n] not in store
            found += 1
        else:  # between two arrays nothing is written
            assert same(entry, *ENTRIES[n])
    assert found > 0.7 * FLIPS


@pytest.mark.parametrize("n", range(len(ENTRIES)))
def test_files_that_are_cut_off_or_longer_are_none(store, n):
    store.save("ab12", *ENTRIES[n])
    whole = store.path("ab12").read_bytes()
    for end in {0, 1, 7, 8, 40, 48, *range(0, len(whole), 61), len(whole) - 1}:
        store.path("ab12").write_bytes(whole[:end])
        assert store.load("ab12") is None
    store.path("ab12").write_bytes(whole + b"\0")
    assert store.load("ab12") is None


def forged(header: bytes, body: bytes = b"") -> bytes:
    """A file with right digests of a header of one's choice."""
    start = container.MAGIC + struct.pack("<Q", len(header))
    data = start + hashlib.blake2b(start + header, digest_size=container.DIGEST).digest() + header
    return data + bytes(-len(data) % container.ALIGNMENT) + body


TABLE = {"name": "x", "type": "<f8", "shape": [1], "digest": hashlib.blake2b(bytes(8), digest_size=container.DIGEST).hexdigest()}
HOSTILE = [
    b"",
    b"[]",
    b"[" * 100_000,
    b"{}",
    b'"key"',
    b"\xff\xfe",
    *(
        json.dumps({"key": "ab12", "meta": {}, "arrays": arrays}).encode()
        for arrays in (
            3,
            {"x": 1},
            [3],
            [{}],
            [TABLE | {"shape": [1 << 62]}],
            [TABLE | {"shape": [1 << 70, 1 << 70]}],
            [TABLE | {"shape": [-1]}],
            [TABLE | {"shape": [1e400]}],
            [TABLE | {"shape": None}],
            [TABLE | {"type": "O"}],
            [TABLE | {"type": "no such"}],
            [TABLE | {"type": "<f4"}],
            [TABLE | {"type": "V8"}],
            [TABLE | {"digest": "0"}],
        )
    ),
    json.dumps({"key": "ab13", "meta": {}, "arrays": [TABLE]}).encode(),
]


@pytest.mark.parametrize("header", HOSTILE, ids=lambda h: h[-60:].decode(errors="replace"))
def test_forged_headers_are_none(store, header, caplog):
    path = store.path("ab12")
    path.parent.mkdir()
    right = json.dumps({"key": "ab12", "meta": {}, "arrays": [TABLE]}).encode()
    path.write_bytes(forged(right, bytes(8)))
    assert store.load("ab12").arrays["x"].tolist() == [0.0]
    path.write_bytes(forged(header, bytes(8)))
    assert store.load("ab12") is None
    assert str(path) in caplog.text
    assert not path.exists()


def test_what_is_no_file_of_ours_is_replaced(store, tmp_path):
    path = store.path("ab12")
    path.parent.mkdir()
    (tmp_path / "elsewhere").write_text("kept")
    for make in (path.mkdir, lambda: path.symlink_to(tmp_path / "elsewhere"), lambda: path.write_bytes(b"PK\x03\x04" + bytes(99))):
        make()
        assert store.load("ab12") is None
        make()
        store.save("ab12", {}, {"n": 1})
        assert store.load("ab12").meta == {"n": 1}
        path.unlink()
    assert (tmp_path / "elsewhere").read_text() == "kept"
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        assert "ab12" not in store
        assert store.load("ab12") is None


def test_another_works_result_is_not_taken(store):
    store.save("ab12", {"x": np.arange(3)}, {})
    os.replace(store.path("ab12"), store.path("ab13"))
    assert store.load("ab13") is None


def test_a_damaged_entry_is_removed_but_not_the_one_that_took_its_place(store, monkeypatch):
    store.save("ab12", {}, {"n": 1})
    real = container.read

    def read(*arguments):
        with pytest.raises(container.Damaged) as caught:
            real(*arguments)
        Store(store.folder).save("ab12", {}, {"n": 2})  # another run is quicker
        raise caught.value

    store.path("ab12").write_bytes(b"nonsense" * 20)
    monkeypatch.setattr(container, "read", read)
    assert store.load("ab12") is None
    monkeypatch.undo()
    assert store.load("ab12").meta == {"n": 2}


RUN = """
import sys
from mvcore.pipeline.store import Store
store = Store(sys.argv[1])
with store.lease():
    print(store.load("used0").meta["n"], flush=True)
    sys.stdin.readline()
"""


def keys(store):
    return sorted(p.stem for p in store.folder.glob("??/*.entry"))


def age(store, key, seconds):
    """As if it had last been used some seconds ago."""
    os.utime(store.path(key), (time.time() - seconds, time.time() - seconds))


@locks
def test_clean_keeps_what_a_live_run_uses(store):
    for n in range(4):
        for name in ("used", "left"):
            store.save(f"{name}{n}", {"x": np.zeros(1000, np.uint8)}, {"n": n})
            age(store, f"{name}{n}", 7200 + n)
    run = subprocess.Popen([sys.executable, "-c", RUN, store.folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert run.stdout.readline() == "0\n"
        assert "used1" in store  # asked for by any process while a run goes on
        cleaned = store.clean()
        assert (cleaned.removed, cleaned.left, cleaned.runs) == (6, 2, 1)
        assert cleaned.removed_bytes > 6000
        assert keys(store) == ["used0", "used1"]
    finally:
        run.kill()  # without a chance to say good-bye
        run.wait()
        run.stdin.close()
        run.stdout.close()
    cleaned = store.clean()
    assert (cleaned.removed, cleaned.left, cleaned.runs) == (2, 0, 0)
    assert keys(store) == []


@locks
def test_what_another_run_may_need_is_not_dropped(store):
    store.save("used0", {}, {"n": 0})
    store.save("left0", {}, {"n": 1})
    with store.lease():
        store.drop("left0")  # ours is the only run
        assert keys(store) == ["used0"]
        with Store(store.folder).lease():
            store.drop("used0")
            assert keys(store) == ["used0"]
        store.drop("used0")
        store.drop("used0")
        assert keys(store) == []


def test_clean_by_age_and_by_size_takes_the_longest_unused_first(store):
    for n in range(6):
        store.save(f"entry{n}", {"x": np.zeros(10_000, np.uint8)}, {})
        age(store, f"entry{n}", 1000 * n)
    size = store.path("entry0").stat().st_size
    assert store.clean(max_age=4500).removed == 1
    assert keys(store) == [f"entry{n}" for n in range(5)]
    written = store.path("entry4").stat().st_mtime_ns
    assert store.load("entry4") is not None  # used now, so it is the newest
    assert store.path("entry4").stat().st_mtime_ns == written
    cleaned = store.clean(max_bytes=3 * size)
    assert (cleaned.removed, cleaned.left_bytes) == (2, 3 * size)
    assert keys(store) == ["entry0", "entry1", "entry4"]
    assert store.clean(max_age=9e9, max_bytes=9 * size).removed == 0


def test_an_entry_used_while_clean_looks_at_it_goes_back(store, monkeypatch):
    store.save("entry0", {}, {"n": 1})
    age(store, "entry0", 100)
    entries = list(store._entries())
    assert "entry0" in store
    monkeypatch.setattr(store, "_entries", lambda: iter(entries))
    assert store.clean().removed == 0
    assert store.load("entry0").meta == {"n": 1}


def test_a_reader_waits_while_clean_has_an_entry_aside(store):
    store.save("entry0", {}, {"n": 1})
    path = store.path("entry0")
    aside = path.with_name(f".{path.name}")
    path.rename(aside)
    back = threading.Timer(0.1, aside.rename, [path])
    back.start()
    assert store.load("entry0").meta == {"n": 1}
    back.join()


def test_clean_removes_what_killed_writers_left_and_nothing_foreign(store):
    store.save("entry0", {}, {})
    folder = store.path("entry0").parent
    left, busy = folder / ".entry1.entry.mvcore-part", folder / ".entry2.entry.mvcore-part-x"
    for part in (left, busy):
        part.mkdir()
        (part / "half").write_text("x")
    os.utime(left, (0, 0))
    (folder / "notes.txt").write_text("mine")
    (store.folder / "notes.txt").write_text("mine")
    store.clean()
    assert not left.exists()
    assert busy.exists()  # too young to tell
    assert (folder / "notes.txt").exists()
    assert (store.folder / "notes.txt").exists()


def test_the_command(store):
    def run(*arguments):
        return CliRunner().invoke(app, ["clean", str(store.folder), *arguments])

    for n in range(3):
        store.save(f"entry{n}", {"x": np.zeros(100_000, np.uint8)}, {})
        age(store, f"entry{n}", 86400 * 4 * n)
    done = run("--older-than", "7d")
    assert done.exit_code == 0, done.output
    assert "removed 1 results (0.1 MB)" in done.output
    assert run("--max-size", "150k").exit_code == 0
    assert keys(store) == ["entry0"]
    for wrong, text in [(("--older-than", "soon"), "such as 7d"), (("--max-size", "2X"), "such as 4G")]:
        done = run(*wrong)
        assert done.exit_code == 2
        assert text in done.output
    assert run().exit_code == 0
    assert keys(store) == []
    done = CliRunner().invoke(app, ["clean", str(store.folder / "missing")])
    assert done.exit_code == 2
    assert not (store.folder / "missing").exists()


def test_warnings_are_logged_and_kept(caplog):
    from mvcore.types import Report

    report = Report()
    with caplog.at_level(logging.WARNING, "mvcore"):
        report.warn("voxels grew")
    assert report.warnings == ["voxels grew"]
    assert caplog.record_tuples == [("mvcore", logging.WARNING, "voxels grew")]


def test_the_library_configures_no_logging():
    code = "import logging, mvcore.types as t; t.Report().warn('hidden'); print(logging.getLogger().handlers)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")
