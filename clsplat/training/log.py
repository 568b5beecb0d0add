"""The log of a run (log.jsonl), and the values for a progress display."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import OutputError
from ..files.atomic import atomic_writer


@dataclass(frozen=True)
class Progress:
    """Values for a progress display.

    Attributes
    ----------
    iteration, iterations : number of iterations done, and their total number.
    loss, psnr : running means of the loss and of the PSNR [dB] over the last training views (`RunningLoss`).
    seconds : training time, without evaluations.
    per_second : iterations per second.
    message : text to show instead of these values.
    forecast : time that the rest takes [s]; None if it is not known. `seconds_left` then uses `per_second`.
    phase : part of a longer operation that this run is, such as "2/5 whole runs".
    """

    iteration: int
    iterations: int
    loss: float
    psnr: float
    n_splats: int
    seconds: float
    per_second: float
    message: str = ""
    forecast: float | None = None
    phase: str = ""

    @classmethod
    def note(cls, message: str, iterations: int) -> Progress:
        """Return a message before the first iteration. iterations : of the run."""
        return cls(0, iterations, math.nan, math.nan, 0, 0.0, 0.0, message)

    @property
    def seconds_left(self) -> float:
        """Time that the rest of the run takes [s]; infinite if it is not known."""
        if self.forecast is not None:
            return self.forecast
        return (self.iterations - self.iteration) / self.per_second if self.per_second > 0 else math.inf


class RunLog:
    """The file log.jsonl, with one line for each report. A resumed run removes the lines after its iteration."""

    def __init__(self, path: Path | None, iteration: int) -> None:
        self.path = path
        if path is None:
            return
        kept = []
        if iteration and path.is_file():
            for line in self._guard(path.read_bytes).splitlines():
                try:
                    if json.loads(line)["iteration"] <= iteration:
                        kept.append(line + b"\n")
                except (ValueError, KeyError, TypeError, RecursionError):
                    continue  # a crash interrupted the writing of this line
        with atomic_writer(path) as stream:  # keeps the old file if the program crashes here
            stream.writelines(kept)

    def write(self, values: dict[str, Any]) -> None:
        """Append a line. The file is closed after each, so that nothing holds it if the run ends in any way."""
        if self.path is not None:
            self._guard(lambda: self._append(json.dumps(values) + "\n"))

    def _append(self, line: str) -> None:
        assert self.path is not None
        with self.path.open("a", encoding="utf-8", newline="\n") as stream:
            stream.write(line)

    def _guard(self, action: Callable[[], Any]) -> Any:
        try:
            return action()
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written ({error.strerror or error})") from None
