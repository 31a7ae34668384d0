import json
import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import mvcore
import numpy as np
import pytest
from hypothesis import settings

settings.register_profile("mvcore", deadline=None)  # machines are noisy: no timings in tests
settings.load_profile("mvcore")

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"


@pytest.fixture
def shared() -> Path:
    """The evaluation data beside the checkout; tests that need it skip without it."""
    if not SHARED.is_dir():
        pytest.skip("no evaluation data beside the checkout")
    return SHARED


@pytest.fixture(scope="session")
def sample() -> Path:
    return ROOT / "python" / "mvcore" / "cli" / "sample"


def look_at(center, target, size=(240, 180), focal=225.0, up=(0.0, 0.0, 1.0)) -> mvcore.Camera:
    center, target = np.asarray(center, float), np.asarray(target, float)
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    r = np.stack([x, np.cross(z, x), z])
    k = [[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]]
    return mvcore.Camera(K=k, R=r, t=-r @ center, width=size[0], height=size[1])


def texture_of(points) -> np.ndarray:
    """A texture in space: sums of sines of many directions, (n, 3) uint8."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(40, 3)) * rng.uniform(4, 26, (40, 1))
    phase, colour = rng.uniform(0, 6.28, 40), rng.uniform(0.3, 1, (40, 3))
    value = np.sin(points @ waves.T + phase) @ colour
    return np.clip(128 + 24 * value, 0, 255).astype(np.uint8)


def render_sphere(camera: mvcore.Camera, radius=0.5):
    """A textured sphere at the origin before a textured wall far behind: image (h, w, 3), depth (h, w), mask (h, w)."""
    grid = camera.pixel_grid().reshape(-1, 2)
    rays = np.column_stack([grid, np.ones(len(grid))]) @ np.linalg.inv(camera.K).T @ camera.R
    o = camera.center
    a, b, c = (rays**2).sum(1), rays @ o, o @ o - radius**2
    root = b * b - a * c
    hit = root > 0
    s = np.where(hit, (-b - np.sqrt(root.clip(0))) / a, 6.0)
    image = texture_of(o + rays * s[:, None])
    shape = (camera.height, camera.width)
    return image.reshape(*shape, 3), np.where(hit, s, 0).reshape(shape), hit.reshape(shape)


BALLS = [((0.0, 0.0, 0.0), 0.4), ((0.35, 0.1, 0.15), 0.25), ((-0.1, 0.35, -0.2), 0.22)]


def render_target(camera: mvcore.Camera, pose=None, wall=6.0):
    """Three textured balls grown together, moved by ``pose`` (4, 4), before the same wall; without a pose the wall alone."""
    grid = camera.pixel_grid().reshape(-1, 2)
    rays = np.column_stack([grid, np.ones(len(grid))]) @ np.linalg.inv(camera.K).T @ camera.R
    o, s = camera.center, np.full(len(grid), wall)
    back = np.eye(4) if pose is None else np.linalg.inv(pose)
    hit = np.zeros(len(grid), bool)
    for center, radius in BALLS if pose is not None else ():
        to = o - (pose[:3, :3] @ center + pose[:3, 3])
        a, b, c = (rays**2).sum(1), rays @ to, to @ to - radius**2
        root = b * b - a * c
        near = (-b - np.sqrt(root.clip(0))) / a
        closer = (root > 0) & (near < s)
        s[closer] = near[closer]
        hit |= closer
    points = o + rays * s[:, None]
    own = points @ back[:3, :3].T + back[:3, 3]
    paint = (texture_of(own) * [0.55, 0.4, 0.25] + [110, 80, 10]).astype(np.uint8)  # orange, so that masks can be found
    image = np.where(hit[:, None], paint, texture_of(points * 0.2 + 3) // 2 + 20)
    shape = (camera.height, camera.width)
    return image.reshape(*shape, 3), hit.reshape(shape)


def turned(angle: float, shift) -> np.ndarray:
    """A pose: a turn about z in degrees, then a shift."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, -s, 0, shift[0]], [s, c, 0, shift[1]], [0, 0, 1, shift[2]], [0, 0, 0, 1]])


def write_clips(folder: Path, cameras, poses, plates=True) -> Path:
    """A folder of image clips of `render_target` with its calibration."""
    views = []
    for n, c in enumerate(cameras):
        own = folder / "images" / f"cam{n:02d}"
        own.mkdir(parents=True)
        for t, pose in enumerate(poses):
            cv2.imwrite(str(own / f"frame{t:04d}.png"), render_target(c, pose)[0][..., ::-1])
        if plates:
            cv2.imwrite(str(own / "background.png"), render_target(c)[0][..., ::-1])
        view = {"name": f"cam{n:02d}", "width": c.width, "height": c.height}
        views.append(view | {"K": c.K.tolist(), "R": c.R.tolist(), "t": c.t.tolist()})
    (folder / "cameras.json").write_text(json.dumps({"views": views}))
    return folder


def rig(count=12, size=(160, 120)):
    """Cameras around the origin, all of which see a target of some size there."""
    angles = 2 * np.pi * np.arange(count) / count
    focal = 1.3 * size[0]
    return [look_at((2.6 * np.cos(a), 2.6 * np.sin(a), 0.9 * (i % 2)), (0, 0, 0), size, focal) for i, a in enumerate(angles)]


@pytest.fixture(scope="session")
def ring():
    """Twelve views around a textured sphere: cameras, images, depths, masks."""
    angles = np.radians(np.arange(0, 360, 30))
    cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 0.6 * (i % 2)), (0, 0, 0)) for i, a in enumerate(angles)]
    images, depths, masks = zip(*(render_sphere(c) for c in cameras))
    return cameras, list(images), list(depths), list(masks)


def write_scene(folder: Path, cameras, images) -> Path:
    (folder / "images").mkdir(parents=True)
    views = []
    for n, (c, image) in enumerate(zip(cameras, images)):
        name = f"images/{n:03d}.png"
        cv2.imwrite(str(folder / name), np.asarray(image)[..., ::-1])
        view = {"image": name, "width": c.width, "height": c.height}
        views.append(view | {"K": c.K.tolist(), "R": c.R.tolist(), "t": c.t.tolist()})
    (folder / "cameras.json").write_text(json.dumps({"views": views}))
    return folder


# ---- clusters

ALLOWED = "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES"


class Network:
    """A scheduler and workers, each a process of this machine."""

    def __init__(self, folder, *options):
        self.folder, self.options, self.processes = folder, options, []
        self.environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), ALLOWED: "1"}
        where = folder / "scheduler.json"
        self.scheduler = self._start("dask_scheduler", "--port", "0", "--host", "127.0.0.1", "--scheduler-file", where)
        for _ in range(600):
            if where.exists() and where.stat().st_size:
                break
            assert self.scheduler.poll() is None
            time.sleep(0.1)
        self.address = json.loads(where.read_text())["address"]

    def _start(self, module, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.{module}", *map(str, arguments), *self.options, "--no-dashboard"]
        process = subprocess.Popen(command, env=self.environment, cwd=self.folder, stderr=subprocess.DEVNULL)
        self.processes.append(process)
        return process

    def work(self, count):
        return [self._start("dask_worker", "--nthreads", "1", "--no-nanny", self.address) for _ in range(count)]

    def end(self):
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def network(tmp_path):
    pytest.importorskip("distributed")
    made = Network(tmp_path)
    yield made
    made.end()
