"""Names of photos that a COLMAP model stores as absolute paths, or as paths that lead out of the folder of photos."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from ..errors import InputError
from ..files.file_names import can_be_file


def place_photos(folder: Path, stored: Sequence[str]) -> dict[str, tuple[str, Path]]:
    """Return a name and a file for each stored name.

    A name below the folder stays as it is. Other names become paths below the common folder of all such photos, because
    masks and renders have the names of their photos. A path that does not exist is looked for in the folder in other
    ways (`_file_of`): models are often copied from another computer.

    Parameters
    ----------
    folder : folder of the photos.
    stored : names in the model.

    Raises
    ------
    InputError : two photos get the same name, or a name that no file can have.
    """
    for name in stored:
        if not can_be_file(name):
            raise InputError(f"{folder}: {ascii(name)[:60]} in the model is not the name of a photo: is it damaged?")
    home = os.path.normpath(folder.absolute())
    files = {name: _file_of(folder, name) for name in stored}
    inside, outside = {}, {}
    for name, file in files.items():
        path = Path(os.path.normpath(file.absolute()))
        if path.is_relative_to(home):
            inside[name] = path.relative_to(home).as_posix()
        else:
            outside[name] = path
    if outside:
        try:
            common = Path(os.path.commonpath([path.parent for path in outside.values()]))
        except ValueError:  # several drives of Windows
            common = Path()
        inside |= {
            name: path.relative_to(common).as_posix() if common.parts else path.name for name, path in outside.items()
        }
    owners: dict[str, str] = {}
    for name, new in inside.items():
        if new in owners:
            raise InputError(f"{folder}: images {owners[new]!r} and {name!r} of the model are both called {new!r}")
        owners[new] = name
    return {name: (inside[name], files[name]) for name in stored}


def is_absolute(name: str) -> bool:
    """Return whether a stored name is an absolute path, of this or of another system."""
    return PurePosixPath(name).is_absolute() or PureWindowsPath(name).is_absolute()


def last_parts(name: str) -> list[str]:
    """Return what may remain of a path in another folder: all its folders and the name, and so on to the name alone."""
    # Parts of Windows' paths take both kinds of slashes. Those that end like this are drives and roots.
    parts = [part for part in PureWindowsPath(name).parts if not part.endswith(("/", "\\", ":"))]
    return ["/".join(parts[start:]) for start in range(len(parts)) if ".." not in parts[start:]]


def _file_of(folder: Path, name: str) -> Path:
    """Return the file of a stored name.

    A foreign absolute path is found by its last parts. A relative one may have Windows' slashes, and may begin with the
    name of the folder.
    """
    file = folder / name
    if file.is_file():
        return file
    if is_absolute(name):
        others = last_parts(name)
    else:
        slashed = name.replace("\\", "/")
        others = [slashed, slashed.removeprefix(f"{folder.name}/")]
    return next((folder / other for other in others if (folder / other).is_file()), file)
