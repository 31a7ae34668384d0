"""Where work runs: what is lost is done again, and nothing waits for ever."""

import os
import shutil
import signal
import subprocess
import threading
import time
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from threading import get_ident

import numpy as np
import pytest
from conftest import Network
from mvcore import InvalidInputError, ReconstructionError, _core
from mvcore.errors import Interrupted
from mvcore.pipeline import cluster
from mvcore.pipeline.cluster import Cluster
from mvcore.pipeline.executors import ATTEMPTS, Interruption, open_pool

posix = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")


def square(n):
    return n * n


def slow_square(n, seconds, folder=None):
    if folder is not None:
        (Path(folder) / str(n)).touch()
    time.sleep(seconds)
    return n * n


def dies_once(n, folder):
    """Ends its worker the first time."""
    mark = Path(folder) / f"died{n}"
    if not mark.exists():
        mark.touch()
        os._exit(9)
    return n * n


def dies(folder):
    (Path(folder) / f"{time.monotonic_ns()}").touch()
    os._exit(9)


def fails(folder):
    (Path(folder) / f"{time.monotonic_ns()}").touch()
    raise InvalidInputError("voxel: expected a positive number, got -1")


# Processes


@posix
def test_a_dead_process_is_replaced_and_its_work_done_again(tmp_path):
    with ProcessPoolExecutor(2) as executor, open_pool(executor) as pool:
        waits = [pool.start(dies_once, n, tmp_path) if n % 3 == 0 else pool.start(square, n) for n in range(6)]
        assert [wait() for wait in waits] == [0, 1, 4, 9, 16, 25]
        replaced = pool.executor
        assert replaced is not executor
        assert replaced._max_workers == 2
        assert pool.start(square, 7)() == 49
    with pytest.raises(RuntimeError):
        replaced.submit(square, 1)  # ours, so it was shut down


@posix
def test_work_that_kills_every_worker_is_an_error(tmp_path):
    with ProcessPoolExecutor(1) as executor, open_pool(executor) as pool:
        with pytest.raises(ReconstructionError, match=f"lost {ATTEMPTS} times while they did dies"):
            pool.start(dies, tmp_path)()
        assert len(list(tmp_path.iterdir())) == ATTEMPTS


def test_wrong_work_is_done_once(tmp_path):
    with ProcessPoolExecutor(1) as executor, open_pool(executor) as pool:
        with pytest.raises(InvalidInputError, match="voxel"):
            pool.start(fails, tmp_path)()
        assert len(list(tmp_path.iterdir())) == 1


def test_an_executor_of_another_kind_that_breaks_is_an_error():
    class Broken(Executor):
        def submit(self, *_):
            raise BrokenExecutor("its workers are on strike")

    with open_pool(Broken()) as pool, pytest.raises(ReconstructionError, match=r"executor: its workers are gone .*on strike"):
        pool.start(square, 3)


def call(function, *arguments):
    return function(*arguments)


def test_work_that_is_given_up_ends_the_waits():
    with ProcessPoolExecutor(1) as executor:
        begun = []

        def run():
            with open_pool(executor) as pool:
                pool.start(slow_square, 1, 3)
                later = pool.start(slow_square, 2, 3)
                threading.Timer(0.5, pool.stop).start()
                begun.append(time.monotonic())
                later()

        with pytest.raises(Interrupted):
            run()
        assert time.monotonic() - begun[0] < 2.5


@posix
def test_an_error_names_the_work_that_is_handed_on(tmp_path):
    with ProcessPoolExecutor(1) as executor, open_pool(executor) as pool, pytest.raises(ReconstructionError, match="while they did dies"):
        pool.start(call, dies, tmp_path)()


# Threads


def endless():
    """A kernel of some minutes."""
    costs, guide = np.zeros((1500, 2000, 128), np.uint8), np.zeros((1500, 2000), np.uint8)
    STARTED.set()
    for _ in range(1000):
        _core.aggregate(costs, guide, 6, 40, 8)


STARTED = threading.Event()


def test_an_error_ends_the_kernels_of_the_other_threads():
    STARTED.clear()

    waits, begun = [], []

    def run():
        with open_pool() as pool:
            waits.append(pool.start(endless))
            assert STARTED.wait(60)
            time.sleep(0.5)
            begun.append(time.monotonic())
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run()
    with pytest.raises(Interrupted):
        waits[0]()
    assert time.monotonic() - begun[0] < 2.0
    # Other threads' kernels, and later pools', are not touched.
    image = np.zeros((8, 8, 3), np.uint8)
    assert _core.encode_png(image)
    with open_pool() as pool:
        assert pool.start(_core.encode_png, image)() == _core.encode_png(image)


def python_alone(ended):
    """No kernel, and nothing that looks for a flag."""
    STARTED.set()
    try:
        while True:
            sorted(range(1000))
    finally:
        ended.append(get_ident())


@pytest.mark.parametrize("jobs", [0, 2], ids=["local threads", "the caller's executor"])
def test_an_error_ends_python_code_of_the_other_threads(jobs):
    STARTED.clear()
    ended, waits = [], []

    def run(pool):
        waits.append(pool.start(python_alone, ended))
        assert STARTED.wait(60)
        raise ZeroDivisionError

    with ThreadPoolExecutor(2) as executor:
        with pytest.raises(ZeroDivisionError), open_pool(executor if jobs else None) as pool:
            run(pool)
        with pytest.raises(Interrupted):
            waits[0]()
        # The executor is the caller's, and whole.
        assert [executor.submit(pow, n, 2).result() for n in range(50)] == [n * n for n in range(50)]
    assert len(ended) == 1


