"""What a long operation is doing now: the library reports it to a display.

Reading photos and compiling kernels take seconds, and many functions lie between them and the command. Without a
listener nothing happens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[str], None]

_listeners: list[Listener] = []


def report(text: str) -> None:
    """Tell the innermost listener what begins now, for example "reading photo 12 of 50". Any thread may call it."""
    if _listeners:
        _listeners[-1](text)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send all reports inside the `with` block to `listener`."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)
