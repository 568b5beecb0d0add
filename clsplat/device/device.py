"""OpenCL devices: list them, choose one, open it, and report why none works."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FEWER_SPLATS, OTHER_DEVICE, SMALLER_IMAGES, DeviceError
from ..files.host_memory import available_bytes
from .caches import ensure_caches
from .context import shared_context
from .opencl import Buffer, Event, first_line, is_out_of_memory
from .pip_runtime import register_pip_runtime
from .specs import count_devices

if TYPE_CHECKING:
    import pyopencl

_VERSION = (1, 2)  # of OpenCL
_MIB = 1 << 20
_EAGER_BYTES = 16 * _MIB  # buffers of this size and more are claimed at once, so that a lack of memory shows here

NO_PLATFORM = (
    "no OpenCL platform found: install your GPU's driver, or `apt install pocl-opencl-icd`, "
    "or `pip install clsplat[cpu]` (x86-64 Linux)"
)
BROKEN_POCL = (
    "PoCL 3.0-rc2 (the wheel behind pyopencl[pocl]) cannot build kernels on recent CPUs: "
    "`apt install pocl-opencl-icd` or `pip install clsplat[cpu]`"
)
POCL, RUSTICL = "Portable Computing Language", "rusticl"  # names of platforms: PoCL, and Mesa's newer driver
_CLANG_PLATFORMS = (POCL, "Intel(R) OpenCL")  # they compile CPU kernels by clang alone
_SCALAR_PLATFORMS = (RUSTICL, "Clover")  # of Mesa: their compilers take vectors apart
_NATIVE_PLATFORMS = (  # their GPUs have instructions for 2^x and 1/x with errors of about 2e-7
    *("NVIDIA CUDA", "AMD Accelerated Parallel Processing", RUSTICL, POCL),
    *("Intel(R) OpenCL Graphics", "Intel(R) OpenCL HD Graphics"),
)
LESS_MEMORY = (FEWER_SPLATS, SMALLER_IMAGES, OTHER_DEVICE)


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Properties that an OpenCL device reports; `index` is "platform:device".

    Attributes
    ----------
    max_group : largest work-group of the device. A kernel may have a smaller limit (`Kernel.max_group`).
    """

    index: str
    platform: str
    platform_version: str
    name: str
    driver: str
    version: str
    type: str
    global_mem_bytes: int
    max_alloc_bytes: int
    local_mem_bytes: int
    max_group: int
    has_fp64: bool
    compute_units: int

    @property
    def fault(self) -> str | None:
        """A reason why this device is known not to work, with the remedy; None if there is no such reason."""
        if self.platform == POCL and "3.0-rc2" in self.platform_version:
            return BROKEN_POCL
        version = re.match(r"OpenCL (\d+)\.(\d+)", self.version)
        if version and tuple(map(int, version.groups())) < _VERSION:
            return f"it has {version[0]}, and the kernels need OpenCL 1.2: update its driver or use another device"
        return None

    @property
    def has_prefetch(self) -> bool:
        """Whether kernels may call clang's __builtin_prefetch. Compilers with SPIR-V end the process at it (Mesa)."""
        return self.type == "CPU" and self.platform in _CLANG_PLATFORMS

    @property
    def has_exact_native(self) -> bool:
        """Whether native_exp2 and native_recip have three wrong bits at most. OpenCL leaves their errors open.

        Intel's runtime for CPUs has only eleven right bits.
        """
        return self.type == "GPU" and self.platform in _NATIVE_PLATFORMS

    @property
    def ends_long_loops(self) -> bool:
        """Whether the loops of a work-item end after 65 535 turns in all, without a word: Mesa on CPUs."""
        return self.type == "CPU" and self.platform in _SCALAR_PLATFORMS

    @property
    def has_wide_lanes(self) -> bool:
        """Whether a work-item may compute wide vectors: on CPUs, except with Mesa, which compiles them for minutes."""
        return self.type == "CPU" and self.platform not in _SCALAR_PLATFORMS

    def __str__(self) -> str:
        return f"{self.index} {self.name} ({self.platform})"


Observer = Callable[[str, tuple[int, ...], Event], None]


