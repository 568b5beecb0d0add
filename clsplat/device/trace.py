"""What a device was told to do: every kernel launch and transfer while a block runs, with its device time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from .device import Device
from .opencl import Event, elapsed_ms

TRANSFERS = ("upload", "download", "fill", "copy")  # the commands that are no kernels


@dataclass(frozen=True, slots=True)
class Launch:
    """One command: a kernel with its global size, or one of `TRANSFERS` with its bytes, and its event."""

    name: str
    size: tuple[int, ...]
    event: Event

    @property
    def ms(self) -> float:
        """Time on the device [ms]; the command must have ended."""
        return elapsed_ms(self.event)


@contextmanager
def recorded(device: Device) -> Iterator[list[Launch]]:
    """The list that all commands of the block are added to, in their order. Blocks may be nested."""
    launches: list[Launch] = []
    outer = device.observer

    def note(name: str, size: tuple[int, ...], event: Event) -> None:
        launches.append(Launch(name, size, event))
        if outer is not None:
            outer(name, size, event)

    device.observer = note
    try:
        yield launches
    finally:
        device.observer = outer
