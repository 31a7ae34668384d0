"""Progress of a command: lines off a terminal, bars on one, and how long it still takes."""

import re
import threading
import time
from pathlib import Path

import pytest
from mvcore.cli import progress
from mvcore.cli.app import Shown, _listen
from mvcore.cli.progress import Progress, duration
from mvcore.types import LOGGER
from rich.console import Console


@pytest.fixture
def terminal(monkeypatch):
    """A console whose text can be read; ``terminal(True)`` is one on a terminal."""

    def make(is_terminal):
        console = Console(stderr=True, force_terminal=is_terminal, width=120, record=True)
        for module in ("progress", "app"):
            monkeypatch.setattr(f"mvcore.cli.{module}.console", lambda: console)
        return console

    return make


class Time:
    """A clock that a test moves."""

    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Time()
    monkeypatch.setattr(progress, "time", made)
    return made


def test_off_a_terminal_a_line_comes_every_few_seconds(terminal, clock):
    console = terminal(False)
    track = Progress(every=5.0)
    for _ in track(range(20), "fusion"):
        clock.now += 1.0
    lines = console.export_text().splitlines()
    assert [text.split(";")[0] for text in lines] == [
        "fusion: 2 of 20, 2 s",
        "fusion: 7 of 20, 7 s",
        "fusion: 12 of 20, 12 s",
        "fusion: 17 of 20, 17 s",
    ]


def test_one_long_item_is_shown_while_it_lasts(terminal):
    console = terminal(False)
    track = Progress(every=0.1)
    for _ in track([0], "model"):
        time.sleep(0.6)
    lines = console.export_text().splitlines()
    assert len(lines) >= 3
    assert all(text.startswith("model: 0 of 1") for text in lines)
    count = threading.active_count()
    time.sleep(0.2)
    assert threading.active_count() <= count  # the clock ends with the stage


def test_short_stages_say_nothing(terminal):
    console = terminal(False)
    track = Progress()
    assert list(track(iter("abc"), "images")) == ["a", "b", "c"]
    assert console.export_text() == ""


def test_a_stage_around_the_others_measures_the_whole(terminal, clock):
    terminal(False)
    track = Progress()
    frames = track(range(10), "frames")
    for n in frames:
        for _ in track(range(3), "depth, first pass"):
            clock.now += 2.0
            if n == 4:
                share, left = track.overall()
                assert share == 0.4
                assert left == pytest.approx((clock.now - 100) * 0.6 / 0.4)
    assert track.overall() is None


def test_known_stages_extrapolate_the_whole(terminal, clock):
    terminal(False)
    track = Progress({"a": 10.0, "skipped": 50.0, "b": 30.0, "c": 60.0})
    for _ in track(range(10), "a"):
        clock.now += 1.0
    for n in track(range(10), "b"):
        if n == 5:
            share, left = track.overall()
            # A tenth and half of three tenths of what is left when one stage is known not to come.
            assert share == pytest.approx(0.25)
            assert left == pytest.approx(75.0)
        clock.now += 3.0


def test_the_estimate_knows_the_stages_that_there_are():
    package = Path(progress.__file__).parents[1]
    text = "".join(p.read_text() for folder in ("pipeline", "video") for p in (package / folder).glob("*.py"))
    assert [name for name in progress.SHARES if f'"{name}"' not in text] == []


def test_an_error_in_the_middle_ends_the_stage(terminal):
    terminal(True)
    track = Progress()
    with pytest.raises(ZeroDivisionError):
        [1 / (n - 1) for n in track(range(3), "a")]
    assert track.stages == []


def test_stages_of_several_threads(terminal):
    console = terminal(True)
    track = Progress()
    threads = [threading.Thread(target=lambda n=n: list(track(range(50), f"stage {n}"))) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert track.stages == []
    assert not track._screen.bars.live.is_started
    console.print("end")
    assert "end" in console.export_text()


def test_bars_on_a_terminal(terminal):
    console = terminal(True)
    track = Progress()
    for _ in track(range(4), "frames", 4):
        list(track(range(2), "images"))
    text = re.sub(r"\x1b\[[0-9;?]*\w", "", console.export_text())
    assert "frames" in text
    assert "4/4" in text


def test_durations():
    assert [duration(s) for s in (3, 119, 120, 7100, 7200)] == ["3 s", "119 s", "2 min", "118 min", "2 h"]


def test_warnings_show_when_they_come_and_once(terminal):
    console = terminal(False)
    shown = Shown()
    _listen(shown)
    try:
        LOGGER.warning("view %d is left out", 3)
        assert console.export_text(clear=False) == "warning: view 3 is left out\n"
        shown.warn(["view 3 is left out", "[bold]view 4[/bold]"])
    finally:
        _listen(None)
    assert console.export_text() == "warning: view 3 is left out\nwarning: [bold]view 4[/bold]\n"
    LOGGER.warning("nobody listens")
    assert console.export_text() == ""
