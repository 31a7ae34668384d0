"""A short form of `make fuzz`: some hundreds of cases, of which every seed's valid form reads."""

import numpy as np
import pytest
from fuzz import kernels, readers, runner

pytestmark = pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="cases run in a forked process")


def test_valid_files_are_read(tmp_path):
    for target in readers.targets(tmp_path):
        assert target.read() is not None, target.name


def test_mutated_files_are_read_or_refused(tmp_path):
    outcome = runner.run(readers.Fuzzer(tmp_path, seed=1), 400, seconds=30)
    assert outcome.ran > 0
    assert not outcome.failures, str(outcome)


def test_valid_calls_succeed():
    for name, arguments in kernels.calls().items():
        kernels.function(name)(**arguments)


def test_mad_calls_succeed_or_are_refused():
    outcome = runner.run(kernels.Fuzzer(seed=1), 400, seconds=30, allowed=kernels.ALLOWED)
    assert outcome.ran > 0
    assert not outcome.failures, str(outcome)


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
