"""Several devices that one run uses (specs.py)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..errors import DeviceError
from .device import Device, open_device
from .opencl import first_line
from .specs import device_specs

if TYPE_CHECKING:
    import pyopencl


def open_devices(spec: str | None) -> list[Device]:
    """Open all devices that `spec` lists.

    Parameters
    ----------
    spec : a spec of `open_device`, or several with commas between. One with "/N" after it stands for N parts of the
        device with equal numbers of compute units.

    Raises
    ------
    DeviceError : as `open_device`; a device is listed twice, or cannot be parted.
    """
    devices: list[Device] = []
    for one in device_specs(spec):
        for device in _parted(open_device(one.device), one.parts):
            if device.info.index in {other.info.index for other in devices}:
                raise DeviceError(f"device {spec!r} lists {device.info} twice: name each device once")
            devices.append(device)
    return devices


def _parted(device: Device, count: int) -> list[Device]:
    """Return `count` parts of a device, each with its equal share of compute units and a context of its own."""
    import pyopencl as cl

    info, units = device.info, device.info.compute_units
    if count < 1 or units % count:
        divisors = ", ".join(str(n) for n in range(1, units + 1) if units % n == 0)
        raise DeviceError(f"device {info} has {units} compute units: use one of /{divisors} for equal parts")
    if count == 1:
        return [device]
    try:
        share = units // count
        equally: list[Any] = [cl.device_partition_property.EQUALLY, share]
        parts: list[pyopencl.Device] = device.cl_device.create_sub_devices(equally)
    except cl.Error as error:
        raise DeviceError(f"device {info} cannot be parted ({first_line(error)}): name whole devices") from None
    return [
        Device(part, replace(info, index=f"{info.index}/{number}", compute_units=share))
        for number, part in enumerate(parts[:count])
    ]
