"""The schedules that a device is tested with."""

from __future__ import annotations

import pytest

from clsplat.device.device import Device, DeviceInfo
from clsplat.device.schedule import SCHEDULES, Schedule


def suits(info: DeviceInfo, name: str) -> bool:
    """Return whether a device can run a schedule in reasonable time.

    A work-item with a whole tile needs more private memory than a GPU has, and Mesa compiles its kernels for minutes.
    """
    return info.has_wide_lanes or SCHEDULES[name].group > 1


def schedule_on(device: Device, name: str) -> Schedule:
    """Return the schedule of this name. The test is skipped on a device that the schedule does not suit."""
    if not suits(device.info, name):
        pytest.skip(f"{device.info} has no wide lanes")
    if SCHEDULES[name].group > device.info.max_group:
        pytest.skip(f"{device.info} has groups of {device.info.max_group} at most")
    return SCHEDULES[name]
