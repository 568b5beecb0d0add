"""The status line of a browser: what a frame shows, and messages that stay long enough to be read."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

READING_TIME = 3.0  # seconds for which frames do not replace a message


class StatusLine:
    """A line that frames and messages share.

    A text about a frame waits until the last message has been shown for `READING_TIME`. It is then shown although no
    other frame may follow. Several threads may call the methods.

    Parameters
    ----------
    show : changes the line of the page. Its argument is Markdown, in which nothing of a text is markup.
    """

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show
        self._lock = threading.Lock()
        self._read_until = 0.0
        self._waiting = ""
        self._timer: threading.Timer | None = None

    def say(self, message: str) -> None:
        """Show a message at once."""
        with self._lock:
            self._read_until, self._waiting = time.monotonic() + READING_TIME, ""
            self._show(plain(message))

    def describe(self, frame: str) -> None:
        """Show a text about a frame, if no message is being read, else afterwards."""
        with self._lock:
            left = self._read_until - time.monotonic()
            if left <= 0.0:
                self._waiting = ""
                self._show(plain(frame))
                return
            self._waiting = frame
            self._start_timer(left)

    def expire(self) -> None:
        """Let the next frame replace the message, which is about an earlier model."""
        with self._lock:
            self._read_until = 0.0

    def close(self) -> None:
        """Show no waiting text any more."""
        with self._lock:
            self._waiting = ""
            if self._timer is not None:
                self._timer.cancel()

    def _start_timer(self, seconds: float) -> None:
        if self._timer is None:
            self._timer = threading.Timer(seconds, self._end_reading)
            self._timer.daemon = True
            self._timer.start()

    def _end_reading(self) -> None:
        with self._lock:
            self._timer = None
            left = self._read_until - time.monotonic()
            if not self._waiting:
                return
            if left > 0.0:  # another message has come
                self._start_timer(left)
                return
            self._show(plain(self._waiting))
            self._waiting = ""


def plain(text: str) -> str:
    """Escape a text, so that the panel shows it without markup."""
    return "".join("\\" + char if char in r"\`*_{}[]()<>#+-!|~$&" else char for char in text.replace("\n", " "))
