"""Checkpoints: the state of a run between two iterations, in one file that is replaced only by a complete one."""

from __future__ import annotations

import json
import lzma
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..device.pending_arrays import PendingArrays
from ..errors import InputError, Remedy
from ..files.atomic import atomic_writer
from ..rendering.splat_buffers import SplatStatistics
from ..splats.fields import MAX_SH_DEGREE, Array
from .config import TrainConfig

VERSION = 4
READABLE = (2, 3, VERSION)  # version 2 has no `reached`, and both have no `average`; `left_out` is optional


class UnusableCheckpoint(InputError):
    """A checkpoint cannot be read, or is not that of the run."""


@dataclass(frozen=True)
class Reached:
    """Limits of the schedules of a run that was made longer.

    The schedules depend on the length of the run. Those of a longer run are at an earlier stage in the same iteration.

    Attributes
    ----------
    sh_degree : lowest SH degree. downscale : largest downscale of the images.
    """

    sh_degree: int
    downscale: int


@dataclass(frozen=True)
class Checkpoint:
    """The state that the rest of a run depends on.

    Parameters
    ----------
    iteration : number of iterations done.
    config : the run's options, as JSON.
    splats : public arrays by field. The host holds those of a run one at a time (`PendingArrays`).
    optimizer : the optimizer's state by key, in the same way.
    rng : state of the NumPy generator, as JSON.
    queue : training views that remain in this epoch.
    seconds : training time so far.
    schedule : schedule of the kernels, which their rounding depends on.
    n_first : number of splats at the start of the run, which the growth depends on.
    statistics : densification statistics, (SplatStatistics.ROWS, N).
    reached : limits of the schedules, if the run was made longer.
    average : state of the `ParameterAverage` by key, empty before the last part of the run. It leaves
        out the last splats if they do not change.
    left_out : indices of training views that the rest of the run leaves out.
    """

    iteration: int
    config: dict[str, Any]
    splats: Mapping[str, Array]
    optimizer: Mapping[str, NDArray[Any]]
    rng: dict[str, Any]
    queue: list[int]
    seconds: float
    schedule: str
    n_first: int
    statistics: Array
    reached: Reached | None = None
    average: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    left_out: list[int] = field(default_factory=list)

    @property
    def is_finished(self) -> bool:
        """Whether it is the end of its run. Then the run that goes on from it is a longer one."""
        return bool(self.iteration >= self.config["iterations"])

    def save(self, path: Path) -> None:
        """Write the checkpoint to a file. If that fails, raise OutputError and keep the old file."""
        meta = {
            "version": VERSION,
            "iteration": self.iteration,
            "config": self.config,
            "rng": self.rng,
            "queue": self.queue,
            "seconds": self.seconds,
            "schedule": self.schedule,
            "n_first": self.n_first,
            "reached": self.reached and asdict(self.reached),
            "left_out": self.left_out,
        }
        single = {_STATISTICS: self.statistics, "meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)}
        groups = {"splats.": self.splats, "optimizer.": self.optimizer, "average.": self.average, "": single}
        # As `np.savez` does, which would hold all arrays at once.
        with atomic_writer(path) as stream, zipfile.ZipFile(stream, "w") as archive:
            for prefix, arrays in groups.items():
                for name in arrays:
                    with archive.open(f"{prefix}{name}.npy", "w", force_zip64=True) as member:
                        np.lib.format.write_array(member, arrays[name], allow_pickle=False)

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Return the checkpoint in a file. Its arrays are read from there whenever they are asked for.

        Each is also read once now, which finds damaged bytes.

        Raises
        ------
        UnusableCheckpoint : it is damaged. InputError : it is missing, or of another version.
        """
        headers = _headers(path)
        meta = _meta(path, _arrays(path, "meta"))

        def part(prefix: str) -> PendingArrays:
            names = [name for name in headers if name.startswith(prefix)]
            return PendingArrays({name.removeprefix(prefix): partial(_array, path, name) for name in names})

        try:
            checkpoint = cls(
                meta["iteration"],
                meta["config"],
                part("splats."),
                part("optimizer."),
                meta["rng"],
                meta["queue"],
                meta["seconds"],
                meta["schedule"],
                meta["n_first"],
                _array(path, _STATISTICS),
                Reached(**meta["reached"]) if meta.get("reached") else None,
                part("average."),
                meta.get("left_out", []),
            )
            checkpoint._check(headers)
        except _DAMAGE as error:
            raise _unreadable(path, str(error)) from None
        return checkpoint

    @staticmethod
    def options(path: Path) -> dict[str, Any]:
        """Return all options of the run of a checkpoint, without its arrays. It raises what `load` raises."""
        meta = _meta(path, _arrays(path, "meta"))
        try:
            return TrainConfig.from_json(meta["config"]).to_json()
        except (*_DAMAGE, InputError) as error:
            raise _unreadable(path, str(error)) from None

    def _check(self, headers: Mapping[str, _Header]) -> None:
        """Raise one of _DAMAGE if `save` cannot have written a value.

        The zip's checksums find damaged bytes. This check finds files of other programs.
        """

        def shapes(prefix: str) -> dict[str, tuple[int, ...]]:
            return {k.removeprefix(prefix): header.shape for k, header in headers.items() if k.startswith(prefix)}

        for name, kind in _KINDS.items():
            value = getattr(self, name)
            if not isinstance(value, kind) or isinstance(value, bool):
                raise ValueError(f"its {name} is of another kind")
        if self.iteration < 0 or self.n_first < 1 or not 0 <= self.seconds < math.inf:
            raise ValueError("its iteration, n_first or seconds are out of range")
        if self.reached is not None:
            degree, downscale = self.reached.sh_degree, self.reached.downscale
            if not (type(degree) is type(downscale) is int and 0 <= degree <= MAX_SH_DEGREE and downscale >= 1):
                raise ValueError("its reached is not a degree and a downscale")
        for name, places in (("queue", self.queue), ("left_out", self.left_out)):
            if not all(type(place) is int and place >= 0 for place in places):
                raise ValueError(f"its {name} is not a list of views")
        np.random.default_rng().bit_generator.state = self.rng
        if not all(header.kind in "fiu" and header.shape for name, header in headers.items() if name != "meta"):
            raise ValueError("it holds something that is not an array of numbers")
        splats, average = shapes("splats."), shapes("average.")
        n = splats["mean"][0]
        expected = (SplatStatistics.ROWS, n)
        if any(shape[0] != n for shape in splats.values()) or self.statistics.shape != expected:
            raise ValueError("its arrays are not of the same splats")
        if average:
            if average.pop("count") != (1,) or self.average["count"][0] < 1:
                raise ValueError("its average has no count")
            counts = {shape[0] for shape in average.values()}
            fields = {name: shape[1:] for name, shape in splats.items()}
            if {name: shape[1:] for name, shape in average.items()} != fields or len(counts) > 1 or max(counts) > n:
                raise ValueError("its average is not of the same splats")


_STATISTICS = "signals"  # key in the file, as in the first versions
_KINDS = {
    "iteration": int,
    "config": dict,
    "rng": dict,
    "queue": list,
    "left_out": list,
    "seconds": int | float,
    "schedule": str,
    "n_first": int,
}
_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    EOFError,
    RuntimeError,  # also an encrypted archive, and NotImplementedError for a later version of zip files
    lzma.LZMAError,
    zipfile.BadZipFile,
    zlib.error,
)


class _Header(NamedTuple):
    """Shape and kind (`numpy.dtype.kind`) of an array in a file."""

    shape: tuple[int, ...]
    kind: str


def _headers(path: Path) -> dict[str, _Header]:
    """Read each array of a file once, and return their headers by name. It raises what `Checkpoint.load` raises."""

    def header(array: NDArray[Any]) -> _Header:
        return _Header(array.shape, array.dtype.kind)

    with _opened(path) as stored:
        return {name: header(stored[name]) for name in stored.files}


def _arrays(path: Path, *names: str) -> dict[str, NDArray[Any]]:
    """Return arrays of a file of checkpoints by name. It raises what `Checkpoint.load` raises."""
    with _opened(path) as stored:
        return {name: stored[name] for name in names}


def _array(path: Path, name: str) -> NDArray[Any]:
    return _arrays(path, name)[name]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield the archive in a file. Raise what `Checkpoint.load` raises if it cannot be opened or read."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            yield stored
    except FileNotFoundError:
        raise InputError(f"{path}: no checkpoint to resume from: start without --resume") from None
    except _DAMAGE as error:
        raise _unreadable(path, "no archive of NumPy" if "pickle" in str(error) else str(error)) from None


def _meta(path: Path, arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Remove "meta" from the arrays of a checkpoint, and return its values. It raises what `Checkpoint.load` raises."""
    try:
        meta = json.loads(arrays.pop("meta").tobytes())
        version = meta["version"]
    except _DAMAGE as error:
        raise _unreadable(path, str(error)) from None
    if version not in READABLE:
        raise InputError(f"{path}: checkpoint version {str(version)[:20]!r}, this clsplat reads {VERSION}")
    known: dict[str, Any] = meta
    return known


def _unreadable(path: Path, why: str) -> UnusableCheckpoint:
    reason = why.splitlines()[0] if why else "damaged"
    return UnusableCheckpoint(f"{path}: not a readable checkpoint ({reason})", Remedy("start again", "--overwrite"))
