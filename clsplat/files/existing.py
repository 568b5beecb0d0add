"""The rule on files that exist: what a user names is replaced only if the user says so.

Files that clsplat names itself, in a folder that it made, are written again without a question.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..errors import OutputError
from .file_names import name_key
from .real_path import real_path


def refuse_existing(paths: Iterable[str | Path], overwrite: bool = False, inputs: Iterable[str | Path] = ()) -> None:
    """Raise OutputError for the first path that exists and may not be replaced, or that comes twice.

    Parameters
    ----------
    paths : files that will be written.
    overwrite : whether files may be replaced. Folders and devices such as /dev/null never are.
    inputs : files that are read, such as the photos of the scene. They are never replaced either.
    """
    kept, written = {name_key(real_path(path)) for path in inputs}, set()
    for path in map(Path, paths):
        place = name_key(real_path(path))
        if place in kept:
            raise OutputError(f"{path}: is a photo of the scene: choose another place")
        if place in written:
            raise OutputError(f"{path}: is named for two files: choose another name for one")
        written.add(place)
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is not a file: choose another name")
        if path.exists() and not overwrite:
            raise OutputError(f"{path}: exists already: use --overwrite or another name")
