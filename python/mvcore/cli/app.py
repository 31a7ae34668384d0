"""The command group: global options that may stand anywhere, errors in one line, exit codes."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Event
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from .progress import console

DONE, DOUBTFUL, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done; done with warnings under ``--strict``; bad input; Ctrl-C."""
UsageProblem: type[Exception] = typer.BadParameter.__mro__[2]
"""Base of the errors about words of the command line, in click or in typer's copy of it."""
GLOBAL = ("--debug", "--quiet", "-q", "--verbose", "-v", "--strict")


@dataclass
class Shown:
    """What a command shows beside its result; each warning once."""

    verbose: bool = False
    quiet: bool = False
    debug: bool = False
    strict: bool = False
    warnings: list[str] = field(default_factory=list)

    def warn(self, messages: Iterable[str]) -> None:
        """Warnings, as they become known."""
        for message in messages:
            if message not in self.warnings:
                self.warnings.append(message)
                if not self.quiet:
                    # Above the progress bars, where there are any.
                    console().print(f"warning: {message}", markup=False, highlight=False, soft_wrap=True)

    def note(self, message: str) -> None:
        """A hint or a detail, on stderr."""
        if not self.quiet:
            print(message, file=sys.stderr)

    def detail(self, message: str) -> None:
        """What only ``--verbose`` shows."""
        if self.verbose:
            print(message, file=sys.stderr)

    def done(self, message: str) -> None:
        """The result in a line; ends the command with code 1 where warnings count as failures."""
        if not self.quiet:
            print(message)
        self.end()

    def end(self) -> None:
        """Ends the command with code 1 where there are warnings and they count as failures."""
        if self.strict and self.warnings:
            raise typer.Exit(DOUBTFUL)

    def track(self) -> Any:
        """Progress bars, unless nothing is to be shown."""
        from ..types import no_track
        from .progress import Progress

        return no_track if self.quiet else Progress()


class _Logged(logging.Handler):
    """What the library logs: warnings as they become known, details with ``--verbose``."""

    def __init__(self, shown: Shown) -> None:
        super().__init__(logging.INFO if shown.verbose else logging.WARNING)
        self.shown = shown

    def emit(self, record: logging.LogRecord) -> None:
        """Shows a record."""
        if record.levelno >= logging.WARNING:
            self.shown.warn([record.getMessage()])
        else:
            self.shown.detail(record.getMessage())


_current: ContextVar[Shown] = ContextVar("shown")
_said = Event()


def shown() -> Shown:
    """Of the command that runs."""
    return _current.get()


class Commands(TyperGroup):
    """A group whose global options may stand before or after a command's name, and whose errors are one line."""

    def main(self, args: Sequence[str] | None = None, *rest: Any, standalone_mode: bool = True, **extra: Any) -> Any:
        """Runs a command and exits."""
        words = _globals_first(list(sys.argv[1:] if args is None else args))
        _said.clear()
        try:
            code = super().main(words, *rest, standalone_mode=False, **extra)
        except (KeyboardInterrupt, typer.Abort):
            code = INTERRUPTED
        except UsageProblem as error:
            code = _usage(error)
        except Exception as error:
            if "--debug" in words:
                raise
            code = _failed(error)
        finally:
            _listen(None)
        if code == INTERRUPTED:  # typer makes this code of Ctrl-C, click an exception
            say_interrupted()
        if standalone_mode:
            sys.exit(code if isinstance(code, int) else DONE)
        return code


def say_interrupted() -> None:
    """Says that Ctrl-C ended the command, unless it is said."""
    if not _said.is_set():
        _said.set()
        print("interrupted", file=sys.stderr, flush=True)


def _listen(shown: Shown | None) -> None:
    """Has one command, or none, show what the library logs."""
    logger = logging.getLogger("mvcore")
    for handler in [h for h in logger.handlers if isinstance(h, _Logged)]:
        logger.removeHandler(handler)
    if shown is not None:
        logger.addHandler(_Logged(shown))
        logger.setLevel(logging.INFO if shown.verbose else logging.WARNING)


def _globals_first(words: list[str]) -> list[str]:
    """The words with global options, wherever they stand before ``--``, at their beginning."""
    end = words.index("--") if "--" in words else len(words)
    first = [w for w in words[:end] if w in GLOBAL]
    return first + [w for w in words[:end] if w not in GLOBAL] + words[end:]


def _usage(error: Any) -> int:
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return BAD_INPUT
    return _say(error.format_message())


def _failed(error: Exception) -> int:
    from ..errors import MvcoreError

    if isinstance(error, MvcoreError | OSError | MemoryError):
        return _say(str(error) or type(error).__name__)
    if isinstance(error, ValueError | RuntimeError):
        return _say(str(error))
    return _say(f"internal error, {type(error).__name__}: {error}; --debug shows where")


def _say(message: str) -> int:
    print(f"mvcore: {' '.join(message.split())}", file=sys.stderr)
    return BAD_INPUT


app = typer.Typer(
    cls=Commands,
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Calibrated images or clips in, textured 3D meshes out.",
    epilog="Exit codes: 0 done, 1 done with warnings (--strict), 2 bad input, 130 interrupted.",
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"mvcore {version('mvcore')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and end.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show what takes how long.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show errors alone.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="End with code 1 if there was any warning.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """These options may stand before or after a command."""
    shown = Shown(verbose, quiet, debug, strict)
    _current.set(shown)
    _listen(shown)


options.__doc__ = app.info.help
