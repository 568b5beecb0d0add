"""A record of the commands of a device: kernel launches and transfers, with their device times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from .device import Device
from .opencl import Event, elapsed_ms

TRANSFERS = ("upload", "download", "fill", "copy")  # commands that are not kernels


@dataclass(frozen=True, slots=True)
class Launch:
    """One command: a kernel with its global size, or one of `TRANSFERS` with its bytes, and its event."""

    name: str
    size: tuple[int, ...]
    event: Event

    @property
    def ms(self) -> float:
        """Time on the device [ms]; the command must have finished."""
        return elapsed_ms(self.event)


@contextmanager
def recorded(device: Device) -> Iterator[list[Launch]]:
    """Return a list that all commands of a `with` block are added to, in order. Blocks may be nested."""
    launches: list[Launch] = []
    outer = device.observer

    def note(name: str, size: tuple[int, ...], event: Event) -> None:
        launches.append(Launch(name, size, event))
        if outer is not None:
            outer(name, size, event)

    with device.profiled():
        device.observer = note
        try:
            yield launches
        finally:
            device.observer = outer
