"""Handlers of stop signals: they wait for imports, respect nohup, and survive libraries that replace them."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from clsplat.files import stop_signals

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Restore the handlers of pytest."""
    before = {number: signal.getsignal(number) for number in stop_signals.STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
    stop_signals.forget()


def raises_keyboard_interrupt(work: Callable[[], object]) -> bool:
    """Do the work, which causes a signal, and return whether it raises KeyboardInterrupt soon."""
    try:
        work()
        time.sleep(5)
    except KeyboardInterrupt:
        return True
    return False


@pytest.mark.parametrize("number", stop_signals.STOP_SIGNALS)
def test_every_stop_signal_raises_and_gives_the_exit_code_of_shells(number: signal.Signals) -> None:
    stop_signals.install()
    assert raises_keyboard_interrupt(lambda: os.kill(os.getpid(), number))
    assert stop_signals.exit_code() == 128 + number
    stop_signals.forget()
    assert stop_signals.exit_code() == 130


def test_ignored_signals_stay_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    stop_signals.install()
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    assert signal.getsignal(signal.SIGTERM) is stop_signals.interrupt


def test_a_signal_waits_for_the_end_of_an_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module sends the signal in its middle. Its end is reached, and then the exception comes."""
    (tmp_path / "interrupted_module.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGTERM)\ntime.sleep(0.05)\nwhole = True\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    stop_signals.install()
    assert raises_keyboard_interrupt(lambda: importlib.import_module("interrupted_module"))
    assert sys.modules.pop("interrupted_module").whole
    assert not stop_signals.is_waiting()


def test_a_signal_waits_for_the_end_of_a_destructor() -> None:
    ended: list[bool] = []

    class Destroyed:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            ended.append(True)

    stop_signals.install()
    assert raises_keyboard_interrupt(Destroyed)
    assert ended == [True]


def test_a_signal_waits_for_the_end_of_a_block() -> None:
    """SciPy's threads crash if their block ends early: see `held`."""
    ended: list[bool] = []

    def work() -> None:
        with stop_signals.held():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.05)
            ended.append(True)

    stop_signals.install()
    assert raises_keyboard_interrupt(work)
    assert ended == [True]


def test_a_library_cannot_replace_the_handlers() -> None:
    """A call during the import puts the handler back at once, as a signal may come in the middle of the import."""

    def call() -> object:
        return signal.getsignal(signal.SIGTERM)

    stop_signals.install()
    profile = sys.getprofile()
    with stop_signals.kept_from_libraries():
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        assert call() is stop_signals.interrupt
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    assert signal.getsignal(signal.SIGTERM) is stop_signals.interrupt
    assert sys.getprofile() is profile


def test_other_threads_leave_the_handlers_alone() -> None:
    done: list[bool] = []

    def work() -> None:
        with stop_signals.kept_from_libraries():
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [True]


WITHOUT = """
import os, signal, sys, time
for name in ("SIGHUP", "SIGKILL", "SIGTERM", "pthread_kill"):
    delattr(signal, name)
signal.SIGBREAK = signal.SIGUSR1
from clsplat.files import stop_signals
assert stop_signals.STOP_SIGNALS == (signal.SIGINT, signal.SIGBREAK)
stop_signals.install()
with stop_signals.kept_from_libraries():
    pass
try:
    with stop_signals.held():
        signal.raise_signal(getattr(signal, sys.argv[1]))
        time.sleep(0.05)
        assert stop_signals.is_waiting()
    time.sleep(5)
except KeyboardInterrupt:
    print(stop_signals.reason(), stop_signals.exit_code())
"""


@pytest.mark.parametrize(
    ("name", "said"),
    [("SIGINT", "interrupted 130"), ("SIGBREAK", f"stopped by SIGUSR1 {128 + getattr(signal, 'SIGUSR1', 0)}")],
)
def test_a_system_with_few_signals_is_interrupted_from_the_keyboard(name: str, said: str) -> None:
    """Windows has no SIGHUP, no SIGKILL and no pthread_kill. SIGUSR1 stands for its Ctrl-Break."""
    done = subprocess.run([sys.executable, "-c", WITHOUT, name], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    assert done.stdout == f"{said}\n"
