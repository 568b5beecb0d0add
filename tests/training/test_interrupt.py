"""The first signal ends a run after its iteration. A second Ctrl-C ends the process at once."""

from __future__ import annotations

import signal

import pytest

from clsplat.files import stop_signals
from clsplat.training.interrupt import stoppable


def test_a_second_ctrl_c_is_not_held_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with stoppable(True) as stop:
            signal.raise_signal(signal.SIGINT)
            assert stop.is_set()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
        stop_signals.forget()
