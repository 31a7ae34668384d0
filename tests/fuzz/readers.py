"""Every reader on mutated files: ``python -m fuzz.readers --seconds 60`` in the folder ``tests``."""

from __future__ import annotations

import argparse
import random
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mvcore
from mvcore import Config, _core
from mvcore.evaluation.metrics import load_geometry
from mvcore.io import streams
from mvcore.io.formats import detect
from mvcore.io.formats.records import to_scene
from mvcore.io.images import read_image, read_mask
from mvcore.io.maps import read_pfm
from mvcore.nurbs.obj import load_obj
from mvcore.pipeline.store import Store
from mvcore.viewer.page import write_page

from . import runner, seeds
from .mutate import mutated

CALIBRATIONS = (".txt", ".json", ".yml", ".yaml", ".xml", ".toml", ".csv", ".npz", ".bin", ".camera", ".npy", ".out", ".nvm", ".sfm", "")
"""Suffixes of the files of a data set that are mutated."""
WHOLE = 8
"""One of so many cases of a data set goes through `mvcore.load`, which asks all readers; the others through the one that reads it."""


@dataclass(frozen=True)
class Target:
    """A file to mutate, and what reads it: in short, and as a user's call does."""

    name: str
    file: Path
    read: Callable[[], object]
    whole: Callable[[], object]


def targets(folder: Path) -> list[Target]:
    """Every file of every seed."""
    out = []
    for name, scene in seeds.scenes(folder).items():
        load = lambda scene=scene: mvcore.load(scene)  # noqa: E731
        short = _reader(scene)
        for file in sorted(f for f in scene.rglob("*") if f.is_file() and f.suffix in CALIBRATIONS):
            out.append(Target(f"{name}/{file.relative_to(scene)}", file, short, load))
    single = seeds.files(folder / "files")
    read = {"pfm": read_pfm, "nurbs": load_obj, "index": lambda f: write_page(f.parent), "settings": Config.from_file}
    read |= dict.fromkeys(("glb", "ply", "binary ply", "stl", "off", "obj"), load_geometry)
    read |= dict.fromkeys(seeds.IMAGES, lambda f: (read_image(f), read_mask(f)))
    read |= dict.fromkeys(seeds.VIDEOS, _frames)
    store = Store(folder / "files" / "store")
    read["store"] = lambda _: store.load(seeds.KEY)
    calls = [(name, file, lambda name=name, file=file: read[name](file)) for name, file in single.items()]
    calls.append(("core obj", single["obj"], lambda: _core.read_obj(str(single["obj"]))))
    return [*out, *(Target(name, file, call, call) for name, file, call in calls)]


def _reader(scene: Path) -> Callable[[], object]:
    """What `mvcore.load` does with a data set once it knows the format, cameras alone."""
    name = mvcore.load(scene).format
    reader = next(r for r in detect.READERS if r.name == name)

    def read() -> object:
        at = detect._guarded(reader, reader.find, scene)
        if at is None:
            return None
        found = detect._guarded(reader, reader.read, at, *([None] if reader.lists_images else []))
        return to_scene(found, need_images=False, given=scene)

    return read


def _frames(path: Path) -> object:
    stream = streams.open_stream(path)
    return [streams.video_frame(path, n) for n in sorted({0, len(stream) - 1})]


class Fuzzer:
    """Cases by number: the same number mutates the same file in the same way."""

    def __init__(self, folder: Path, seed: int, only: str = "") -> None:
        self.targets = [t for t in targets(folder) if only in t.name]
        self.data = [t.file.read_bytes() for t in self.targets]
        self.seed = seed

    def content(self, number: int) -> tuple[Target, bytes]:
        """The target and the mutated file of a case."""
        source = random.Random(zlib.crc32(f"{self.seed} {number}".encode()))
        at = number % len(self.targets)
        return self.targets[at], mutated(self.data[at], source.choice(self.data), source)

    def __call__(self, number: int) -> None:
        """Run a case."""
        target, content = self.content(number)
        # Another process may still hold a crashed case's file: it is put in place whole.
        target.file.unlink(missing_ok=True)
        target.file.write_bytes(content)
        try:
            (target.read if number // len(self.targets) % WHOLE else target.whole)()
        finally:
            target.file.write_bytes(self.data[number % len(self.targets)])


def main() -> int:
    """Run for a time, report, and keep a file of each kind of failure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--count", type=int, default=10**9)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a target's name")
    parser.add_argument("--keep", type=Path, help="folder for the files that failed")
    options = parser.parse_args()
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        fuzzer = Fuzzer(Path(folder), options.seed, options.only)
        outcome = runner.run(fuzzer, options.count, options.seconds, options.first)
        print(outcome)
        for n, (what, numbers) in enumerate(outcome.failures.items()):
            target, content = fuzzer.content(numbers[0])
            print(f"case {numbers[0]} ({target.name}): {what}")
            if options.keep:
                options.keep.mkdir(parents=True, exist_ok=True)
                (options.keep / f"{n:03d}-{target.file.name}").write_bytes(content)
    return 1 if outcome.failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
