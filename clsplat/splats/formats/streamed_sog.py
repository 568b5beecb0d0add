"""Streamed SOG of PlayCanvas, version 1: a scene in parts and levels of detail, which a viewer loads as it needs them.

Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog. A folder has lod-meta.json
and a folder with a SOG for each chunk. lod-meta.json has a binary tree of boxes. For each level, a leaf names a chunk
and the run of its splats there. Level 0 is the model. Each further level has about half as many Gaussians
(merging.py).
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._version import __version__
from ...errors import InputError, OutputError
from ...files.atomic import atomic_writer, move
from ..fields import Array, DoubleArray
from ..merging import Box, Level, boxes_of, leaves_of, levels_of
from ..morton import morton_order
from ..stored import StoredSplats, check_gaussian, joined_parts
from .sog import META, read_sog
from .sog_writer import sog_files

LOD_META = "lod-meta.json"
LEVELS, MAX_LEVELS = 4, 8  # by default, and at most
_VERSION = 1
_LEAF = 8192  # largest number of splats of a leaf at level 0
_CHUNK = 1 << 18  # splats of a chunk, from which the next one begins
_CHUNK_NAME = re.compile(r"\d+_\d+")  # level and number
_MAX_DEPTH = 64  # of a tree that is read


def write_streamed_sog(path: str | os.PathLike[str], splats: StoredSplats, levels: int) -> list[StoredSplats]:
    """Write lod-meta.json and the chunks beside it, and return the levels, the finest first.

    Folders of chunks that an earlier lod-meta.json at this place names are replaced, once the new ones are complete.

    Parameters
    ----------
    path : a file with the name lod-meta.json.
    levels : number of levels, 1 to 8. There are fewer if no splats are left to merge.

    Raises
    ------
    InputError : the shape is not Gaussian, there is no splat, or the number of levels is out of range.
    OutputError : a file cannot be written, or another folder has the name of a chunk.
    """
    path = Path(path)
    check_gaussian(path, splats.shape, LOD_META)
    if not 1 <= levels <= MAX_LEVELS:
        raise InputError(f"{path}: {levels} levels: choose 1 to {MAX_LEVELS}")
    if not len(splats.arrays["mean"]):
        raise InputError(f"{path}: the model has no splats; train it first")
    _refuse_foreign(path)
    leaves = leaves_of(splats.arrays["mean"], _LEAF)
    found = levels_of(splats.arrays, leaves, levels)
    stored = [splats, *(replace(splats, arrays=level.arrays()) for level in found[1:])]
    filenames: list[str] = []
    runs: list[dict[str, Any]] = [{} for _ in leaves]
    with _replaced_chunks(path) as folder:
        for number, (level, part) in enumerate(zip(found, stored, strict=True)):
            filenames += list(_write_level(path, folder, number, level, part, runs, len(filenames)))
    errors = np.stack([np.bincount(level.group, level.error, len(leaves)) for level in found], axis=1)
    boxes = boxes_of(found, len(leaves))
    tree = _tree(splats.arrays["mean"], leaves, runs, np.maximum.accumulate(errors, axis=1), boxes)
    document = {
        "version": _VERSION,
        "asset": {"generator": f"clsplat {__version__}"},
        "count": sum(map(len, found)),
        "counts": [len(level) for level in found],
        "lodLevels": len(found),
        "lodErrors": True,
        "filenames": filenames,
        "tree": tree,
    }
    with atomic_writer(path) as stream:
        stream.write(json.dumps(document, separators=(",", ":")).encode())
    return stored


@contextmanager
def _replaced_chunks(path: Path) -> Iterator[Path]:
    """Yield a folder for new chunks, which replace the old ones if the block succeeds."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield unfinished
        for name in _chunks(path):
            shutil.rmtree(path.parent / name)
        for folder in sorted(unfinished.iterdir()):
            move(folder, path.parent / folder.name)
    except OutputError as error:
        raise OutputError(str(error).replace(f"{unfinished.name}{os.sep}", "")) from None
    except OSError as error:
        raise OutputError(
            f"{path}: its chunks cannot be written ({error.strerror or error}); choose another place"
        ) from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _refuse_foreign(path: Path) -> None:
    """Raise OutputError if a folder has the name of a chunk, but is not one of the lod-meta.json that is there."""
    known = _chunks(path)
    for folder in sorted(path.parent.iterdir()) if path.parent.is_dir() else ():
        if _CHUNK_NAME.fullmatch(folder.name) and folder.name not in known:
            raise OutputError(f"{folder}: is not of {path.name}, but a chunk would get its name; remove it")


