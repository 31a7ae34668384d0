"""How CPU time and memory grow with the number of views, on a rendered street seen from a row of cameras.

    python benches/scaling.py [--views 50 100 200] [--size 1600x1200] [--max-memory 3G]

Each run is a process of its own. Printed are CPU seconds, peak resident memory beside that of an idle process, and between runs the
exponent k of CPU ~ views^k (1 is linear). Views are written as JPEG files, so images are decoded when they are needed.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

FOCAL = 0.9
"""In image widths."""

RUN = """
import json, resource, sys, time
import mvcore
from mvcore.pipeline.report import peak_memory
idle = peak_memory()
scene = mvcore.load(sys.argv[1])
bound = int(sys.argv[2]) or None
result = mvcore.reconstruct(scene, max_memory=bound, config={"depth": {"max_image_size": 4096}})
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({"cpu": used.ru_utime + used.ru_stime, "idle": idle, "peak": peak_memory(), "faces": len(result.faces),
                  "seconds": result.report["seconds"]}))
"""


def street(length: int):
    """Houses of boxes along a street: textured shapes of the procedural scenes, ``length`` metres."""
    from mvcore.network.procedural.shapes import _box, _superquadric, wall
    from mvcore.network.procedural.textures import random_tile

    random = np.random.default_rng(7)
    shapes = []
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for x in np.arange(-6.0, length + 6.0, 3.0):
        facade = wall(3.0, 4.0, (2.0, 2.0))
        shapes.append(facade.placed(1.0, np.eye(3), np.array([x, 0.0, 4.0 + random.uniform(-0.3, 0.3)])))
        shapes.append(_box(random).placed(0.5, np.eye(3), np.array([x + random.uniform(-1, 1), 0.8, 3.2])))
        shapes.append(_superquadric(random).placed(0.4, turn, np.array([x + random.uniform(-1, 1), -0.6, 3.0])))
    tiles = np.stack([random_tile(random, False) for _ in shapes])
    return shapes, tiles


def render(folder: Path, views: int, width: int, height: int) -> None:
    from mvcore import _core
    from mvcore.geometry.cameras import Camera

    shapes, tiles = street(int(views * 0.35) + 1)
    first = np.cumsum([0, *(len(s.vertices) for s in shapes)])
    vertices = np.ascontiguousarray(np.concatenate([s.vertices for s in shapes]))
    faces = np.concatenate([s.faces + np.uint32(n) for s, n in zip(shapes, first[:-1])])
    materials = np.concatenate([np.full(len(s.faces), n, np.uint16) for n, s in enumerate(shapes)])
    uv = np.concatenate([s.uv for s in shapes]).astype(np.float32)
    normals = np.concatenate([s.normals for s in shapes]).astype(np.float32)
    gloss = np.tile(np.array([0.45, 0.7, 0.0, 30.0, 0.0], np.float32), (len(shapes), 1))
    tiles = np.concatenate([tiles, tiles[:1]])
    k = np.array([[FOCAL * width, 0, (width - 1) / 2], [0, FOCAL * width, (height - 1) / 2], [0, 0, 1]])
    (folder / "images").mkdir(parents=True)
    entries = []
    for n in range(views):
        camera = Camera(k, np.eye(3), [-0.35 * n, 0.05 * (n % 2), 0.0], width, height)
        p = np.ascontiguousarray(camera.projection)[None]
        image = _core.shade(vertices, faces, uv, normals, materials, tiles, gloss, p, [0.3, -1.0, -1.0], width, height, 2)[0]
        name = f"images/{n:04d}.jpg"
        cv2.imwrite(str(folder / name), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        entries.append({"image": name, "width": width, "height": height, "K": k.tolist(), "R": np.eye(3).tolist(), "t": camera.t.tolist()})
    (folder / "cameras.json").write_text(json.dumps({"views": entries}))


def as_bytes(text: str) -> int:
    units = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
    return int(float(text[:-1]) * units[text[-1]]) if text[-1] in units else int(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--views", type=int, nargs="+", default=[50, 100, 200])
    parser.add_argument("--size", default="1600x1200")
    parser.add_argument("--max-memory", default="0", help="e.g. 3G; 0 for no bound")
    options = parser.parse_args()
    width, height = (int(n) for n in options.size.split("x"))
    before = None
    for views in options.views:
        with tempfile.TemporaryDirectory() as folder:
            render(Path(folder) / "scene", views, width, height)
            command = [sys.executable, "-c", RUN, str(Path(folder) / "scene"), str(as_bytes(options.max_memory))]
            done = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        above = (done["peak"] - done["idle"]) / 2**20
        line = f"{views:5d} views of {width} x {height}: {done['cpu']:8.1f} CPU s, {above:7.0f} MiB above idle, {done['faces']} faces"
        if before:
            ratio = views / before[0]
            line += f", exponent {np.log(done['cpu'] / before[1]) / np.log(ratio):.2f}"
            for stage, spent in done["seconds"].items():
                if spent["cpu"] > 0.02 * done["cpu"] and stage in before[2]:
                    exponent = np.log(spent["cpu"] / before[2][stage]["cpu"]) / np.log(ratio)
                    line += f"\n      {stage}: {spent['cpu']:.1f} CPU s, exponent {exponent:.2f}"
        print(line, flush=True)
        before = (views, done["cpu"], done["seconds"])


if __name__ == "__main__":
    main()
