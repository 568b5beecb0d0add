"""What a long command shows while it runs: one live line on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, TextIO, TypeVar

if TYPE_CHECKING:
    from clsplat.run_log import Progress

T = TypeVar("T")

PLAIN_INTERVAL = 10.0  # seconds between lines where there is no terminal
_BAR = (4, 20)  # characters, least and most


class TrainingDisplay:
    """A `progress` callback for `train`; use as a context manager, so that the live line is closed.

    Parameters
    ----------
    quiet : show nothing. stream : standard error by default. clock : seconds.
    """

    def __init__(self, quiet: bool = False, stream: TextIO | None = None,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self.quiet, self.stream, self.clock = quiet, stream or sys.stderr, clock
        self.live = self.stream.isatty()
        self._shown = -math.inf
        self._open = False

    def __enter__(self) -> TrainingDisplay:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._open:
            self._write("\n")
            self._open = False

    def __call__(self, progress: Progress) -> None:
        if self.quiet:
            return
        if progress.message:
            self._write(f"{progress.message}\n")
        elif self.live:
            columns = shutil.get_terminal_size().columns - 1
            self._write("\r" + progress_line(progress, columns)[:columns].ljust(columns))
            self._open = True
        elif self.clock() - self._shown >= PLAIN_INTERVAL or progress.iteration == progress.iterations:
            self._shown = self.clock()
            self._write(progress_line(progress) + "\n")

    def _write(self, text: str) -> None:
        self.stream.write(text)
        self.stream.flush()


def progress_line(progress: Progress, columns: int = 0) -> str:
    """Iteration, loss, PSNR, splats, speed and time left; with a bar for the share where `columns` allow."""
    share = progress.iteration / progress.iterations
    count = f"{progress.iteration}/{progress.iterations}"
    speed = f"{progress.per_second:.{0 if progress.per_second >= 10 else 1}f} it/s"
    text = (f"  loss {progress.loss:.4f}  PSNR {progress.psnr:.2f}  {progress.n_splats} splats  {speed}  "
            f"{duration(progress.seconds_left)} left")
    least, most = _BAR
    bar = min(columns - len(count) - len(text) - 3, most)
    return count + (f" [{'#' * round(bar * share):-<{bar}}]" if bar >= least else f" {share:4.0%}") + text


def duration(seconds: float) -> str:
    """7 s, 2:31 or 1:02:31."""
    if not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes}:{rest:02}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def counted(items: Sequence[T], label: str, quiet: bool = False) -> Iterator[T]:
    """The items, with a live count on a terminal."""
    live = sys.stderr.isatty() and not quiet
    for number, item in enumerate(items):
        if live:
            sys.stderr.write(f"\r{label} {number + 1}/{len(items)}")
            sys.stderr.flush()
        yield item
    if live:
        sys.stderr.write("\r" + " " * (len(label) + 20) + "\r")
        sys.stderr.flush()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns under their heads: the first to the left, the others to the right."""
    lines = [head, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]

    def aligned(line: Sequence[str]) -> str:
        others = (cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))
        return "  ".join((line[0].ljust(widths[0]), *others))

    return "\n".join(map(aligned, lines))
