"""Progress displays and tables of the commands."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import click

from clsplat.training.live_line import PLAIN_INTERVAL, LiveLine, activity_line, duration
from clsplat.training.progress import TrainingDisplay

if TYPE_CHECKING:
    from clsplat.evaluation.evaluate import Evaluation

__all__ = ["TrainingDisplay", "ViewCount", "activity_line", "duration", "report_test_views", "resume_command", "table"]


def resume_command(model: Path, cluster: str | None = None) -> str:
    """Return the command that continues a training, quoted for a shell."""
    return shlex.join(["clsplat", "train", "--resume", "-m", str(model), *(["--cluster", cluster] if cluster else [])])


class ViewCount:
    """A `progress` callback that shows the number of finished views; a context manager that removes its line.

    Without a terminal it writes a line every PLAIN_INTERVAL seconds.

    Parameters
    ----------
    label : word before the count.
    quiet : show nothing.

    Attributes
    ----------
    done, total : numbers of views; 0 before the first view begins.
    """

    def __init__(self, label: str, quiet: bool = False) -> None:
        self.label, self.quiet = label, quiet
        self.done = self.total = 0
        self._line = LiveLine()
        self._activity = activity_line(quiet, self._line)
        self._start = self._line.clock()

    def __enter__(self) -> ViewCount:
        """Also show what the library reports before the first view, such as the photos that it reads."""
        self._activity.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._activity.__exit__(None, None, None)

    def __call__(self, number: int, total: int) -> None:
        self.done, self.total = number - 1, total
        # Work that ends within the interval does not need a line in a log.
        if not self.quiet and (self._line.live or self._line.clock() - self._start >= PLAIN_INTERVAL):
            self._line.show(f"{self.label} {number}/{total}")

    def clear(self) -> None:
        """Remove the line."""
        self._line.clear()


def report_test_views(metrics: Evaluation | None) -> None:
    """Print how good a model is on its test views; nothing without them."""
    if metrics is None:
        return
    corrected = "" if metrics.corrected_psnr is None else f" ({metrics.corrected_psnr:.2f} dB colour-corrected)"
    click.echo(f"test views ({len(metrics.per_view)}): PSNR {metrics.psnr:.2f} dB{corrected}, SSIM {metrics.ssim:.4f}")


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: Sequence[str] = ()) -> str:
    """Return a table as text. The first column and those named in `left` are aligned to the left, others to the right.

    Spaces at the end of lines are left out.
    """
    lines = [head, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    left = (head[0], *left)

    def aligned(line: Sequence[str]) -> str:
        cells = (
            cell.ljust(width) if title in left else cell.rjust(width)
            for title, cell, width in zip(head, line, widths, strict=True)
        )
        return "  ".join(cells).rstrip()

    return "\n".join(map(aligned, lines))
