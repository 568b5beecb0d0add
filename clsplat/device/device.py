"""OpenCL devices: find them, choose one, open it, and say plainly why none works."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import DeviceError
from .pip_runtime import register_pip_runtime

TILE = 16  # side of a tile [px]
MIB = 1 << 20
_EAGER_BYTES = 16 * MIB  # buffers from this size on are claimed at once, so that lack of memory shows here

NO_PLATFORM = (
    "no OpenCL platform found: install your GPU's driver, or `apt install pocl-opencl-icd`, "
    "or `pip install clsplat[cpu]` (x86-64 Linux)"
)
BROKEN_POCL = (
    "PoCL 3.0-rc2 (the wheel behind pyopencl[pocl]) cannot build kernels on recent CPUs: "
    "`apt install pocl-opencl-icd` or `pip install clsplat[cpu]`"
)
LESS_MEMORY = "use fewer splats (--cap-max), smaller images (-r 2, 4, 8) or another --device"


@dataclass(frozen=True, slots=True)
class Schedule:
    """How one tile's pixels are shared out: work-items x vectors per work-item x lanes per vector.

    The product is the number of pixels of a tile, 256.
    """

    group: int
    vecs: int
    lanes: int

    def __post_init__(self) -> None:
        if min(self.group, self.vecs, self.lanes) < 1 or self.group * self.vecs * self.lanes != TILE * TILE:
            raise DeviceError(f"schedule {self}: GROUPxVECSxLANES must multiply to {TILE * TILE}")
        if self.lanes not in (1, 8, 16):
            raise DeviceError(f"schedule {self}: LANES must be 1, 8 or 16 (cl/math/lanes.clh)")
        if self.group > 1 and self.group % 32:  # sums go by parts of 16; PoCL 3.1 gets groups of 16 wrong
            raise DeviceError(f"schedule {self}: GROUP must be 1 or a multiple of 32 (cl/render/group.clh)")

    def __str__(self) -> str:
        return f"{self.group}x{self.vecs}x{self.lanes}"

    @classmethod
    def parse(cls, text: str) -> Schedule:
        """Schedule from a name of `SCHEDULES` or from "GROUPxVECSxLANES"; DeviceError otherwise."""
        if text in SCHEDULES:
            return SCHEDULES[text]
        try:
            group, vecs, lanes = (int(part) for part in text.lower().split("x"))
        except ValueError:
            names = ", ".join(SCHEDULES)
            raise DeviceError(f"schedule {text!r}: expected one of {names} or a form such as 1x16x16") from None
        return cls(group, vecs, lanes)


SCHEDULES = {
    "cpu16": Schedule(1, 16, 16),
    "cpu8": Schedule(1, 32, 8),
    "scalar": Schedule(1, 256, 1),
    "gpu256": Schedule(256, 1, 1),
    "gpu64": Schedule(64, 4, 1),
}


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What one OpenCL device says of itself; `index` is "platform:device"."""

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
    def ailment(self) -> str | None:
        """Why this device cannot be used (with the mend), or None."""
        if self.platform == "Portable Computing Language" and "3.0-rc2" in self.platform_version:
            return BROKEN_POCL
        return None

    def __str__(self) -> str:
        return f"{self.index} {self.name} ({self.platform})"


Found = tuple[Any, DeviceInfo]  # a pyopencl device and its description
Observer = Callable[[str, tuple[int, ...], Any], None]


