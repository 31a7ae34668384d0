"""Files appear whole or not at all, whatever happens to their writer."""

import os
import subprocess
import sys
import threading

import pytest
from mvcore.io.files import atomically, fcntl, staged

locks = pytest.mark.skipif(fcntl is None, reason="folders are not locked here")
WRITER = """
import sys, time
from pathlib import Path
from mvcore.io.files import atomically
def write(path):
    path.write_text("half")
    print("writing", flush=True)
    time.sleep(60)
atomically(Path(sys.argv[1]), write)
"""


@pytest.fixture
def writer(tmp_path):
    """Another process that is busy writing a file."""
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path / "a.txt")], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "writing\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def write(text):
    return lambda p: p.write_text(text) and None


@locks
def test_what_a_killed_writer_left_is_gone_after_the_next(tmp_path, writer):
    writer.kill()
    writer.wait()
    assert names(tmp_path) == [".a.txt.mvcore-part"]
    atomically(tmp_path / "a.txt", write("whole"))
    assert names(tmp_path) == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "whole"


@locks
def test_a_busy_writer_is_not_disturbed(tmp_path, writer):
    atomically(tmp_path / "a.txt", write("ours"))
    assert (tmp_path / "a.txt").read_text() == "ours"
    assert (tmp_path / ".a.txt.mvcore-part" / "a.txt").read_text() == "half"
    assert names(tmp_path) == [".a.txt.mvcore-part", "a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail(p):
        p.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        atomically(path, fail)
    assert names(tmp_path) == ["a.txt"]
    assert path.read_text() == "old"


@locks
def test_a_folder_that_was_left_is_empty_when_it_is_taken_over(tmp_path):
    left = tmp_path / ".model.obj.mvcore-part"
    (left / "deep").mkdir(parents=True)
    (left / "deep" / "x").write_text("x")
    (left / "link").symlink_to(tmp_path)
    with staged(tmp_path / "model.obj") as folder:
        assert folder == left
        assert not list(folder.iterdir())
    assert not names(tmp_path)


@locks
def test_a_link_in_the_folders_place_is_not_followed(tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "precious").write_text("x")
    (tmp_path / ".a.txt.mvcore-part").symlink_to(elsewhere)
    atomically(tmp_path / "a.txt", write("whole"))
    assert (tmp_path / "a.txt").read_text() == "whole"
    assert names(elsewhere) == ["precious"]
    assert names(tmp_path) == [".a.txt.mvcore-part", "a.txt", "elsewhere"]


def test_many_writers_of_one_file(tmp_path):
    path = tmp_path / "a.txt"
    texts = [f"{n}" * 4000 for n in range(8)]
    threads = [threading.Thread(target=lambda t=t: [atomically(path, write(t)) for _ in range(50)]) for t in texts]
    for thread in threads:
        thread.start()
    while any(t.is_alive() for t in threads):
        if path.exists():
            assert path.read_text() in texts
    assert names(tmp_path) == ["a.txt"]
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask
