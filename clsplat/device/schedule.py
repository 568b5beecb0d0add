"""Schedules: how the pixels of a tile are distributed over the work-items of a device."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import OTHER_DEVICE, DeviceError, Remedy
from .device import DeviceInfo

TILE = 16  # side of a tile [px]
_LANES = (1, 8, 16)  # widths that cl/math/lanes.clh implements
SUM_PART = 32  # work-items of a part of a sum (cl/render/group.clh); a group has a whole number of parts


@dataclass(frozen=True, slots=True)
class Schedule:
    """Work-items x vectors of each work-item x lanes of each vector, for one tile.

    The product is the number of pixels of a tile, 256.

    Raises
    ------
    DeviceError : no kernel implements this combination.
    """

    group: int
    vecs: int
    lanes: int

    def __post_init__(self) -> None:
        if min(self.group, self.vecs, self.lanes) < 1 or self.group * self.vecs * self.lanes != TILE * TILE:
            raise DeviceError(f"schedule {self}: GROUPxVECSxLANES must multiply to {TILE * TILE}")
        if self.lanes not in _LANES:
            raise DeviceError(f"schedule {self}: LANES must be 1, 8 or 16")
        if self.group > 1 and self.group % SUM_PART:
            raise DeviceError(f"schedule {self}: GROUP must be 1 or a multiple of {SUM_PART}")

    def __str__(self) -> str:
        return f"{self.group}x{self.vecs}x{self.lanes}"

    @property
    def block(self) -> tuple[int, int]:
        """Width and height of the block of pixels in a vector [px]: BLOCK_W and BLOCK_H of cl/math/lanes.clh."""
        return (1, 1) if self.lanes == 1 else (4, self.lanes // 4)

    @classmethod
    def parse(cls, text: str) -> Schedule:
        """Return the schedule for a name of `SCHEDULES` or a text "GROUPxVECSxLANES".

        Raises
        ------
        DeviceError : the text is neither.
        """
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
    "gpu32": Schedule(32, 8, 1),
}


def default_schedule(info: DeviceInfo) -> Schedule:
    """Return the schedule of an unmeasured device: wide lanes where they are fast, else the largest group."""
    if info.has_wide_lanes:
        return SCHEDULES["cpu16"]
    fitting = (name for name in ("gpu256", "gpu64", "gpu32") if SCHEDULES[name].group <= info.max_group)
    return SCHEDULES[next(fitting, "scalar")]


def require_groups(schedule: Schedule, info: DeviceInfo, max_group: int) -> None:
    """Raise DeviceError if a schedule has larger work-groups than a device, or its kernels, can have."""
    if schedule.group > max_group:
        raise DeviceError(
            f"schedule {schedule}: {info} has work-groups of {max_group} at most",
            Remedy("choose a schedule with smaller groups, such as scalar"),
            OTHER_DEVICE,
        )
