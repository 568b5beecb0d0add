"""Progress of a long run: one line that is rewritten on a terminal or in a notebook, otherwise lines at intervals."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import ClassVar, TextIO

from .log import Progress

PLAIN_INTERVAL = 10.0  # seconds between lines if a line cannot be rewritten
_MIN_BAR, _MAX_BAR = 4, 20  # length of the bar [characters]
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

    def show(self, text: str | Callable[[int], str], last: bool = False) -> None:
        """Show a text instead of the present one.

        Parameters
        ----------
        text : the line, or a function that makes one for a number of columns; 0 columns means any length.
        last : keep the line, and go to the next.
        """
        make = text if callable(text) else lambda _: text
        if self.live:
            columns = (self._columns or _columns(self.stream)) - 1
            line = make(columns)[:columns]
            self._write("\r" + line.ljust(min(max(self._length, len(line)), columns)))
            self._length, LiveLine._open = len(line), self
            if last:
                self.close()
        elif last or self.clock() - self._shown >= PLAIN_INTERVAL:
            self._shown = self.clock()
            self._write(make(0) + "\n")

    def say(self, text: str) -> None:
        """Write a separate line above the one that changes."""
        self.clear()
        self._write(text + "\n")

    def clear(self) -> None:
        """Remove the line until it is shown again, so that other output can be written."""
        if LiveLine._open is self:
            self._write("\r" + " " * self._length + "\r")
            self._length, LiveLine._open = 0, None

    def close(self) -> None:
        """Keep the line and go to the next."""
        if LiveLine._open is self:
            self._write("\n")
            self._length, LiveLine._open = 0, None

    @classmethod
    def give_way(cls) -> None:
        """Clear the line that is open, if there is one."""
        if cls._open is not None:
            cls._open.clear()

    def _write(self, text: str) -> None:
        self.stream.write(text)
        self.stream.flush()


class TrainingDisplay:
    """A `progress` callback for `train`, `train_budget` and others; a context manager that ends the line.

    Parameters
    ----------
    quiet : show nothing.
    stream, clock : as for `LiveLine`.
    """

    def __init__(
        self, quiet: bool = False, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.quiet, self._line = quiet, LiveLine(stream, clock)

    def __enter__(self) -> TrainingDisplay:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._line.close()

    def __call__(self, progress: Progress) -> None:
        if self.quiet:
            return
        if progress.message:
            self._line.say(progress.message)
        else:
            self._line.show(lambda columns: progress_line(progress, columns), progress.iteration == progress.iterations)


def progress_line(progress: Progress, columns: int = 0) -> str:
    """Return a line with iteration, loss, PSNR, splats, speed, time left and a bar.

    Parameters
    ----------
    columns : maximum length; 0 means any length, without a bar. If the line is too long, fields are
        omitted in this order: loss, speed, number of splats, PSNR. The bar is then shorter or omitted.
    """
    share = progress.iteration / progress.iterations
    count = f"{progress.iteration}/{progress.iterations}"
    speed = f"{progress.per_second:.{0 if progress.per_second >= 10 else 1}f} it/s"
    fields = {
        "loss": f"loss {progress.loss:.4f}",
        "PSNR": f"PSNR {progress.psnr:.2f}",
        "splats": f"{progress.n_splats} splats",
        "speed": speed,
        "left": f"{duration(progress.seconds_left)} left",
    }
    percents = f"{share:4.0%}"
    for dropped in ("loss", "speed", "splats", "PSNR"):
        if not columns or len("  ".join([f"{count} {percents}", *fields.values()])) <= columns:
            break
        del fields[dropped]
    text = "  ".join(fields.values())
    bar = min(columns - len(count) - len(text) - 5, _MAX_BAR)
    return f"{count} [{'#' * round(bar * share):-<{bar}}]  {text}" if bar >= _MIN_BAR else f"{count} {percents}  {text}"


def duration(seconds: float) -> str:
    """Return seconds as text, such as 7 s, 2:31 or 1:02:31."""
    if not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes}:{rest:02}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def _columns(stream: TextIO) -> int:
    try:
        return os.get_terminal_size(stream.fileno()).columns or _USUAL_COLUMNS
    except (OSError, ValueError):
        return _USUAL_COLUMNS


def _in_notebook() -> bool:
    """Return whether this is the kernel of a notebook. Its output supports carriage returns, but is not a terminal."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None
