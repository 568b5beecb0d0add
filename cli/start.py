"""Start of the program `clsplat`: handlers of signals come first, then the imports, which take time."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from types import FrameType


def main() -> None:
    """Run the command line. Ctrl-C, SIGTERM and SIGHUP end it at any moment with one line at most."""
    _end_at_signals()
    from clsplat.files import stop_signals
    from clsplat.files.standard_streams import open_closed_streams

    open_closed_streams()
    from .main import main as command

    try:
        stop_signals.install()
        code = _run(command)
        _end_at_signals()
    except KeyboardInterrupt:  # a second signal, during the message about the first, or one after the end of the work
        code = stop_signals.exit_code()
        _end_at_signals()
    if stop_signals.is_waiting():
        code = stop_signals.exit_code()
    if not _flushed() and stop_signals.received():
        os._exit(code)  # the terminal is gone: Python would end with exit code 120
    sys.exit(code)


def _run(command: Callable[[], object]) -> int:
    """Run the command and return its exit code."""
    from clsplat.files import stop_signals

    try:
        command()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    except KeyboardInterrupt:
        print(f"error: {stop_signals.reason()}", file=sys.stderr)
        return stop_signals.exit_code()
    except OSError:
        if not stop_signals.received():
            raise
        return stop_signals.exit_code()  # the message could not be written: the terminal is gone
    return 0


def _end_at_signals() -> None:
    """Let signals end the process without a word: for the time before the work begins, and after it."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP, and only Windows has SIGBREAK
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    os._exit(128 + number)


def _flushed() -> bool:
    """Write what is in the buffers of the standard streams, and return whether that succeeded."""
    try:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    except (OSError, ValueError, AttributeError):
        return False
    return True
