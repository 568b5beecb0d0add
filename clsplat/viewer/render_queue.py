"""Who is to get a picture next: one wish of each looker-on, the newest, in the order in which they asked."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable


class Wishes:
    """Pictures wanted. Any thread may ask; one serves.

    A looker-on keeps the place in the queue when the wish is replaced, and goes to its end once served: all get the
    same number of pictures, however often each asks.

    Parameters
    ----------
    clock : seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due: dict[int, float] = {}  # by looker-on, in the order of asking
        self._changed = threading.Condition()
        self._closed = False

    def ask(self, who: int, delay: float = 0.0) -> None:
        """Want a picture after `delay` seconds, or sooner if one is wanted sooner already."""
        with self._changed:
            due = self._clock() + delay
            self._due[who] = min(due, self._due.get(who, due))
            self._changed.notify()

    def drop(self, who: int) -> None:
        """Nothing more is wanted."""
        with self._changed:
            self._due.pop(who, None)

    def take(self, timeout: float) -> int | None:
        """Who is next; None when nobody is within `timeout` seconds, or after `close`."""
        end = self._clock() + timeout
        with self._changed:
            while not self._closed:
                now = self._clock()
                for who, due in self._due.items():
                    if due <= now:
                        del self._due[who]
                        return who
                until = min([end, *self._due.values()])
                if end <= now:
                    return None
                self._changed.wait(until - now)
        return None

    @property
    def waiting(self) -> bool:
        """Whether a picture is due now."""
        with self._changed:
            return min(self._due.values(), default=math.inf) <= self._clock()

    def close(self) -> None:
        """Nobody gets anything more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        return self._closed
