"""A number above 0 that belongs to a model: its check, and the comment that keeps it in a PLY file."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

from ..errors import InputError


@dataclass(frozen=True)
class ModelNumber:
    """A number above 0 that belongs to a model.

    Attributes
    ----------
    name : as in the comment of a PLY file, such as "near_plane".
    usual : its value in models that name none.
    what : what to give instead of an unusable value, such as "a depth above 0".
    """

    name: str
    usual: float
    what: str

    @staticmethod
    def accepts(value: Any) -> bool:
        """Return whether a value of a file is a number above 0 and finite."""
        return type(value) in (int, float) and 0.0 < value < math.inf

    def usable(self, value: float) -> float:
        """Return the value as a float. Raise InputError if it is not above 0 and finite."""
        if isinstance(value, bool) or not isinstance(value, Real) or not 0.0 < value < math.inf:
            raise InputError(f"{self.name.replace('_', ' ')} {value}: give {self.what}")
        return float(value)

    def comments(self, value: float) -> list[str]:
        """Return the comments of a PLY file that keep the value to the bit; none if it is the usual one."""
        return [] if value == self.usual else [f"{self._start}{value!r}"]

    def find(self, path: Path, comments: Iterable[str]) -> float:
        """Return the value that the comments of a PLY file name. Raise InputError if it is unusable."""
        for comment in comments:
            if comment.startswith(self._start):
                try:
                    return self.usable(float(comment.removeprefix(self._start)))
                except (ValueError, InputError):
                    raise InputError(f"{path}: comment {comment[:80]!r}: give {self.what}, or remove it") from None
        return self.usual

    @property
    def _start(self) -> str:
        return f"clsplat {self.name}="