class Device:
    """One opened device: a context and one in-order queue with profiling.

    Attributes
    ----------
    info : DeviceInfo.
    context, queue : pyopencl objects.
    programs : programs built for this device, kept by `program.build`.
    observer : told of every command that is enqueued, or None (see launches.py).
    """

    def __init__(self, cl_device: Any, info: DeviceInfo) -> None:
        import pyopencl as cl

        self.info = info
        self.cl_device = cl_device
        try:
            self.context = cl.Context([cl_device])
            self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        except cl.Error as error:
            raise DeviceError(f"device {info} cannot be opened: {first_line(error)}") from None
        self.programs: dict[Any, Any] = {}
        self.observer: Observer | None = None

    @property
    def has_fp64(self) -> bool:
        return self.info.has_fp64

    def observe(self, name: str, size: tuple[int, ...], event: Any) -> None:
        """Tell the observer, if there is one: a kernel and its global size, or a transfer and its bytes."""
        if self.observer is not None:
            self.observer(name, size, event)

    def alloc(self, nbytes: int) -> Any:
        """Read-write buffer of `nbytes` bytes (at least 4, as OpenCL has no empty ones), not initialised.

        Raises
        ------
        DeviceError : the device, or for a CPU the machine, has not that much memory.
        """
        import pyopencl as cl

        nbytes = max(int(nbytes), 4)
        limit, of_what = self._limit(nbytes)
        if nbytes > limit:
            raise _out_of_memory(nbytes, limit, of_what)
        try:
            buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, nbytes)
            if nbytes >= _EAGER_BYTES:
                # Drivers allocate at first use; touch the buffer so that failure shows here, with a size.
                cl.enqueue_fill_buffer(self.queue, buffer, np.zeros(1, np.int32), 0, 4)
        except (cl.MemoryError, cl.RuntimeError, cl.LogicError) as error:
            if not is_out_of_memory(error):
                raise
            raise _out_of_memory(nbytes, self.info.global_mem_bytes, "on the device, partly in use") from None
        return buffer

    def _limit(self, nbytes: int) -> tuple[int, str]:
        """Bytes that one buffer may have, and what sets that limit."""
        if nbytes > self.info.max_alloc_bytes:
            return self.info.max_alloc_bytes, "for one buffer"
        if nbytes >= _EAGER_BYTES and self.info.type == "CPU":
            # A CPU's buffers are lazy pages: without this look the kernel's OOM killer would speak first.
            return _available_host_bytes(), "free in this machine"
        return self.info.max_alloc_bytes, "for one buffer"

    def __repr__(self) -> str:
        return f"<Device {self.info}>"


def default_schedule(cl_device: Any) -> Schedule:
    """Schedule to begin with: wide lanes on CPUs, one pixel per work-item elsewhere (tuning.py measures)."""
    import pyopencl as cl

    if cl_device.type & cl.device_type.CPU:
        return SCHEDULES["cpu16"]
    return SCHEDULES["gpu256"] if cl_device.max_work_group_size >= SCHEDULES["gpu256"].group else SCHEDULES["gpu64"]


def list_devices() -> list[DeviceInfo]:
    """All OpenCL devices of all platforms, in the loader's order, unusable ones too; [] if none."""
    return [info for _, info in _all_devices()]


def open_device(spec: str | None = None) -> Device:
    """Open a device.

    Parameters
    ----------
    spec : None = the environment's PYOPENCL_CTX, else the best (GPUs before CPUs, PoCL before Intel's
        runtime); "cpu" or "gpu"; an index as `list_devices` gives, "0:1" ("0" = platform 0's first device);
        or a part of a platform's or device's name, any case (platforms are looked through first).

    Raises
    ------
    DeviceError : no platform, no such device, or only devices known not to work.
    """
    found = _all_devices()
    if not found:
        raise DeviceError(NO_PLATFORM)
    if spec is None and os.environ.get("PYOPENCL_CTX"):
        matching = _from_environment(found)
        spec = f"PYOPENCL_CTX={os.environ['PYOPENCL_CTX']}"
    else:
        matching = _matching(found, spec)
    if not matching:
        listed = "; ".join(str(info) for _, info in found)
        raise DeviceError(f"device {spec!r} not found: choose one of {listed}")
    usable = [pair for pair in matching if pair[1].ailment is None]
    if not usable:
        raise DeviceError(f"device {matching[0][1]}: {matching[0][1].ailment}")
    cl_device, info = min(usable, key=lambda pair: _rank(pair[1]))
    return Device(cl_device, info)


