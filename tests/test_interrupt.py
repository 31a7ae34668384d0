"""Ctrl-C ends kernels within two seconds, in the main thread and in others, and nothing is left behind."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest
from mvcore import _core
from mvcore.errors import Interrupted

posix = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")

# Each makes its arrays, says that it starts, and calls a kernel that takes far longer than a test may.
KERNELS = {
    "sweep": """
        image = rng.integers(0, 255, (1200, 1600), np.uint8)
        maps = np.tile(np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0]], np.float32), (8, 1))
        start(); _core.sweep(image, [image] * 8, maps, np.linspace(0, 200, 255).astype(np.float32))
    """,
    "aggregate": """
        costs = np.zeros((2000, 3000, 255), np.uint8)  # no memory is touched but to read
        start(); _core.aggregate(costs, costs[:, :, 0].copy(), 6, 40, 8)
    """,
    "refine": """
        image = rng.integers(0, 255, (1200, 1600), np.uint8)
        maps = np.tile(np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0]], np.float32), (8, 1))
        prior = np.ones(image.shape, np.float32)
        settings = dict(low=0.0, high=99.0, step=1.0, max_slope=9.0, prior_weight=0.1, prior_reach=3.0, geometry_weight=0.0, adjacent=True)
        empty, init = np.zeros((0, 12), np.float32), np.zeros((*image.shape, 4), np.float32)
        start(); _core.refine(image, [image] * 8, maps, [], empty, init, prior, iterations=200, **settings)
    """,
    "match_epipolar": """
        positions = rng.random((200_000, 2), np.float32)
        descriptors = rng.integers(0, 255, (200_000, 128), np.uint8)
        start(); _core.match_epipolar(positions, descriptors, positions, descriptors, np.eye(3), np.inf, 0.8)
    """,
    "carve": """
        masks = [rng.integers(0, 2, (999, 999), np.uint8)] * 60
        matrices = np.tile(np.array([[[900, 0, 300, 900], [0, 900, 300, 900], [0, 0, 1, 2.0]]]), (60, 1, 1))
        start(); _core.carve([0, 0, 0], 0.001, [1200, 1200, 1200], masks, matrices, tolerance=0.9, least_views=1)
    """,
    "nearest": """
        points = rng.random((2_000_000, 3))
        start(); [_core.nearest(points, points[:200_000]) for _ in range(99)]
    """,
}
SCRIPT = """
import signal, sys, time
import numpy as np
from mvcore import _core
rng = np.random.default_rng(0)
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background inherit that it is ignored
def start():
    print("start", flush=True)
try:
    {body}
except KeyboardInterrupt:
    print("interrupted", flush=True)
