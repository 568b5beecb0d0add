"""Texts that name devices: one, several with commas between ("0:0,0:1"), or the equal parts of one ("cpu/2")."""

from __future__ import annotations

import re

PARTS = re.compile(r"(?P<device>.*)/(?P<count>\d+)")


def device_specs(spec: str | None) -> list[str | None]:
    """Return the specs of single devices that `spec` lists. A device with parts, such as "cpu/2", stays one spec."""
    return [None] if spec is None else [part.strip() for part in spec.split(",")]


def first_device(spec: str | None) -> str | None:
    """Return the spec of the first device that `spec` lists, as a whole."""
    first = device_specs(spec)[0]
    found = None if first is None else PARTS.fullmatch(first)
    return found["device"] if found else first


def count_devices(spec: str | None) -> int:
    """Return the number of devices that `spec` lists, without a look at the devices."""
    found = (None if one is None else PARTS.fullmatch(one) for one in device_specs(spec))
    return sum(int(parts["count"]) if parts else 1 for parts in found)
