"""Handling of stop signals: a run ends after the current iteration."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from ..files import stop_signals


@contextmanager
def stoppable(enabled: bool) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C, SIGTERM or SIGHUP sets. The block must then save its work and end.

    A second Ctrl-C interrupts as usual. More of the other signals change nothing: a closed terminal sends two SIGHUP,
    and service managers send both kinds. After the block, a handler of the program outside gets its SIGTERM or SIGHUP.
    Without such a handler the process ends.
    """
    stop = threading.Event()
    if not enabled or threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in stop_signals.handled_signals()}
    passed_on: list[int] = []

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop_signals.note(number)
        stop.set()
        if signal.SIGINT in before:
            signal.signal(signal.SIGINT, before[signal.SIGINT])
        if number != signal.SIGINT and before[number] is not stop_signals.interrupt:
            passed_on.append(number)

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if passed_on:
            signal.raise_signal(passed_on[0])
