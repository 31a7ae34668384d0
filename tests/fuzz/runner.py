"""Runs numbered cases in a process of its own: a crash, a hang or a large allocation there is a result like any other."""

from __future__ import annotations

import mmap
import multiprocessing
import os
import resource
import signal
import struct
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mvcore.errors import MvcoreError

SECONDS = 10
"""Of one case, on the processor."""
WAITING = 300
"""Seconds of one case, by the clock, for waits that take no processor time: other work on the machine counts."""
MEMORY = 1 << 30
"""Bytes that a case may add to the process."""
ALLOWED = (MvcoreError, OSError)
Case = Callable[[int], None]


@dataclass
class Outcome:
    """How many cases ran, and what was wrong: the case's number and the end of its traceback."""

    ran: int = 0
    failures: dict[str, list[int]] = field(default_factory=dict)

    def add(self, what: str, number: int) -> None:
        self.failures.setdefault(what, []).append(number)

    def __str__(self) -> str:
        lines = [f"{len(numbers)} times, first in case {numbers[0]}: {what}" for what, numbers in self.failures.items()]
        return "\n".join([f"{self.ran} cases, {len(self.failures)} kinds of failure", *lines])


def run(case: Case, count: int, seconds: float = 1e9, first: int = 0, allowed: tuple[type[BaseException], ...] = ALLOWED) -> Outcome:
    """Run cases ``first`` .. until ``count`` of them or the time is over."""
    outcome, end, number = Outcome(), time.monotonic() + seconds, first
    context = multiprocessing.get_context("fork")
    with mmap.mmap(-1, 16) as progress:
        while number < first + count and time.monotonic() < end:
            receive, send = context.Pipe(duplex=False)
            worker = context.Process(target=_work, args=(case, number, first + count, end, progress, send, allowed))
            worker.start()
            send.close()
            while True:
                try:
                    outcome.add(*receive.recv())
                except EOFError:
                    break
            worker.join()
            done, finished = struct.unpack("qq", progress[:16])
            if worker.exitcode:
                outcome.add(f"the process ended with {_ended(worker.exitcode)}", done)
                done += 1
            outcome.ran += done - number
            number = done
            if finished:
                break
    return outcome


def _ended(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name
    return name + {"SIGPROF": f" (longer than {SECONDS} s)", "SIGALRM": f" (longer than {WAITING} s by the clock)"}.get(name, "")


def _work(case: Case, number: int, stop: int, end: float, progress: mmap.mmap, send, allowed) -> None:
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    for stream in (1, 2):  # decoders warn there
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    while number < stop and time.monotonic() < end:
        progress[:16] = struct.pack("qq", number, 0)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.alarm(WAITING)
        try:
            case(number)
        except allowed:
            pass
        except BaseException as error:
            send.send((_signature(error), number))
        number += 1
    signal.alarm(0)
    signal.setitimer(signal.ITIMER_PROF, 0)
    progress[:16] = struct.pack("qq", number, 1)
    os._exit(0)


def _signature(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/mvcore/" in f.filename] or frames
    place = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else ""
    return f"{type(error).__name__} at {place}: {str(error)[:100]}"
