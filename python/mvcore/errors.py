"""What mvcore raises. Operating-system errors pass through untouched."""

from __future__ import annotations


class MvcoreError(Exception):
    """Base of every error that mvcore raises itself."""


class InvalidInputError(MvcoreError, ValueError):
    """An argument does not fit its contract; the message names it, what was expected and what came."""


class FormatError(MvcoreError, ValueError):
    """A file is malformed; the message starts with ``path:line:`` where a line is known."""


class ReconstructionError(MvcoreError, RuntimeError):
    """The input is valid but cannot be reconstructed; the message says why."""


class Interrupted(MvcoreError, RuntimeError):
    """A kernel was ended before it was done, as the work it belongs to was given up."""


class InternalError(MvcoreError, RuntimeError):
    """A kernel panicked, which is a bug of mvcore; the message says where."""


def require(condition: object, argument: str, expected: str, got: object) -> None:
    """Raise `InvalidInputError` unless ``condition`` holds."""
    if not condition:
        raise InvalidInputError(f"{argument}: expected {expected}, got {got}")
