"""Progress in terminals of any width, in files, in notebooks, and without support for carriage returns."""

from __future__ import annotations

import fcntl
import io
import math
import os
import pty
import struct
import sys
import termios
from collections.abc import Iterator
from types import SimpleNamespace
from typing import TextIO

import pytest
from clsplat_cli.main import _show_warning
from clsplat_cli.progress import ViewCount

import clsplat
from clsplat.training.live_line import LiveLine
from clsplat.training.log import Progress
from clsplat.training.progress import TrainingDisplay, progress_line


def count_views(total: int) -> None:
    with ViewCount("rendering") as count:
        for number in range(1, total + 1):
            count(number, total)


def at(iteration: int, message: str = "") -> Progress:
    return Progress(iteration, 1000, 0.1234, 20.5, 40000, 3.0, 10.0, message)


class Terminal:
    """A pseudo-terminal that shows its output."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        self.stream: TextIO = os.fdopen(slave, "w")
        self.columns = 80

    def resize(self, columns: int) -> None:
        fcntl.ioctl(self.stream.fileno(), termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        self.columns = columns

    def seen(self) -> list[str]:
        """Return the lines written since the last call, as a terminal of the present width shows them."""
        self.stream.write("\0")  # the kernel delays text; this marks its end
        self.stream.flush()
        raw = b""
        while not raw.endswith(b"\0"):
            raw += os.read(self.master, 65536)
        text = raw[:-1].decode()
        lines, at_column = [""], 0
        for letter in text.replace("\r\n", "\n"):
            if letter == "\n" or at_column == self.columns:
                lines.append("")
                at_column = 0
            if letter == "\r":
                at_column = 0
            elif letter != "\n":
                lines[-1] = lines[-1][:at_column].ljust(at_column) + letter + lines[-1][at_column + 1 :]
                at_column += 1
        return [line.rstrip() for line in lines]


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    monkeypatch.setenv("TERM", "xterm")
    found = Terminal()
    yield found
    found.stream.close()
    os.close(found.master)


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (100, "500/1000 [##########----------]  loss 0.1234  PSNR 20.50  40000 splats  10 it/s  50 s left"),
        (80, "500/1000 [####-----]  loss 0.1234  PSNR 20.50  40000 splats  10 it/s  50 s left"),
        (70, "500/1000 [######------]  PSNR 20.50  40000 splats  10 it/s  50 s left"),
        (40, "500/1000 [##---]  PSNR 20.50  50 s left"),
        (20, "500/1000  50%  50 s"),
    ],
)
def test_the_line_fits_the_terminal(terminal: Terminal, columns: int, expected: str) -> None:
    terminal.resize(columns)
    with TrainingDisplay(stream=terminal.stream) as display:
        display(at(250))
        display(at(500))
    assert terminal.seen() == [expected, ""]


def test_a_terminal_may_be_resized(terminal: Terminal) -> None:
    terminal.resize(90)
    with TrainingDisplay(stream=terminal.stream) as display:
        display(at(250))
        assert len(terminal.seen()[0]) > 70
        terminal.resize(40)
        display(at(500))
        assert terminal.seen() == ["500/1000 [##---]  PSNR 20.50  50 s left"]
        terminal.resize(90)
        display(at(1000))
    assert terminal.seen()[-2:] == [progress_line(at(1000), 89), ""]


def test_messages_and_warnings_stand_on_lines_of_their_own(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal.stream)
    terminal.resize(80)
    with TrainingDisplay() as display:
        display(at(250))
        display(at(250, "adding splats"))
        display(at(500))
        _show_warning("a photo is dark", UserWarning, "", 0)
        display(at(1000))
        display(at(1000, "done"))
    assert terminal.seen() == ["adding splats", "warning: a photo is dark", progress_line(at(1000), 79), "done", ""]


def test_counts_go_away_even_if_the_work_fails(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal.stream)

    def work() -> None:
        with ViewCount("rendering") as count:
            for number in range(1, 4):
                count(number, 3)
                assert terminal.seen() == [f"rendering {number}/3"]
                if number == 2:
                    raise ValueError("went wrong")

    with pytest.raises(ValueError, match="went wrong"):
        work()
    assert terminal.seen() == [""]


def test_a_log_file_gets_whole_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, now = io.StringIO(), [0.0]
    with TrainingDisplay(stream=stream, clock=lambda: now[0]) as display:
        display(at(0, "13204 splats"))
        for iteration in range(100, 1001, 100):
            now[0] += 4
            display(at(iteration))
    text = stream.getvalue()
    assert "\r" not in text
    assert text.splitlines()[0] == "13204 splats"
    assert 3 <= len(text.splitlines()) <= 6
    assert text.splitlines()[-1].startswith("1000/1000 100%  loss 0.1234")
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    count_views(3)
    assert log.getvalue() == "", "quick work needs no line"
    seconds = iter(range(0, 1000, 4))
    monkeypatch.setattr(LiveLine.__init__, "__defaults__", (None, lambda: next(seconds)))
    count_views(12)
    assert all(line.startswith("rendering ") for line in log.getvalue().splitlines())
    assert "\r" not in log.getvalue()
    assert 2 <= log.getvalue().count("\n") <= 12


def test_a_dumb_terminal_gets_whole_lines(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    with TrainingDisplay(stream=terminal.stream, clock=lambda: math.inf) as display:
        display(at(500))
    assert terminal.seen() == [progress_line(at(500)), ""]


class PlainConsole(io.TextIOWrapper):
    """A console of Windows with the letters of code page 437, which shows escape sequences as letters."""

    def __init__(self) -> None:
        self.shown = io.BytesIO()
        super().__init__(self.shown, encoding="cp437", newline="\n")

    def isatty(self) -> bool:
        return True


def test_a_console_without_escape_sequences_shows_every_letter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TERM", raising=False)
    console = PlainConsole()
    line = LiveLine(stream=console)
    line.show("reading photo \u5199\u771f.jpg")
    line.say("done \u2192 m\u00fcde")
    with TrainingDisplay(stream=console) as display:
        display(at(500))
    text = console.shown.getvalue().decode("cp437")
    assert text.startswith("\rreading photo \\u5199\\u771f.jpg\r")
    assert "done \\u2192 m\\xfcde\n" in text
    assert f"\r{progress_line(at(500), 79)}\n" in text
    assert all(letter.isprintable() or letter in "\r\n" for letter in text)


def test_a_notebook_gets_one_line_on_its_output(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.StringIO()
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setattr(sys, "stdout", output)
    display = TrainingDisplay()
    display(at(500))
    display(at(1000))
    display(at(1000, "done"))
    assert output.getvalue().split("\r")[1].rstrip() == progress_line(at(500), 99)
    assert output.getvalue().endswith(f"\r{progress_line(at(1000), 99)}\ndone\n"), "the last line stays"
    del shell.kernel  # IPython in a terminal
    display = TrainingDisplay(stream=None)
    assert display._line.stream is sys.stderr


def test_it_is_public() -> None:
    assert clsplat.TrainingDisplay is TrainingDisplay
