"""Signals that ask the process to end: Ctrl-C, SIGTERM of service managers, SIGHUP of a closed terminal, Ctrl-Break."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# Windows has no SIGHUP, and only Windows has SIGBREAK.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
STOP_SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
_RETRY = 0.01  # seconds until a signal that came during an import is handled
_OFFSET = 128  # shells report the end by signal n as exit code 128 + n

_received: list[int] = []  # numbers of the stop signals of this process, the first one first
_waiting: set[int] = set()  # numbers of signals that came during an import
_blocks = 0  # number of open blocks of `held`


def install() -> None:
    """Let every stop signal raise KeyboardInterrupt. A signal that is ignored, as under nohup, stays ignored.

    Call this in the main thread.
    """
    for number in handled_signals():
        signal.signal(number, interrupt)


def handled_signals() -> list[int]:
    """Return the stop signals that are neither ignored nor handled outside Python."""
    return [number for number in STOP_SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; during an import, raise it soon after the import.

    An exception inside an import may leave a half-made module, and libraries in C++ turn it into an ImportError.
    """
    note(number)
    if not _must_wait(frame):
        raise KeyboardInterrupt
    if number not in _waiting:
        _waiting.add(number)
        _thread.start_new_thread(_send_again, (number, _thread.get_ident()))


def note(number: int) -> None:
    """Record that a stop signal came."""
    _received.append(number)


def forget() -> None:
    """Forget the signals so far, before another command runs in this process."""
    _received.clear()


def received() -> bool:
    """Return whether a stop signal came."""
    return bool(_received)


def is_waiting() -> bool:
    """Return whether a signal came during an import and has not been handled since."""
    return bool(_waiting)


def exit_code() -> int:
    """Return the exit code of a program that a signal ended: 128 + its number. Without a signal, Ctrl-C is assumed."""
    return _OFFSET + (_received[0] if _received else signal.SIGINT)


def reason() -> str:
    """Return why the program ends, for a message."""
    if not _received or _received[0] == signal.SIGINT:
        return "interrupted"
    return f"stopped by {signal.Signals(_received[0]).name}"


@contextmanager
def held() -> Iterator[None]:
    """Let signals wait for the end of the block, as they wait for imports.

    SciPy's threads go on after an exception in the main thread. They then read arrays that are freed.
    """
    global _blocks
    _blocks += 1
    try:
        yield
    finally:
        _blocks -= 1


@contextmanager
def kept_from_libraries() -> Iterator[None]:
    """Keep the present handlers of stop signals while the block imports a library that installs another one.

    glog, which is part of pycolmap, lets SIGTERM print a stack trace of 30 lines. It does so early in an import of
    half a second, so Python's handlers are installed again at every call of a function during the import. A signal
    just before that call still gives the stack trace. Only the main thread can do this; in another thread, the block
    runs as it is.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    before = sys.getprofile()

    def install_again(*_: object) -> None:
        for number, handler in handlers.items():
            if handler is not None:
                signal.signal(number, handler)

    sys.setprofile(install_again)
    try:
        yield
    finally:
        sys.setprofile(before)
        install_again()


def _must_wait(frame: FrameType | None) -> bool:
    """Return whether an import, a destructor or a block of `held` runs. Python prints the exceptions of destructors."""
    if _blocks:
        return True
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib") or code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False


def _send_again(number: int, thread: int) -> None:
    time.sleep(_RETRY)
    _waiting.discard(number)
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(thread, number)  # also ends a system call that waits
    else:
        _thread.interrupt_main(signal.Signals(number))
