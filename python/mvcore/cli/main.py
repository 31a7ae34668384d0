"""The command line: ``mvcore COMMAND``. One command a job; errors are one line on stderr with exit code 2."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time

from . import clean, reconstruct, tools, train, video
from .app import INTERRUPTED, app, say_interrupted

__all__ = ["app", "clean", "main", "reconstruct", "tools", "train", "video"]

GRACE = 1.5
"""Seconds after Ctrl-C for a command to end by itself."""
SHOW_CURSOR = b"\x1b[?25h"
"""Progress bars hide it."""


def main() -> None:
    """Entry point."""
    _end_soon_after_ctrl_c()
    app()


def _end_soon_after_ctrl_c() -> None:
    """Has Ctrl-C end the process, whatever its threads are in: files are written whole, so it can end anywhere."""
    near, far = socket.socketpair()
    far.setblocking(False)
    signal.set_wakeup_fd(far.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_wait_and_end, args=(near, far), name="mvcore-ctrl-c", daemon=True).start()


def _wait_and_end(near: socket.socket, _far: socket.socket) -> None:
    while signal.SIGINT not in near.recv(64):
        pass
    time.sleep(GRACE)
    say_interrupted()
    if sys.stderr.isatty():
        os.write(sys.stderr.fileno(), SHOW_CURSOR)
    session = sys.modules.get("mvcore.pipeline.session")
    for folder in list(session.TEMPORARY) if session is not None else ():
        session.remove_temporary(folder)
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
