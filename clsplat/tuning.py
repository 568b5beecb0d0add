"""Which schedule a device runs best."""

from .device import Device, Schedule, default_schedule


def schedule_for(device: Device) -> Schedule:
    return default_schedule(device.cl_device)
