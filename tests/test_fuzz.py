"""A short form of `make fuzz`: some hundreds of cases, of which every seed's valid form reads."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fuzz import kernels, readers, runner

pytestmark = pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="cases run in a forked process")


def test_valid_files_are_read(tmp_path):
    for target in readers.targets(tmp_path):
        assert target.read() is not None, target.name


def fuzz(module: str) -> str:
    """In a process of its own: the cases fork, and threads of kernels that ran here before would be missing there."""
    command = [sys.executable, "-m", f"fuzz.{module}", "--seconds", "30", "--count", "400", "--seed", "1"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_mutated_files_are_read_or_refused():
    assert int(fuzz("readers").split()[0]) > 0


def test_valid_calls_succeed():
    for name, arguments in kernels.calls().items():
        kernels.function(name)(**arguments)


def test_mad_calls_succeed_or_are_refused():
    assert int(fuzz("kernels").split()[0]) > 0


def test_the_runner_sees_what_goes_wrong():
    def case(number):
        if number == 1:
            raise KeyError("x")
        if number == 2:
            __import__("os").abort()
        if number == 3:
            np.ones(1 << 28)

    outcome = runner.run(case, 6)
    assert outcome.ran == 6
    assert sorted(numbers for numbers in outcome.failures.values()) == [[1], [2], [3]]
    assert {w.split()[0] for w in outcome.failures} == {"KeyError", "the", "MemoryError"}
