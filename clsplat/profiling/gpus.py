"""Stated rates of GPUs, for predictions of time, and their correction by what a device measures."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from ..device.device import Device
from .roofline import Roofline

_GIB = 1 << 30
# Shares of the stated rates that kernels reach: fitted to an H100 (benchmarks/GPU.md). That of local memory is assumed.
BANDWIDTH_USE, ISSUE_USE, LOCAL_USE = 0.8, 0.42, 0.85
# Words after the name of a GPU that make it another one.
_OTHER_MODELS = ("Ti", "SUPER", "Laptop", "Max-Q", "D", "NVL")


@dataclass(frozen=True)
class Gpu:
    """Stated rates of a GPU.

    Attributes
    ----------
    name : as it occurs in the name of the OpenCL device.
    units : multiprocessors (NVIDIA), compute units (AMD) or Xe cores (Intel).
    lanes : float32 instructions of work-items that a unit starts in a clock.
    clock : boost clock [GHz].
    bandwidth : of the device memory [GB/s].
    memory : device memory [bytes].
    local : bytes of local memory that a unit reads or writes in a clock.
    launch_us : device time of a launch besides its work [us].
    """

    name: str
    units: int
    lanes: int
    clock: float
    bandwidth: float
    memory: int
    local: int = 128
    launch_us: float = 6.0

    @property
    def bytes_per_ms(self) -> float:
        """Bytes of device memory that kernels move in a millisecond."""
        return 1e6 * self.bandwidth * BANDWIDTH_USE

    @property
    def instructions_per_ms(self) -> float:
        """Instructions of work-items that kernels start in a millisecond."""
        return 1e6 * self.units * self.lanes * self.clock * ISSUE_USE

    @property
    def local_bytes_per_ms(self) -> float:
        """Bytes of local memory that kernels read or write in a millisecond."""
        return 1e6 * self.units * self.local * self.clock * LOCAL_USE


# Sources of units, lanes, clock, bandwidth and memory: the makers' data sheets. NVIDIA: "GA102/AD102 GPU Architecture"
# and the pages of the RTX 3060, RTX 4090, H100 SXM and H200 SXM. AMD: "RDNA 3 Instruction Set Architecture" and the
# page of the RX 7900 XTX; pairs of instructions in one clock are not counted, because compilers rarely find them.
# Intel: "Xe-HPG Architecture" and the page of the Arc A770 with 16 GB. A unit of local memory has 32 banks of 4 bytes
# on NVIDIA's and AMD's. For Intel's this is an assumption. The time of a launch was fitted to an H100; those of AMD and
# Intel are assumed.
GPUS = (
    Gpu("RTX 3060", units=28, lanes=128, clock=1.78, bandwidth=360, memory=12 * _GIB),
    Gpu("RTX 4090", units=128, lanes=128, clock=2.52, bandwidth=1008, memory=24 * _GIB),
    Gpu("H100 80GB HBM3", units=132, lanes=128, clock=1.98, bandwidth=3350, memory=80 * 10**9),
    Gpu("H200", units=132, lanes=128, clock=1.98, bandwidth=4800, memory=141 * 10**9),
    Gpu("RX 7900 XTX", units=96, lanes=64, clock=2.5, bandwidth=960, memory=24 * _GIB, launch_us=10.0),
    Gpu("A770", units=32, lanes=128, clock=2.1, bandwidth=560, memory=16 * _GIB, launch_us=16.0),
)
_REFERENCE = GPUS[0]  # an unknown GPU is this one with other units and another clock


def gpu_of(device: Device) -> Gpu | None:
    """Return the stated rates of a device; None if it is not a GPU.

    A GPU that is not in `GPUS` has the rates of an RTX 3060, scaled by compute units times clock.
    """
    info = device.info
    if info.type != "GPU":
        return None
    for gpu in GPUS:
        if re.search(rf"\b{gpu.name}\b(?! *(?:{'|'.join(_OTHER_MODELS)})\b)", info.name):
            return gpu
    units = info.compute_units or _REFERENCE.units
    clock = 1e-3 * int(getattr(device.cl_device, "max_clock_frequency", 0)) or _REFERENCE.clock
    scale = units * clock / (_REFERENCE.units * _REFERENCE.clock)
    return replace(
        _REFERENCE,
        name=info.name,
        units=units,
        clock=clock,
        bandwidth=_REFERENCE.bandwidth * scale,
        memory=info.global_mem_bytes,
    )


def corrected(gpu: Gpu, limits: Roofline) -> Gpu:
    """Return the GPU with the measured limits of the device instead of the stated bandwidth and clock."""
    return replace(
        gpu,
        bandwidth=1e-9 * limits.copy / BANDWIDTH_USE,  # what a copy reaches is the limit of kernels, too
        clock=1e-9 * limits.fma / (2 * gpu.units * gpu.lanes),
    )
