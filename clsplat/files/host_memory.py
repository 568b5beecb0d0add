"""Free memory of the machine."""

from __future__ import annotations


def available_bytes() -> int:
    """Return the free memory of the machine on Linux; on other systems a number that never limits."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 1 << 62
