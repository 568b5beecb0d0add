"""Where the workers are: the address of a scheduler, its scheduler file, or "local" for processes of this machine."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ..errors import InputError

LOCAL = "local"
MOST_WORKERS = 1000  # of one machine
EXPECTED = "give tcp://HOST:8786, the path of a scheduler file (.json), local, or local:N for N workers of this machine"
_ADDRESS = re.compile(r"(?:(?:tcp|tls|ws|wss|ucx)://)?[^\s/:]+:\d{1,5}|(?:tcp|tls|ws|wss|ucx)://[^\s/]+")
_LOCAL = re.compile(r"local(?::(.*))?")


@dataclass(frozen=True)
class ClusterAddress:
    """A place with workers.

    Attributes
    ----------
    text : the address as it was given.
    is_local : whether the workers are processes of this machine that clsplat starts.
    workers : number of these processes; None for one on each GPU, or for every two cores of a CPU.
    """

    text: str
    is_local: bool = False
    workers: int | None = None

    @classmethod
    def parse(cls, text: str) -> ClusterAddress:
        """Return the place that a text names. Raise InputError if it names none."""
        if local := _LOCAL.fullmatch(text):
            if local[1] is None:
                return cls(text, True)
            if not re.fullmatch(r"[0-9]{1,4}", local[1]) or not 1 <= int(local[1]) <= MOST_WORKERS:
                raise InputError(f"cluster {text}: give 1 to {MOST_WORKERS} workers, such as {LOCAL}:2")
            return cls(text, True, int(local[1]))
        if not text.endswith(".json") and not _ADDRESS.fullmatch(text):
            raise InputError(f"cluster {text!r}: not an address: {EXPECTED}")
        return cls(text)

    @property
    def is_file(self) -> bool:
        """Whether the text is the path of a scheduler file, which contains the address."""
        return not self.is_local and self.text.endswith(".json")