def is_out_of_memory(error: Exception) -> bool:
    """Whether an OpenCL error says that memory is lacking."""
    import pyopencl as cl

    codes = (
        cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
        cl.status_code.OUT_OF_RESOURCES,
        cl.status_code.OUT_OF_HOST_MEMORY,
        cl.status_code.INVALID_BUFFER_SIZE,
    )
    return isinstance(error, cl.MemoryError) or getattr(error, "code", None) in codes


def first_line(error: object) -> str:
    """First non-empty line of an error's text."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _all_devices() -> list[Found]:
    register_pip_runtime()  # before the loader's first look at the vendors' folder
    try:
        import pyopencl as cl

        platforms = cl.get_platforms()
    except ImportError as error:
        raise DeviceError(f"pyopencl cannot be imported ({first_line(error)}): `pip install pyopencl`") from None
    except cl.Error:  # PLATFORM_NOT_FOUND_KHR: the loader works and knows no platform
        return []
    found = []
    for p, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:  # DEVICE_NOT_FOUND: a driver without its hardware
            continue
        found += [(device, _describe(f"{p}:{d}", platform, device)) for d, device in enumerate(devices)]
    return found


def _describe(index: str, platform: Any, device: Any) -> DeviceInfo:
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
        max_group=device.max_work_group_size,
        has_fp64="cl_khr_fp64" in device.extensions.split(),
        compute_units=device.max_compute_units,
    )


def _type_name(bits: int) -> str:
    """One of "CPU", "GPU" and "other"; a simulator that claims to be everything counts as a CPU."""
    import pyopencl as cl

    if bits & cl.device_type.CPU:
        return "CPU"
    return "GPU" if bits & cl.device_type.GPU else "other"


def _rank(info: DeviceInfo) -> tuple[int, int, int]:
    """Order of preference, smallest first; among GPUs more units win, then the loader's order."""
    kind = {"GPU": 0, "CPU": 1}.get(info.type, 2)
    if info.platform == "Oclgrind" or "llvmpipe" in info.name:
        return 3, 0, 0  # a checker and a fallback renderer: right, and slow
    order = 0 if info.platform == "Portable Computing Language" else 1
    return kind, order if kind else 0, -info.compute_units if kind == 0 else 0


def _matching(found: list[Found], spec: str | None) -> list[Found]:
    """The devices meant by `spec`, see `open_device`."""
    if spec is None:
        return found
    wanted = spec.strip().lower()
    if wanted in ("cpu", "gpu"):
        return [pair for pair in found if pair[1].type.lower() == wanted]
    if wanted.replace(":", "", 1).isdigit():
        index = wanted if ":" in wanted else f"{wanted}:0"
        return [pair for pair in found if pair[1].index == index]
    if not wanted:
        return []
    # Platforms first: "intel" means Intel's runtime, not PoCL on a processor of that make.
    by_platform = [pair for pair in found if wanted in pair[1].platform.lower()]
    return by_platform or [pair for pair in found if wanted in pair[1].name.lower()]


def _from_environment(found: list[Found]) -> list[Found]:
    """The device that pyopencl's own reading of PYOPENCL_CTX gives, or none."""
    import pyopencl as cl

    try:
        chosen = cl.choose_devices(interactive=False)
    except (cl.Error, RuntimeError, ValueError, IndexError):
        return []
    return [pair for pair in found if pair[0] == chosen[0]]


def _available_host_bytes() -> int:
    """Memory that the machine can still give (Linux), else a number that never limits."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 1 << 62


def _out_of_memory(needed: int, limit: int, of_what: str) -> DeviceError:
    return DeviceError(
        f"device out of memory: needs {needed / MIB:.0f} MB, has {limit / MIB:.0f} MB {of_what}: {LESS_MEMORY}"
    )