class Device:
    """An opened device: the context that the process has on it, and an in-order queue of its own.

    Attributes
    ----------
    info : properties of the device.
    shared : the context with its built programs; other `Device` objects of this device use it too.
    context : of pyopencl.
    queue : of pyopencl, another one within `profiled`: read this attribute for each command. Its commands have no times
        otherwise, because taking them can keep short kernels of a GPU apart.
    programs : programs that this object has launched kernels of, cached by `program.build`.
    observer : called with every command that is enqueued, or None (see trace.py).
    """

    def __init__(self, cl_device: pyopencl.Device, info: DeviceInfo) -> None:
        import pyopencl as cl

        self.info = info
        self.cl_device = cl_device
        try:
            self.shared = shared_context(cl_device)
            self.context = self.shared.cl_context
            self.queue = cl.CommandQueue(self.context)
        except cl.Error as error:
            raise DeviceError(f"device {info} cannot be opened: {first_line(error)}") from None
        self.programs: dict[Any, Any] = {}
        self.observer: Observer | None = None

    @property
    def has_fp64(self) -> bool:
        return self.info.has_fp64

    def finish(self) -> None:
        """Wait until all commands of the queue have finished."""
        self.queue.finish()

    @contextmanager
    def profiled(self) -> Iterator[None]:
        """Enqueue the commands of a `with` block in a queue whose events have times. Blocks may be nested."""
        import pyopencl as cl

        profiling = cl.command_queue_properties.PROFILING_ENABLE
        outer = self.queue
        if outer.properties & profiling:
            yield
            return
        self.finish()  # two queues have no order
        self.queue = cl.CommandQueue(self.context, properties=profiling)
        try:
            yield
        finally:
            self.finish()
            self.queue = outer

    def observe(self, name: str, size: tuple[int, ...], event: Event) -> None:
        """Report a command to the observer: a kernel with its global size, or a transfer with its bytes."""
        if self.observer is not None:
            self.observer(name, size, event)

    def alloc(self, nbytes: int) -> Buffer:
        """Return an uninitialised buffer of `nbytes` bytes, at least 4: OpenCL has no empty buffers.

        Raises
        ------
        DeviceError : the device (for a CPU: the machine) does not have the memory.
        """
        import pyopencl as cl

        nbytes = max(int(nbytes), 4)
        limit, scope = self._limit(nbytes)
        if nbytes > limit:
            raise _out_of_memory(nbytes, limit, scope)
        try:
            buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, nbytes)
            if nbytes >= _EAGER_BYTES:
                # Drivers allocate at the first use. Touching the buffer lets a failure show here, with its size.
                cl.enqueue_fill_buffer(self.queue, buffer, np.zeros(1, np.int32), 0, 4)
        except (cl.MemoryError, cl.RuntimeError, cl.LogicError) as error:
            if not is_out_of_memory(error):
                raise
            raise _out_of_memory(nbytes, self.info.global_mem_bytes, "on the device, partly in use") from None
        return buffer

    def _limit(self, nbytes: int) -> tuple[int, str]:
        """Bytes that one buffer may have, and the scope of that limit for the message."""
        if nbytes > self.info.max_alloc_bytes:
            return self.info.max_alloc_bytes, "for one buffer"
        if nbytes >= _EAGER_BYTES and self.info.type == "CPU":
            # A CPU's buffers are lazy pages: without this check the system would kill the process later.
            return available_bytes(), "free in this machine"
        return self.info.max_alloc_bytes, "for one buffer"

    def __repr__(self) -> str:
        return f"<Device {self.info}>"


_DevicePair = tuple["pyopencl.Device", DeviceInfo]


def list_devices() -> list[DeviceInfo]:
    """Return all OpenCL devices of all platforms in the loader's order, unusable ones too; [] if there are none."""
    return [info for _, info in _all_devices()]


def open_device(spec: str | None = None) -> Device:
    """Open a device.

    Parameters
    ----------
    spec : which device.
        None: the one of the environment's PYOPENCL_CTX, else the best. GPUs come before CPUs, PoCL before Intel.
        "cpu" or "gpu": the best of this kind.
        "0:1": an index of `list_devices`; "0" is the first device of platform 0.
        Any other text: a part of a platform's or a device's name, in any case. Platforms are searched first.

    Raises
    ------
    DeviceError : no platform, no such device, several devices, or only devices known not to work.
    """
    if count_devices(spec) > 1:
        raise DeviceError(f"device {spec!r} names several devices: only the training of one model uses them, name one")
    pairs = _all_devices()
    if not pairs:
        raise DeviceError(NO_PLATFORM)
    if spec is None and os.environ.get("PYOPENCL_CTX"):
        matching = _from_environment(pairs)
        spec = f"PYOPENCL_CTX={os.environ['PYOPENCL_CTX']}"
    else:
        matching = _matching(pairs, spec)
    if not matching:
        listed = "; ".join(str(info) for _, info in pairs)
        raise DeviceError(f"device {spec!r} not found: choose one of {listed}")
    usable = [pair for pair in matching if pair[1].fault is None]
    if not usable:
        raise DeviceError(f"device {matching[0][1]}: {matching[0][1].fault}")
    cl_device, info = min(usable, key=lambda pair: _rank(pair[1]))
    return Device(cl_device, info)


