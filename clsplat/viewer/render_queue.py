"""Queue of requested frames: at most one request for each client, served in the order of their arrival."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable


class RenderQueue:
    """Frames that clients have requested. Any thread may add requests; one thread serves them.

    A new request of a waiting client keeps the client's place. A served client goes to the end of the queue. So all
    clients get the same number of frames, however often each of them asks.

    Parameters
    ----------
    clock : function that returns the time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due: dict[int, float] = {}  # time by client, in the order of the requests
        self._changed = threading.Condition()
        self._closed = False

    def request(self, client_id: int, delay: float = 0.0) -> None:
        """Request a frame in `delay` seconds; an earlier request stays in force."""
        with self._changed:
            due = self._clock() + delay
            self._due[client_id] = min(due, self._due.get(client_id, due))
            self._changed.notify()

    def cancel(self, client_id: int) -> None:
        """Remove the request of a client."""
        with self._changed:
            self._due.pop(client_id, None)

    def next_client(self, timeout: float) -> int | None:
        """Remove and return the next client; None if no request is due within `timeout` seconds, or after `close`."""
        end = self._clock() + timeout
        with self._changed:
            while not self._closed:
                now = self._clock()
                for client_id, due in self._due.items():
                    if due <= now:
                        del self._due[client_id]
                        return client_id
                until = min([end, *self._due.values()])
                if end <= now:
                    return None
                self._changed.wait(until - now)
        return None

    @property
    def has_due(self) -> bool:
        """Whether a request is due now."""
        with self._changed:
            return min(self._due.values(), default=math.inf) <= self._clock()

    def close(self) -> None:
        """Serve no request any more and wake the serving thread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        return self._closed
