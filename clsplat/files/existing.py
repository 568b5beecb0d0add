"""The rule on files that exist: what a user names is replaced only if the user says so.

Files that clsplat names itself, in a folder that it made, are written again without a question.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from ..errors import OutputError
from .file_names import name_key
from .real_path import real_path


def refuse_existing(paths: Iterable[str | Path], overwrite: bool = False, inputs: Iterable[str | Path] = ()) -> None:
    """Raise OutputError for the first path that exists and may not be replaced, that comes twice, or whose place takes
    no files. So the work for a file begins only if it can be written.

    Parameters
    ----------
    paths : files that will be written.
    overwrite : whether files may be replaced. Folders and devices such as /dev/null never are.
    inputs : files that are read, such as the photos of the scene. They are never replaced either.
    """
    kept, written, places = {name_key(real_path(path)) for path in inputs}, set(), set()
    for path in map(Path, paths):
        place = name_key(real_path(path))
        if place in kept:
            raise OutputError(f"{path}: is a photo of the scene: choose another place")
        if place in written:
            raise OutputError(f"{path}: is named for two files: choose another name for one")
        written.add(place)
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is not a file: choose another name")
        if os.path.lexists(path) and not overwrite:  # also a symbolic link to a file that is not there
            raise OutputError(f"{path}: exists already: use --overwrite or another name")
        if path.parent not in places:
            _check_place(path)
            places.add(path.parent)


def probe(folder: Path) -> None:
    """Raise OSError if a folder takes no files."""
    with tempfile.TemporaryFile(dir=folder):
        pass


def _check_place(path: Path) -> None:
    """Raise OutputError if the folder of a path, or the first one above it that exists, takes no files."""
    folder = next((parent for parent in path.absolute().parents if parent.exists()), None)
    if folder is None or not folder.is_dir():
        return  # writing says what is in the way
    try:
        probe(folder)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from None
