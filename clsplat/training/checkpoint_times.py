"""Times of checkpoints: by iterations and by the clock."""

from __future__ import annotations

import time
from collections.abc import Callable

from .options.groups import OutputConfig


class CheckpointTimes:
    """Times at which a run saves a checkpoint.

    Iterations alone are not enough: an iteration with many splats takes seconds, and a crash would then lose an hour.

    Parameters
    ----------
    config : numbers of iterations and of minutes between two checkpoints.
    clock : function that returns seconds.
    """

    def __init__(self, config: OutputConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self._iterations, self._seconds = config.checkpoint_interval, 60.0 * config.checkpoint_minutes
        self._clock = clock
        self.saved()

    def saved(self) -> None:
        """Begin to count the minutes again."""
        self._last = self._clock()

    def is_due(self, iteration: int) -> bool:
        """Return whether to save a checkpoint after an iteration."""
        if self._iterations and iteration % self._iterations == 0:
            return True
        return bool(self._seconds) and self._clock() - self._last >= self._seconds
