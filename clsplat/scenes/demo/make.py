"""Folders with the demo scenes, made once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from ...errors import OutputError
from ...files.atomic import move
from .scene import write_capture
from .street_scene import POINTS_OF_VIEW, write_street


def make_demo_scene(folder: str | os.PathLike[str], width: int = 200, n_views: int = 40) -> Path:
    """Render the demo scene into a folder, completely or not at all. An existing folder is kept.

    Parameters
    ----------
    folder : the scene's folder.
    width : width of a photo [px]; the height is three quarters of it.
    n_views : number of photos.

    Returns
    -------
    The folder, for `load_scene`.

    Raises
    ------
    OutputError : the folder cannot be written.
    """
    return _made_once(folder, lambda new: write_capture(new, width, width * 3 // 4, n_views))


def make_large_demo_scene(folder: str | os.PathLike[str], width: int = 320, n_views: int = 600) -> Path:
    """Render a street of houses into a folder, as `make_demo_scene` does. It has 2 million points in 600 photos.

    Parameters
    ----------
    width : as of `make_demo_scene`.
    n_views : number of photos, at least 12. The number of points is proportional to it.

    Raises
    ------
    InputError : there are too few photos. OutputError : the folder cannot be written.
    """
    return _made_once(
        folder, lambda new: write_street(new, width, width * 3 // 4, n_views, round(POINTS_OF_VIEW * n_views))
    )


def _made_once(folder: str | os.PathLike[str], write: Callable[[Path], object]) -> Path:
    folder = Path(folder)
    if folder.exists():
        return folder
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        if unfinished.exists():  # left by an interrupted run
            shutil.rmtree(unfinished)
        write(unfinished)
        move(unfinished, folder)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: cannot be written ({reason}): choose another folder") from None
    return folder
