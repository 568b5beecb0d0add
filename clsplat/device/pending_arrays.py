"""Arrays on a device that are read when they are asked for, so that the host holds one of them at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from numpy.typing import NDArray


class PendingArrays(Mapping[str, NDArray[Any]]):
    """Arrays by name. Each is read anew whenever it is asked for, and has the values of that moment.

    Parameters
    ----------
    readers : functions that return the arrays, by name.
    """

    def __init__(self, readers: Mapping[str, Callable[[], NDArray[Any]]]) -> None:
        self._readers = dict(readers)

    @classmethod
    def of(cls, *parts: Mapping[str, NDArray[Any]], without: str = "") -> PendingArrays:
        """Return the arrays of several mappings, except the one with the name `without`. None is read."""
        return cls({name: partial(part.__getitem__, name) for part in parts for name in part if name != without})

    @classmethod
    def first_of(cls, arrays: Mapping[str, NDArray[Any]], n: int) -> PendingArrays:
        """Return the first n rows of arrays, without reading any."""

        def first(name: str) -> NDArray[Any]:
            return arrays[name][:n]

        return cls({name: partial(first, name) for name in arrays})

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._readers[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._readers)

    def __len__(self) -> int:
        return len(self._readers)
