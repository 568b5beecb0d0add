"""Texts that name devices: one, several with commas between ("0:0,0:1"), or the equal parts of one ("cpu/2")."""

from __future__ import annotations

import re
from typing import NamedTuple

from ..errors import InputError

_PARTS = re.compile(r"(?P<device>.*)/(?P<count>\d+)")


class DeviceSpec(NamedTuple):
    """A device, by a spec of `open_device`, and the number of equal parts that are used as devices."""

    device: str | None
    parts: int


def device_specs(spec: str | None) -> list[DeviceSpec]:
    """Return the devices that `spec` lists, without a look at them. Raise InputError if it is not a text."""
    if not isinstance(spec, str | None):
        raise InputError(f'device {spec!r}: expected a text such as "cpu", "gpu" or "0:1", or None for the best one')
    found = []
    for one in [None] if spec is None else [part.strip() for part in spec.split(",")]:
        parted = None if one is None else _PARTS.fullmatch(one)
        found.append(DeviceSpec(parted["device"], int(parted["count"])) if parted else DeviceSpec(one, 1))
    return found


def first_device(spec: str | None) -> str | None:
    """Return the spec of the first device that `spec` lists, as a whole."""
    return device_specs(spec)[0].device


def count_devices(spec: str | None) -> int:
    """Return the number of devices that `spec` lists."""
    return sum(one.parts for one in device_specs(spec))
