"""Progress of a training run: iteration, loss, PSNR, splats, speed and time left on one line."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import TextIO

from .live_line import LiveLine, duration, followed
from .log import Progress

_MIN_BAR, _MAX_BAR = 4, 20  # length of the bar [characters]


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
        self._open = ExitStack()

    def __enter__(self) -> TrainingDisplay:
        """Also show what the library reports, such as the compilation of kernels, and that the program is alive."""
        self._open.enter_context(followed(self._line, self.quiet))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
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
    if progress.phase:
        count = f"{progress.phase}  {count}"
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
