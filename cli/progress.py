"""What commands show while they run, and their tables."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from typing import TypeVar

from clsplat.training.progress import PLAIN_INTERVAL, LiveLine, TrainingDisplay, duration

__all__ = ["TrainingDisplay", "counted", "duration", "table"]

T = TypeVar("T")


def counted(items: Sequence[T], label: str, quiet: bool = False) -> Generator[T]:
    """The items, with a count that goes away at the end; where there is no terminal, a line every ten seconds."""
    line = LiveLine()
    begun = line.clock()
    try:
        for number, item in enumerate(items, 1):
            # What is done within the interval needs no line in a log.
            if not quiet and (line.live or line.clock() - begun >= PLAIN_INTERVAL):
                line.show(f"{label} {number}/{len(items)}")
            yield item
    finally:
        line.clear()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns under their heads: the first to the left, the others to the right."""
    lines = [head, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]

    def aligned(line: Sequence[str]) -> str:
        others = (cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))
        return "  ".join((line[0].ljust(widths[0]), *others))

    return "\n".join(map(aligned, lines))
