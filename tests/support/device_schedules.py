"""The schedules that a device is tested with, and devices that pretend to be of another kind."""

from __future__ import annotations

from dataclasses import replace

import pytest

from clsplat.device.device import Device, DeviceInfo, open_device
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


def as_kind(device: Device, kind: str) -> Device:
    """Return the device opened once more, with this type."""
    other = open_device(device.info.index)
    other.info = replace(other.info, type=kind)
    return other
