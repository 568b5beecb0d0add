"""A model of the time of a training step on a GPU: counted work over the rates of the GPU.

A stage takes as long as its slowest resource, and every launch adds its time. Latency, caches and uneven tiles are not
modelled. The stages follow one another, as commands of one queue do.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ..device.schedule import Schedule
from ..rendering.build import KernelBuild
from .gpu_counts import GPU_SCHEDULES, Counts, Shares, counts_of
from .gpus import Gpu
from .stages import HOST, Sizes

HOST_US = 9.0  # time of the host for a command (docs/decisions.md)
WAIT_US = 40.0  # time that the device is idle while the host reads a number and goes on; an assumption


@dataclass(frozen=True)
class Predicted:
    """Predicted times of a stage [ms], by resource.

    Attributes
    ----------
    bandwidth, instructions, local : time that the stage needs of each resource if the others are free.
    launches : time of the launches and waits, which comes in addition.
    """

    stage: str
    bandwidth: float = 0.0
    instructions: float = 0.0
    local: float = 0.0
    launches: float = 0.0

    @property
    def ms(self) -> float:
        """Time of the stage."""
        return max(self.bandwidth, self.instructions, self.local) + self.launches

    @property
    def bound(self) -> str:
        """The resource that takes the longest."""
        times = {
            "launches": self.launches,
            "bandwidth": self.bandwidth,
            "instructions": self.instructions,
            "local memory": self.local,
        }
        return max(times, key=times.__getitem__)


def stage_time(stage: str, counts: Counts, gpu: Gpu) -> Predicted:
    """Return the time of counted work."""
    return Predicted(
        stage,
        counts.bytes / gpu.bytes_per_ms,
        counts.instructions / gpu.instructions_per_ms,
        counts.local_bytes / gpu.local_bytes_per_ms,
        1e-3 * (counts.commands * gpu.launch_us + counts.waits * WAIT_US),
    )


def predict(
    kernels: KernelBuild,
    sizes: Sizes,
    gpu: Gpu,
    schedule: Schedule | None = None,
    shares: Shares | None = None,
    stages: Iterable[str] | None = None,
) -> tuple[Predicted, ...]:
    """Return the stages of a training step, in order. The last one is the host's time that the device does not cover.

    Parameters
    ----------
    schedule : None for the fastest one, as the tuner would choose it. A schedule of processors counts as None.
    shares : how much of the listed work is done; None for the defaults of `Shares`.
    stages : names of the stages that count; None for all.
    """
    if schedule is None or schedule.group == 1:
        schedule = GPU_SCHEDULES[fastest_schedule(kernels, sizes, gpu, shares)]
    counts = counts_of(kernels, sizes, schedule, gpu.units, shares)
    counts = counts if stages is None else {stage: counts[stage] for stage in counts if stage in set(stages)}
    device = [stage_time(stage, one, gpu) for stage, one in counts.items()]
    host_ms = 1e-3 * HOST_US * sum(one.commands for one in counts.values())
    return (*device, Predicted(HOST, launches=max(host_ms - total_ms(device), 0.0)))


def total_ms(stages: Iterable[Predicted]) -> float:
    """Return the time of all stages together."""
    return sum(stage.ms for stage in stages)


def fastest_schedule(kernels: KernelBuild, sizes: Sizes, gpu: Gpu, shares: Shares | None = None) -> str:
    """Return the name of the schedule whose step takes the device the shortest time."""

    def device_ms(name: str) -> float:
        return total_ms(predict(kernels, sizes, gpu, GPU_SCHEDULES[name], shares)[:-1])

    return min(GPU_SCHEDULES, key=device_ms)
