"""The test views of a scene: those that its files name, those of a list, or every n-th one."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

from ..errors import InputError
from ..files.whole_file import read_whole
from .options import TEST_EVERY
from .posed_images import PosedImages


def select_test_names(posed: PosedImages, test_every: int, test_list: str | os.PathLike[str] | None) -> frozenset[str]:
    """Return the names of the test views; parameters as `load_scene`, raises InputError."""
    names = posed.listed
    if test_list is None and posed.test_names is not None:
        chosen = sorted(posed.test_names)
        if test_every != TEST_EVERY:
            warnings.warn(
                f"test_every {test_every} has no effect: the scene's files name its test views; a test_list replaces "
                "them",
                stacklevel=3,
            )
    elif test_list is None:
        if test_every < 2:
            raise InputError(f"test_every {test_every}: must be at least 2; to train on all views, turn eval off")
        chosen = names[::test_every]
    else:
        chosen = _read_names(Path(test_list))
        unknown = [name for name in chosen if name not in set(names)]
        if unknown:
            raise InputError(
                f"{test_list}: no view is named {unknown[0]!r} ({len(unknown)} unknown in all); "
                f"names look like {names[0]!r}"
            )
    if len(set(chosen)) == len(names):
        folder = next((file.parent for file in posed.files.values()), "the scene")
        raise InputError(
            f"{folder}: no training view is left: all {len(names)} views are test views; choose fewer, or turn eval off"
        )
    return frozenset(chosen)


def _read_names(path: Path) -> list[str]:
    try:
        lines = read_whole(path).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise InputError(
            f"{path}: cannot be read as a list of names ({reason}); give a text file with one image name per line"
        ) from None
    return [line.strip() for line in lines if line.strip()]