def _all_devices() -> list[_DevicePair]:
    ensure_caches()  # before pyopencl opens its cache and the loader opens PoCL's
    register_pip_runtime()  # before the loader reads the vendors' folder
    try:
        import pyopencl as cl

        platforms = cl.get_platforms()
    except ImportError as error:
        raise DeviceError(f"pyopencl cannot be imported ({first_line(error)}): `pip install pyopencl`") from None
    except cl.Error:  # PLATFORM_NOT_FOUND_KHR: the loader works, and there is no platform
        return []
    pairs: list[_DevicePair] = []
    for p, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:  # DEVICE_NOT_FOUND: the driver is installed without its hardware
            continue
        pairs += [(device, _describe(f"{p}:{d}", platform, device)) for d, device in enumerate(devices)]
    return pairs


def _describe(index: str, platform: pyopencl.Platform, device: pyopencl.Device) -> DeviceInfo:
    return DeviceInfo(
        index=index,
        platform=platform.name.strip(),
        platform_version=platform.version.strip(),
        name=device.name.strip(),
        driver=device.driver_version.strip(),
        version=device.version.strip(),
        type=_type_name(device.type),
        global_mem_bytes=device.global_mem_size,
        max_alloc_bytes=device.max_mem_alloc_size,
        local_mem_bytes=device.local_mem_size,
        max_group=min(device.max_work_group_size, device.max_work_item_sizes[0]),
        has_fp64="cl_khr_fp64" in device.extensions.split(),
        compute_units=device.max_compute_units,
    )


def _type_name(bits: int) -> str:
    """Return "CPU", "GPU" or "other"; a simulator that claims to be all kinds counts as a CPU."""
    import pyopencl as cl

    if bits & cl.device_type.CPU:
        return "CPU"
    return "GPU" if bits & cl.device_type.GPU else "other"


def _rank(info: DeviceInfo) -> tuple[int, int, int]:
    """Sort key, best device first. Among GPUs the number of units decides, then the loader's order."""
    kind = {"GPU": 0, "CPU": 1}.get(info.type, 2)
    if info.platform == "Oclgrind" or "llvmpipe" in info.name:
        return 3, 0, 0  # a checker and a software renderer: correct but slow
    order = 0 if info.platform == POCL else 1
    return kind, order if kind else 0, -info.compute_units if kind == 0 else 0


def _matching(pairs: list[_DevicePair], spec: str | None) -> list[_DevicePair]:
    """The devices that `spec` selects, see `open_device`."""
    if spec is None:
        return pairs
    text = spec.strip().lower()
    if text in ("cpu", "gpu"):
        return [pair for pair in pairs if pair[1].type.lower() == text]
    if text.replace(":", "", 1).isdigit():
        index = text if ":" in text else f"{text}:0"
        return [pair for pair in pairs if pair[1].index == index]
    if not text:
        return []
    # Platforms come first: "intel" means Intel's runtime, not PoCL on an Intel processor.
    by_platform = [pair for pair in pairs if text in pair[1].platform.lower()]
    return by_platform or [pair for pair in pairs if text in pair[1].name.lower()]


def _from_environment(pairs: list[_DevicePair]) -> list[_DevicePair]:
    """The device that pyopencl chooses by PYOPENCL_CTX; [] if it chooses none."""
    import pyopencl as cl

    try:
        chosen = cl.choose_devices(interactive=False)
    except (cl.Error, RuntimeError, ValueError, IndexError):
        return []
    return [pair for pair in pairs if pair[0] == chosen[0]]


def _out_of_memory(needed: int, limit: int, scope: str) -> DeviceError:
    return DeviceError(
        f"device out of memory: needs {needed / _MIB:.0f} MB, has {limit / _MIB:.0f} MB {scope}", *LESS_MEMORY
    )
