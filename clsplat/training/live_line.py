"""One line of text that changes: rewritten on a terminal or in a notebook, otherwise written at intervals."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import ClassVar, TextIO

from ..activity import listening

HEARTBEAT = 0.5  # seconds between two looks at a line that may stand still
STILL = 1.0  # seconds after which a line that did not change gets the next mark
_MARKS = "|/-\\"
PLAIN_INTERVAL = 10.0  # seconds between lines if a line cannot be rewritten
_NOTEBOOK_COLUMNS, _USUAL_COLUMNS = 100, 80


class LiveLine:
    """A line of text that changes.

    The carriage return is its only control character. If the stream does not support it (a file, a pipe, TERM=dumb),
    a whole line is written every PLAIN_INTERVAL seconds.

    Parameters
    ----------
    stream : by default standard error, and in a notebook standard output.
    clock : a function that returns seconds.
    """

    _open: ClassVar[LiveLine | None] = None  # the line that the cursor is on

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        notebook = stream is None and _in_notebook()
        self.stream = stream or (sys.stdout if notebook else sys.stderr)
        self.clock = clock
        self.live = notebook or (self.stream.isatty() and os.environ.get("TERM") != "dumb")
        self._columns = _NOTEBOOK_COLUMNS if notebook else 0
        self._shown = -math.inf
        self._length = 0
        self._make: Callable[[int], str] | None = None  # the text that is shown
        self._since = -math.inf  # time of the last text
        self._created = clock()
        self._beats = 0
        self._lock = threading.RLock()

    def show(self, text: str | Callable[[int], str], last: bool = False) -> None:
        """Show a text instead of the present one.

        Parameters
        ----------
        text : the line, or a function that makes one for a number of columns; 0 columns means any length.
        last : keep the line, and go to the next.
        """
        make = text if callable(text) else lambda _: text
        with self._lock:
            self._make, self._since = make, self.clock()
            if self.live:
                self._draw(make)
                if last:
                    self.close()
            elif last or self.clock() - self._shown >= PLAIN_INTERVAL:
                self._shown = self.clock()
                self._write(make(0) + "\n")

    def mention(self, text: str) -> None:
        """Show what begins now. A log gets the text only if it is still true at the next beat that writes a line."""
        with self._lock:
            if self.live:
                self.show(text)
            else:
                self._make, self._since = lambda _: text, self.clock()

    def beat(self) -> None:
        """Show that the program is alive: mark a text that stands still, or repeat it in a log."""
        with self._lock:
            if self._make is None:
                return
            make, still = self._make, self.clock() - self._since
            if self.live and still >= STILL:
                self._beats += 1
                mark = _MARKS[self._beats % len(_MARKS)]
                self._draw(lambda columns: f"{make(columns - 2)[: columns - 2]} {mark}")
            elif not self.live and self.clock() - max(self._shown, self._created) >= PLAIN_INTERVAL:
                self._shown = self.clock()
                self._write(f"{make(0)}\n")

    def _draw(self, make: Callable[[int], str]) -> None:
        columns = (self._columns or _columns(self.stream)) - 1
        line = make(columns)[:columns]
        self._write("\r" + line.ljust(min(max(self._length, len(line)), columns)))
        self._length, LiveLine._open = len(line), self

    def say(self, text: str) -> None:
        """Write a separate line above the one that changes."""
        with self._lock:
            self.clear()
            self._make = None
            self._write(text + "\n")

    def clear(self) -> None:
        """Remove the line until it is shown again, so that other output can be written."""
        with self._lock:
            if LiveLine._open is self:
                self._write("\r" + " " * self._length + "\r")
                self._length, LiveLine._open = 0, None

    def end(self) -> None:
        """Remove the line for good: no mark is shown on it any more."""
        with self._lock:
            self.clear()
            self._make = None

    def close(self) -> None:
        """Keep the line and go to the next."""
        with self._lock:
            self._make = None
            if LiveLine._open is self:
                self._write("\n")
                self._length, LiveLine._open = 0, None

    @classmethod
    def give_way(cls) -> None:
        """Clear the line that is open, if there is one."""
        if cls._open is not None:
            cls._open.clear()

    def _write(self, text: str) -> None:
        # The terminal may be closed. A run must not end without a checkpoint because nobody sees its progress.
        with suppress(OSError):
            try:
                self.stream.write(text)
            except UnicodeEncodeError:  # Windows has consoles of a few letters, and names of photos have any
                self.stream.write(text.encode("ascii", "backslashreplace").decode("ascii"))
            self.stream.flush()


class Heartbeat:
    """A context manager in which a line shows at least every second that the program is alive.

    A thread does it, because reading a photo or compiling a kernel may take longer than that.
    """

    def __init__(self, line: LiveLine) -> None:
        self._line, self._ended = line, threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._ended.wait(HEARTBEAT):
            self._line.beat()


@contextmanager
def followed(line: LiveLine, quiet: bool = False) -> Iterator[None]:
    """Show on a line what the library reports (clsplat/activity.py), and every second that the program is alive.

    Parameters
    ----------
    quiet : show nothing.
    """
    if quiet:
        yield
        return
    with listening(line.mention), Heartbeat(line):
        yield


@contextmanager
def activity_line(quiet: bool = False, line: LiveLine | None = None) -> Iterator[None]:
    """Show what the library reports on a line, by default a new one, and remove the line at the end."""
    line = line or LiveLine()
    try:
        with followed(line, quiet):
            yield
    finally:
        line.end()


def duration(seconds: float) -> str:
    """Return seconds as text, such as 7 s, 2:31 or 1:02:31."""
    if not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes}:{rest:02}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def rough_duration(seconds: float) -> str:
    """Return seconds as text for an estimate, such as 40 seconds, 12 minutes or 2.5 hours."""
    if seconds < 90:
        return f"{max(round(seconds / 10), 1) * 10} seconds"
    minutes = seconds / 60
    if minutes < 90:
        return f"{round(minutes) if minutes < 10 else round(minutes / 5) * 5} minutes"
    return f"{round(minutes / 30) / 2:g} hours"


def _columns(stream: TextIO) -> int:
    try:
        return os.get_terminal_size(stream.fileno()).columns or _USUAL_COLUMNS
    except (OSError, ValueError):
        return _USUAL_COLUMNS


def _in_notebook() -> bool:
    """Return whether this is the kernel of a notebook. Its output supports carriage returns, but is not a terminal."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None