# The process goes on as if nothing had been.
image = rng.integers(0, 255, (40, 60, 3), np.uint8)
assert _core.encode_png(image)
print("alive", flush=True)
"""


@posix
@pytest.mark.parametrize("kernel", KERNELS)
def test_ctrl_c_ends_a_kernel(kernel):
    body = textwrap.indent(textwrap.dedent(KERNELS[kernel]).strip(), "    ").strip()
    process = subprocess.Popen([sys.executable, "-c", SCRIPT.format(body=body)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "start\n"
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        begun = time.monotonic()
        assert process.stdout.readline() == "interrupted\n"
        assert time.monotonic() - begun < 2.0
        assert process.stdout.readline() == "alive\n"
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def small_calls():
    """Every kernel with long loops, on next to nothing."""
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 255, (24, 32), np.uint8)
    rgb = np.ascontiguousarray(np.repeat(grey[..., None], 3, 2))
    ones, flat = np.ones((24, 32), np.float32), np.zeros((24, 32), np.uint8)
    shift = np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0]], np.float32)
    planes = np.linspace(0, 5, 8).astype(np.float32)
    costs = rng.integers(0, 60, (24, 32, 8), np.uint8)
    depth_settings = {"low": 0.0, "high": 9.0, "step": 1.0, "max_slope": 9.0, "prior_weight": 0.1, "prior_reach": 3.0}
    features = rng.random((24, 32, 8), np.float32)
    matrix = np.array([[30.0, 0, 16, 16], [0, 30.0, 12, 12], [0, 0, 1, 2]])
    matrices = matrix[None]
    fusing = {"truncation": 0.3, "free_weight": 1.0, "min_weight": 0.0, "solid_weight": 1.0, "smoothing": 1.0, "measured_smoothing": 0.5}
    fusing |= {"hull_tolerance": 0.0, "max_memory": 1 << 30}
    window = [(0.0, 0.0, 31.0, 23.0)]
    box = ([-0.5, -0.5, 0.5], 0.05, [20, 20, 20])
    ball = (np.linalg.norm(np.mgrid[:20, :20, :20] - 9.5, axis=0) - 6).astype(np.float32)
    vertices, faces = _core.isosurface_dense(ball)
    vertices = np.ascontiguousarray(vertices.astype(np.float64) / 10 - 0.95)
    faces = np.ascontiguousarray(faces)
    opened = np.ascontiguousarray(faces[3:])
    blocks = np.ascontiguousarray(np.argwhere(np.ones((2, 2, 2))).astype(np.uint32))
    samples = rng.normal(size=(8, 8, 8, 8)).astype(np.float32)
    n, count = len(vertices), len(faces)
    lists = np.zeros((count, 1), np.int16), np.ones((count, 1), np.float32), np.zeros((count, 1, 3), np.uint8)
    gains = np.ones((1, 3), np.float32)

    def build_atlas():
        atlas = _core.Atlas(vertices, faces, labels, matrices)
        atlas.add_view(0, rgb)
        return atlas.finish(gains)

    labels = np.zeros(count, np.int32)
    shading = (np.zeros((n, 2), np.float32), np.zeros((n, 3), np.float32), np.zeros(count, np.uint16))
    tiles, gloss = np.zeros((2, 8, 8, 3), np.uint8), np.zeros((1, 5), np.float32)
    two, empty = rng.integers(0, 255, (9, 128), np.uint8), np.zeros((0, 12), np.float32)
    init = np.zeros((24, 32, 4), np.float32)
    positions = rng.random((9, 2), np.float32)
    occupied = np.ones((20, 20, 20), bool)
    median = {"radius": 2, "step": 1, "colour": 9.0, "distance": 2.0, "slack": 0.0}
    return {
        "sweep": lambda: _core.sweep(grey, [grey], shift, planes),
        "aggregate": lambda: _core.aggregate(costs, grey, 6, 40, 8),
        "refine": lambda: _core.refine(
            grey, [grey], shift, [], empty, init, ones, iterations=1, geometry_weight=0.0, adjacent=True, **depth_settings
        ),
        "weighted_median": lambda: _core.weighted_median(ones, rgb, flat, **median),
        "correlate": lambda: _core.correlate(features, [features], shift, planes, np.ones(2, np.float32), 0.0),
        "match_epipolar": lambda: _core.match_epipolar(positions, two, positions, two, np.eye(3), np.inf, 0.8),
        "consistency": lambda: _core.consistency(ones, [ones], shift, shift, 1, 0.5, 0.01),
        "fuse": lambda: _core.fuse(*box, [ones], [ones], None, window, matrices, **fusing),
        "fuse with a hull": lambda: _core.fuse(*box, [0 * ones], [ones], [-ones], window, matrices, hollow=True, **fusing),
        "carve": lambda: _core.carve(*box, [flat], matrices, tolerance=0.0, least_views=1),
        "photo_carve": lambda: _core.photo_carve(
            *box[:2], occupied, [rgb] * 2, [rgb] * 2, np.repeat(matrices, 2, 0), [[0, 0, -2.0]] * 2, threshold=9, least_views=2, rounds=1
        ),
        "isosurface_dense": lambda: _core.isosurface_dense(ball),
        "isosurface_sparse": lambda: _core.isosurface_sparse(blocks, samples),
        "close_holes": lambda: _core.close_holes(vertices, opened, 50),
        "decimate": lambda: _core.decimate(vertices, opened, 0.1),
        "nearest": lambda: _core.nearest(vertices, vertices),
        "rasterize": lambda: _core.rasterize(vertices, faces, matrix, 32, 24),
        "select_views": lambda: _core.select_views(vertices, faces, *lists, gains, 1.0, 0.5, 0.0, 2),
        "Atlas": build_atlas,
        "shade": lambda: _core.shade(vertices, faces, *shading, tiles, gloss, matrices, [0.0, 0, 1], 32, 24),
    }


def test_every_kernel_with_long_loops_looks_for_its_flag():
    calls, ended = small_calls(), {}
    for call in calls.values():
        call()  # it does work

    def run():
        flag = _core.Interrupt()
        flag.enter()
        flag.set()
        for name, call in calls.items():
            try:
                ended[name] = call()
            except Interrupted:
                ended[name] = "interrupted"

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert [name for name in calls if not isinstance(ended[name], str)] == []


def big():
    rng = np.random.default_rng(0)
    costs = rng.integers(0, 60, (600, 800, 128), np.uint8)
    return costs, np.ascontiguousarray(costs[:, :, 0])


def test_other_threads_end_by_their_flag_and_by_no_other():
    costs, guide = big()
    ours, others = _core.Interrupt(), _core.Interrupt()
    results = {}

    def run(name, flag):
        flag.enter()
        try:
            for _ in range(1000 if flag is ours else 1):
                results[name] = _core.aggregate(costs, guide, 6, 40, 8)
        except Interrupted as error:
            results[name] = error

    threads = [threading.Thread(target=run, args=(n, flag)) for n, flag in (("a", ours), ("b", ours), ("c", others))]
    for thread in threads:
        thread.start()
    time.sleep(0.3)
    ours.set()
    for thread in threads:
        thread.join(60)
    assert isinstance(results["a"], Interrupted)
    assert isinstance(results["b"], Interrupted)
    # What was not interrupted is the same, bit by bit, as in the main thread.
    for left, right in zip(results["c"], _core.aggregate(costs, guide, 6, 40, 8)):
        assert left.tobytes() == right.tobytes()


@posix
def test_other_handlers_run_and_their_exceptions_come_through():
    costs, guide = big()
    calls = []

    class Alarm(Exception):
        pass

    def handler(number, frame):
        calls.append(number)
        if len(calls) == 2:
            raise Alarm

    def run():
        for _ in range(10_000):
            _core.aggregate(costs, guide, 6, 40, 8)

    before = signal.signal(signal.SIGALRM, handler)
    signal.setitimer(signal.ITIMER_REAL, 0.1, 0.2)
    try:
        with pytest.raises(Alarm):
            run()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert len(calls) == 2


@posix
def test_nothing_is_leaked_by_interrupted_kernels():
    import resource

    costs, guide = big()
    flag = _core.Interrupt()

    def run():
        flag.enter()
        flag.set()
        for _ in range(200):  # 123 MB each
            with pytest.raises(Interrupted):
                _core.aggregate(costs, guide, 6, 40, 8)

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1e6  # kilobytes: eight of 200 would be more


# ---- commands

COMMAND = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background inherit that it is ignored
from mvcore.cli import main
from mvcore.cli.app import app
{work}
@app.command()
def busy() -> None:
    print("start", flush=True)
    {call}
sys.argv[1:] = ["busy"]
main.main()
"""
LONG = {
    "a library that hears of nothing": ("import hashlib", "hashlib.pbkdf2_hmac('sha256', b'', b'', 2_000_000_000)"),
    "a thread that is waited for": (
        "from concurrent.futures import ThreadPoolExecutor",
        "ThreadPoolExecutor(1).submit(time.sleep, 600); time.sleep(600)",
    ),
    "Python alone": ("", "[None for _ in iter(int, 1)]"),
}


@posix
@pytest.mark.parametrize("kind", LONG)
def test_ctrl_c_ends_a_command_whatever_it_is_in(kind, tmp_path):
    work, call = LONG[kind]
    made = "from mvcore.pipeline.session import Workdir; place = Workdir(None)\n"
    command = [sys.executable, "-c", COMMAND.format(work=made + work, call=call)]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout.readline() == "start\n"
        assert len(list(tmp_path.iterdir())) == 1
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130, errors
    assert errors == "interrupted\n"
    assert list(tmp_path.iterdir()) == []
