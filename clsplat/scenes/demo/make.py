"""A folder with the demo scene, made once."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from ...errors import OutputError
from ...files.atomic import move
from .scene import write_capture


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
    folder = Path(folder)
    if folder.exists():
        return folder
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        if unfinished.exists():  # left by an interrupted run
            shutil.rmtree(unfinished)
        write_capture(unfinished, width, width * 3 // 4, n_views)
        move(unfinished, folder)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: cannot be written ({reason}): choose another folder") from None
    return folder