def _tree(
    mean: Array,
    leaves: Sequence[NDArray[np.int64]],
    runs: Sequence[dict[str, Any]],
    errors: DoubleArray,
    boxes: Sequence[Box],
) -> dict[str, Any]:
    """Return the tree over the leaves, which are in its order."""
    waiting = iter(range(len(leaves)))

    def node(count: int) -> tuple[dict[str, Any], Box]:
        if count <= _LEAF:
            leaf = next(waiting)
            low, high = boxes[leaf]
            entry: dict[str, Any] = {"lods": runs[leaf], "errors": [_short(value) for value in errors[leaf]]}
        else:
            (first, box), (second, other) = node(count // 2), node(count - count // 2)
            low, high = np.minimum(box[0], other[0]), np.maximum(box[1], other[1])
            entry = {"children": [first, second]}
        bound = {"min": [_short(value) for value in low], "max": [_short(value) for value in high]}
        return {"bound": bound, **entry}, (low, high)

    return node(len(mean))[0]


def _write_level(
    path: Path, folder: Path, number: int, level: Level, splats: StoredSplats, runs: list[dict[str, Any]], files: int
) -> Iterator[str]:
    """Write the chunks of a level into a folder, add the runs of its leaves, and yield the paths of the chunks."""
    rows = np.lexsort((np.argsort(morton_order(level.mean)), level.group))
    counts = np.bincount(level.group, minlength=len(runs))
    ends = np.cumsum(counts)
    start = leaf = chunk = 0
    while leaf < len(runs):
        last = leaf
        while last + 1 < len(runs) and ends[last] - start < _CHUNK:
            last += 1
        for one in range(leaf, last + 1):
            if counts[one]:
                offset = int(ends[one] - counts[one] - start)
                runs[one][str(number)] = {"file": files + chunk, "offset": offset, "count": int(counts[one])}
        name = f"{number}_{chunk}"
        for file, data in sog_files(path, splats, rows[start : ends[last]]).items():
            with atomic_writer(folder / name / file) as stream:
                stream.write(data)
        yield f"{name}/{META}"
        start, leaf, chunk = int(ends[last]), last + 1, chunk + 1


def _short(value: float) -> float:
    """Return a number with the seven digits that the format asks for."""
    return float(f"{value:.7g}")


def _chunks(path: Path) -> set[str]:
    """Return the names of the folders beside lod-meta.json that are its chunks; none if there is no such file."""
    if not path.is_file():
        return set()
    try:
        names = json.loads(path.read_bytes())["filenames"]
        folders = {Path(name).parts[0] for name in names if len(Path(name).parts) == 2 and ".." not in name}
        return {name for name in folders if _is_chunk(path.parent / name)}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _is_chunk(folder: Path) -> bool:
    return (folder / META).is_file() and all(file.suffix in (".webp", ".json") for file in folder.iterdir())


def read_streamed_sog(path: Path) -> StoredSplats:
    """Read the finest splats of a scene: of each leaf the finest level, and the environment.

    Raises
    ------
    InputError : a file is missing or damaged, or has a newer version.
    """
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check name and rights") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is not JSON; export it again") from None
    if not isinstance(found, dict) or found.get("version", _VERSION) != _VERSION:
        raise InputError(f"{path}: has another version than {_VERSION} of streamed SOG; write it as .ply or .sog")
    names = found.get("filenames")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: has no list of file names; export it again")
    chunks: dict[int, StoredSplats] = {}
    parts = []
    for file, offset, count in _finest(path, found.get("tree")):
        if not 0 <= file < len(names):
            raise InputError(f"{path}: a leaf is in file {file}, there are {len(names)}; export it again")
        if file not in chunks:
            chunks[file] = _read_chunk(path, names[file])
        chunk = chunks[file]
        if not 0 <= offset <= offset + count <= len(chunk.arrays["mean"]):
            raise InputError(
                f"{path}: a leaf has splats {offset} to {offset + count} of {names[file][:80]!r}, which has "
                f"{len(chunk.arrays['mean'])}; export it again"
            )
        parts.append(_part(chunk, slice(offset, offset + count)))
    if isinstance(found.get("environment"), str):
        parts.append(_read_chunk(path, found["environment"]))
    if not parts:
        raise InputError(f"{path}: has no splats; choose a file of splats")
    return joined_parts(path, parts)


def _read_chunk(path: Path, name: str) -> StoredSplats:
    parts = Path(name).parts
    if len(parts) != 2 or parts[0] in ("..", "/") or parts[1] != META:
        raise InputError(f"{path}: file name {name[:80]!r} is not a folder with {META}; export it again")
    return read_sog(path.parent / name, with_unusable=True)  # the tree counts all splats


def _part(splats: StoredSplats, rows: slice) -> StoredSplats:
    return replace(splats, arrays={name: values[rows] for name, values in splats.arrays.items()})


def _finest(path: Path, tree: Any) -> Iterator[tuple[int, int, int]]:
    """Yield file, offset and count of the finest level of each leaf."""
    waiting = [(tree, 0)]
    while waiting:
        node, depth = waiting.pop()
        if not isinstance(node, dict) or depth > _MAX_DEPTH:
            raise InputError(f"{path}: its tree is damaged; export it again")
        children, levels = node.get("children"), node.get("lods")
        if isinstance(children, list):
            waiting += [(child, depth + 1) for child in reversed(children)]
        elif isinstance(levels, dict) and levels:
            entry = levels[min(levels, key=lambda key: (len(key), key))]
            values = [entry.get(name) if isinstance(entry, dict) else None for name in ("file", "offset", "count")]
            whole = [value for value in values if type(value) is int and 0 <= value < 1 << 32]
            if len(whole) < len(values):
                raise InputError(f"{path}: a leaf of its tree is damaged; export it again")
            yield whole[0], whole[1], whole[2]
