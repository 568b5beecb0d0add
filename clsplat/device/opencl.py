"""Types of the pyopencl objects that other modules handle.

pyopencl itself is imported inside functions: it is slow to load, and most of clsplat works without it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Buffer(Protocol):
    """A block of device memory."""

    @property
    def size(self) -> int:
        """Bytes."""

    @property
    def int_ptr(self) -> int:
        """The OpenCL handle."""


class Profile(Protocol):
    """Start and end of a command on the device's clock [ns]."""

    @property
    def start(self) -> int: ...

    @property
    def end(self) -> int: ...


class Event(Protocol):
    """A command in a queue."""

    @property
    def profile(self) -> Profile:
        """Times of the command; available once it has finished."""

    def wait(self) -> object:
        """Wait until the command has finished."""


KernelArgument = Buffer | float | np.generic  # a buffer for a pointer, else a number


def elapsed_ms(event: Event) -> float:
    """Device time of a finished command [ms]."""
    return 1e-6 * float(event.profile.end - event.profile.start)


def first_line(error: object) -> str:
    """First non-empty line of an error's text."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def is_out_of_memory(error: Exception) -> bool:
    """Whether an OpenCL error reports a lack of memory."""
    import pyopencl as cl

    codes = (
        cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
        cl.status_code.OUT_OF_RESOURCES,
        cl.status_code.OUT_OF_HOST_MEMORY,
        cl.status_code.INVALID_BUFFER_SIZE,
    )
    return isinstance(error, cl.MemoryError) or getattr(error, "code", None) in codes
