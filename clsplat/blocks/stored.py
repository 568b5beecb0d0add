"""Checks of what the finished stages of a training have written. Each message says what to remove, to lose the least.

Files of stages that are missing are made again. A damaged one would be, too, but only the user may remove a file.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import InputError, Remedy, reason_of
from ..files.json_file import to_real
from ..splats.splats import Splats
from ..training.exposure_file import read_exposures
from ..training.folder import ModelFolder
from ..training.stored_run import DAMAGE
from .partition import BlockViews, Partition
from .state import BlocksState

T = TypeVar("T")

START_AGAIN = Remedy("start again", "--overwrite")
MAKE_AGAIN = Remedy("remove this file and resume; it is made again")
# What to remove from blocks.json, by the key whose value is damaged.
_KEYS = {
    "coarse": Remedy('remove "coarse" from it and resume; the finished run is kept'),
    "partition": Remedy('remove "partition" from it and resume; the scene is divided again'),
    "caps": Remedy('remove "caps" from it and resume'),
    "blocks": Remedy('remove "blocks" from it and resume; finished runs are kept'),
}
# Numbers of the row of a block in "blocks".
_NUMBERS = ("number", "views", "splats", "context", "seconds", "device_bytes", "peak_bytes")


def splats_of(file: Path, remedy: Remedy = MAKE_AGAIN) -> Splats:
    """Return the splats in a file of a stage. Raise InputError with the remedy if it cannot be read."""
    try:
        return Splats.load(file)
    except InputError as error:
        raise InputError(f"{file}: damaged ({reason_of(error).removeprefix(f'{file}: ')})", remedy) from None


def kept_or_made(file: Path, make: Callable[[], Splats]) -> Splats:
    """Return the splats in a file of a block, which is made if it is missing. Raise InputError if it is damaged."""
    if file.is_file():
        return splats_of(file)
    made = make()
    made.save(file)
    return made


def check_inside(folder: Path, stored: Splats, inside: Splats) -> None:
    """Raise InputError unless the folder of a block belongs to this partition of the coarse model.

    Parameters
    ----------
    stored : its splats of the coarse model in the folder. inside : those in its cell.
    """
    if not np.array_equal(stored.mean, inside.mean):
        other = Remedy("remove this folder and resume; other blocks are kept")
        raise InputError(f"{folder}: is a block of another partition or of another coarse model", other)


def check_exposures(stage: ModelFolder) -> None:
    """Raise InputError if the exposures of a finished stage are missing or damaged."""
    file = stage.exposures_path
    try:
        read_exposures(file)
    except InputError:
        if stage.path.name == "coarse":
            raise InputError(f"{file}: missing or damaged", START_AGAIN) from None
        run = Remedy("remove checkpoint.npz beside it and resume; other finished runs are kept")
        raise InputError(f"{file}: missing or damaged", run) from None


def stored_partition(state: BlocksState, columns: int, rows: int, names: Collection[str]) -> Partition:
    """Return the partition in blocks.json.

    Parameters
    ----------
    columns, rows : of the grid. names : of all training views.

    Raises
    ------
    InputError : it is damaged. A block with a test view, for example, would make its measurement worthless.
    """

    def sound(values: Any) -> Partition:
        found = Partition.from_json(values)
        cells, blocks = found.cells, found.blocks
        _must(cells.axes.shape == (2, 3) and np.allclose(cells.axes @ cells.axes.T, np.eye(2)), "axes")
        _must(cells.columns.shape == (columns - 1,) and _rising(cells.columns), "columns")
        _must(cells.rows.shape == (columns, rows - 1) and _rising(cells.rows), "rows")
        _must([block.number for block in blocks] == list(range(columns * rows)), "numbers of the blocks")
        known = set(names)
        for block in blocks:
            _must(_has_views(block, known), f"block {block.number}")
        return found

    return _checked(state, "partition", sound)


def check_counts(state: BlocksState, partition: Partition, counts: Sequence[int]) -> None:
    """Raise InputError unless each cell has as many splats of the coarse model as when the scene was divided.

    counts : of all cells.
    """
    _checked(state, "partition", lambda _: _must([b.splats for b in partition.blocks] == list(counts), "borders"))


def left_out(state: BlocksState) -> frozenset[str]:
    """Return the photos that the coarse run has left out. Raise InputError if its result is damaged."""

    def sound(values: Any) -> frozenset[str]:
        names = values.get("left_out", [])
        _must(isinstance(names, list) and all(isinstance(name, str) for name in names), "left_out")
        return frozenset(names)

    return _checked(state, "coarse", sound)


def stored_caps(state: BlocksState, counts: Sequence[int]) -> list[int]:
    """Return the caps of the blocks that are trained. counts : of their splats of the coarse model."""

    def sound(values: Any) -> list[int]:
        _must(isinstance(values, list) and all(type(cap) is int and cap > 0 for cap in values), "numbers")
        _must(all(cap >= count for cap, count in zip(values, counts, strict=True)), "less than the coarse model has")
        return list(values)

    return _checked(state, "caps", sound)


def check_rows(state: BlocksState, numbers: Sequence[int]) -> None:
    """Raise InputError if the results of finished blocks are damaged. numbers : of the blocks that are trained."""

    def sound(rows: Any) -> None:
        _must(isinstance(rows, list) and [row["number"] for row in rows] == list(numbers), "numbers")
        for row in rows:
            _must(all((number := to_real(row[key])) is not None and number >= 0 for key in _NUMBERS), "numbers")

    _checked(state, "blocks", sound)


def _checked(state: BlocksState, key: str, sound: Callable[[Any], T]) -> T:
    """Return what `sound` makes of a value of blocks.json. It raises one of DAMAGE if no training can have written it.

    InputError names the file and what to remove.
    """
    try:
        return sound(state.values[key])
    except (*DAMAGE, IndexError, OverflowError) as error:
        raise InputError(f"{state.path}: damaged ({key}: {reason_of(error)})", _KEYS[key]) from None


def _must(condition: object, what: str) -> None:
    if not condition:
        raise ValueError(what)


def _rising(borders: Any) -> bool:
    """Return whether finite borders rise along the last axis."""
    return bool(np.isfinite(borders).all() and (np.diff(borders, axis=-1) >= 0).all())


def _has_views(block: BlockViews, names: set[str]) -> bool:
    """Return whether the views of a block are training views, each once, with the part of it that the block fills."""
    are_known = set(block.views) <= names and len(set(block.views)) == len(block.views) == len(block.shares)
    counted = all(type(count) is int and count >= 0 for count in (block.splats, block.points))
    shares = [to_real(share) for share in block.shares]
    return are_known and counted and all(share is not None and 0 <= share <= 1.01 for share in shares)
