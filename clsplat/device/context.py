"""The OpenCL context of a device and the programs built in it, shared by all `Device` objects of a process.

A program costs tens of milliseconds even when its binary is cached, so a process that opens a device a second time uses
the programs of the first. Queues and kernels are not shared, because two threads must not set arguments of one kernel.
"""

from __future__ import annotations

from collections.abc import Hashable
from threading import Lock
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

from .kernel_args import Signatures

if TYPE_CHECKING:
    import pyopencl


class Context:
    """A context, and its programs with their signatures, by what they were built from."""

    def __init__(self, cl_device: pyopencl.Device) -> None:
        import pyopencl as cl

        self.cl_context = cl.Context([cl_device])
        self.built: dict[Hashable, tuple[pyopencl.Program, Signatures]] = {}


# A context goes with the last Device that uses it, so that a process gets its memory back and a failed context ends.
_LIVING: WeakValueDictionary[int, Context] = WeakValueDictionary()
_LOCK = Lock()


def shared_context(cl_device: pyopencl.Device) -> Context:
    """Return the living context of a device, or a new one; cl.Error if it cannot be made."""
    with _LOCK:
        context = _LIVING.get(cl_device.int_ptr)
        if context is None:
            context = _LIVING[cl_device.int_ptr] = Context(cl_device)
        return context