def test_an_interruption_ends_nothing_but_its_own_work():
    done, ours = [], Interruption()
    ours.run(done.append, 1)
    ours.set()
    ours.set()
    with pytest.raises(Interrupted):
        ours.run(done.append, 2)
    Interruption().run(done.append, 3)
    assert done == [1, 3]
    assert _core.encode_png(np.zeros((8, 8, 3), np.uint8))


# Clusters


@posix
def test_the_work_of_a_lost_worker_is_done_again(network, tmp_path):
    workers = network.work(2)
    (tmp_path / "begun").mkdir()
    with open_pool(scheduler=network.address) as pool:
        waits = [pool.start(slow_square, n, 0.3, tmp_path / "begun") for n in range(12)]
        while len(list((tmp_path / "begun").iterdir())) < 4:
            time.sleep(0.05)
        workers[0].kill()
        assert [wait() for wait in waits] == [n * n for n in range(12)]
        with pytest.raises(InvalidInputError, match="voxel"):
            pool.start(fails, tmp_path / "begun")()
    assert workers[0].wait(10) != 0


@posix
def test_work_that_kills_every_worker_of_a_cluster_is_an_error(network, tmp_path):
    network.work(3)
    marks = tmp_path / "marks"
    marks.mkdir()
    with open_pool(scheduler=network.address) as pool, pytest.raises(ReconstructionError, match="lost again and again while they did dies"):
        pool.start(dies, marks)()
    assert len(list(marks.iterdir())) == 2  # one failure was allowed


@posix
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_a_lost_scheduler_is_an_error(network, monkeypatch, how):
    """It dies, it hangs, or it leaves in good order."""
    for name, seconds in (("CONNECT", 5.0), ("PING", 0.5), ("SILENCE", 6.0)):
        monkeypatch.setattr(cluster, name, seconds)
    begun = []

    def run():
        with open_pool(scheduler=network.address) as pool:
            wait = pool.start(square, 3)  # there is no worker to do it
            network.scheduler.send_signal(how)
            begun.append(time.monotonic())
            wait()

    with pytest.raises(ReconstructionError, match=r"scheduler: tcp://127\.0\.0\.1:\d+ is lost"):
        run()
    assert time.monotonic() - begun[0] < 20  # 7 s, on a machine that does nothing else


def test_the_seconds_to_notice_add_up_to_less_than_thirty():
    assert cluster.SILENCE + 2 * cluster.PING + cluster.LOOK < 30
    assert cluster.CONNECT + cluster.LOOK < 30


def test_no_scheduler_is_an_error_that_names_it(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "CONNECT", 1.0)
    with (
        pytest.raises(ReconstructionError, match=r"scheduler: tcp://127\.0\.0\.1:9 cannot be reached"),
        open_pool(scheduler="tcp://127.0.0.1:9"),
    ):
        pass


def certificates(folder, name):
    """A certificate authority and a certificate of its: the paths of its certificate, of that one, and of its key."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make certificates")
    ca, ca_key, cert, key, request = (folder / f"{name}-{n}" for n in ("ca.pem", "ca.key", "cert.pem", "cert.key", "request"))

    def run(*command):
        subprocess.run(["openssl", *map(str, command)], check=True, capture_output=True)

    new = ("-newkey", "rsa:2048", "-nodes")
    run("req", "-x509", *new, "-keyout", ca_key, "-out", ca, "-days", 2, "-subj", f"/CN={name}-ca")
    run("req", *new, "-keyout", key, "-out", request, "-subj", f"/CN={name}")
    run("x509", "-req", "-in", request, "-CA", ca, "-CAkey", ca_key, "-CAcreateserial", "-out", cert, "-days", 2)
    return ca, cert, key


@posix
def test_a_cluster_over_tls(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    ca, cert, key = certificates(tmp_path, "ours")
    made = Network(tmp_path, "--protocol", "tls", "--tls-ca-file", ca, "--tls-cert", cert, "--tls-key", key)
    try:
        assert made.address.startswith("tls://")
        made.work(1)
        with open_pool(scheduler=Cluster(made.address, ca, cert, key)) as pool:
            assert pool.start(square, 12)() == 144
        import dask

        config = {"distributed.comm.tls.ca-file": str(ca), "distributed.comm.tls.client.cert": str(cert)}
        with dask.config.set(config | {"distributed.comm.tls.client.key": str(key)}), open_pool(scheduler=made.address) as pool:
            assert pool.start(square, 13)() == 169
        monkeypatch.setattr(cluster, "CONNECT", 2.0)
        theirs = certificates(tmp_path, "theirs")
        for stranger in (Cluster(made.address, *theirs), made.address, made.address.replace("tls", "tcp")):
            with pytest.raises(ReconstructionError, match="cannot be reached"), open_pool(scheduler=stranger):
                pass
    finally:
        made.end()


def test_wrong_schedulers_are_named(tmp_path):
    with pytest.raises(InvalidInputError, match=r"scheduler: expected an address such as tcp://host:8786 .* got 'host:8786'"):
        Cluster("host:8786")
    with pytest.raises(InvalidInputError, match="all three or none, got none for tls_key"):
        Cluster("tls://host:1", "ca.pem", "cert.pem")
    with pytest.raises(InvalidInputError, match="tls://host:port, as there are files for TLS"):
        Cluster("tcp://host:1", "ca.pem", "cert.pem", "key.pem")
    with pytest.raises(FileNotFoundError, match=r"ca\.pem"), open_pool(scheduler=Cluster("tls://host:1", tmp_path / "ca.pem", "b", "c")):
        pass
    with pytest.raises(InvalidInputError, match="one of them"), open_pool(ProcessPoolExecutor(1), "tcp://host:1"):
        pass
