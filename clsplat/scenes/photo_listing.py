"""Image files below a folder, without those that clsplat wrote there and without those of other scenes."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from ..errors import InputError
from ..files.image_names import bare_name
from ..files.images import is_render
from ..files.json_file import read_json
from ..files.masks import BESIDE, MASK_FOLDER
from .colmap_folder import colmap_folder, models_in
from .reconstruct.options import RECORD
from .scene_files import find_scene_files

_MAX_FOLDERS = 2000  # largest number of folders to look into for a first photo


@dataclass(frozen=True)
class Listing:
    """Image files below a folder.

    Parameters
    ----------
    names : files as paths relative to the folder, with `/` between folders, sorted.
    outputs : folders that clsplat wrote, and the number of renders in other folders, as texts; left out.
    scenes : other folders with poses; left out.
    """

    names: tuple[str, ...]
    outputs: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()

    @property
    def in_subfolders(self) -> bool:
        """Whether every file is in a subfolder."""
        return all("/" in name for name in self.names)


def list_images(home: Path, suffixes: Collection[str]) -> Listing:
    """Return the files below a folder that have one of the suffixes. Hidden files and folders and masks are ignored.
    Masks are in the folder `masks`, or beside their photos (`masks_beside`).

    Scenes, models and comparisons that clsplat wrote are left out, and so are other scenes. They are known by their
    contents, not by their names. Renders are left out beside photos; a folder with nothing else is taken as it is.
    A warning counts the folders that this user may not read.
    """
    outputs: list[str] = []
    scenes: list[str] = []
    closed: list[OSError] = []
    names = [name for some in _names_by_folder(home, suffixes, outputs, scenes, closed) for name in some]
    _warn_of_closed(home, closed)
    known = {part for name in names for part in (name, bare_name(name))}
    names = [name for name in names if not (name.lower().endswith(BESIDE) and name[: -len(BESIDE)] in known)]
    photos = [name for name in names if not (name.lower().endswith(".png") and is_render(home / name))]
    renders = len(names) - len(photos)
    if photos and renders:
        outputs.append(f"{renders} render{'s' if renders > 1 else ''}")
        names = photos
    return Listing(tuple(sorted(names)), tuple(outputs), tuple(scenes))


def has_images(home: Path, suffixes: Collection[str]) -> bool:
    """Return whether `list_images` finds a file. The first one ends the search, and so do 2000 folders without any.

    A disk has many more folders than that. Whoever names all of it does not mean its photos.
    """
    closed: list[OSError] = []
    folders = _names_by_folder(home, suffixes, [], [], closed)
    if any(islice(folders, _MAX_FOLDERS)):
        return True
    _warn_of_closed(home, closed)
    return False


def _names_by_folder(
    home: Path, suffixes: Collection[str], outputs: list[str], scenes: list[str], closed: list[OSError]
) -> Iterator[list[str]]:
    """Yield the names of the files in each folder that is not left out, also masks and renders.

    Parameters
    ----------
    outputs, scenes : get the folders that are left out, as of `Listing`. closed : gets what cannot be read.
    """
    for folder, folders, files in os.walk(home, onerror=closed.append):
        below = Path(folder).relative_to(home)
        yield [
            (below / name).as_posix()
            for name in files
            if not name.startswith(".") and Path(name).suffix.lower() in suffixes
        ]
        kept = []
        for name in sorted(folders):
            path, shown = Path(folder) / name, (below / name).as_posix()
            if name.startswith(".") or (below == Path() and name == MASK_FOLDER):
                continue
            try:
                if is_output(path):
                    outputs.append(shown)
                elif is_posed(path):
                    scenes.append(shown)
                else:
                    kept.append(name)
            except PermissionError as error:
                closed.append(PermissionError(error.errno, error.strerror, str(path)))
        folders[:] = kept


def _warn_of_closed(home: Path, errors: Collection[OSError]) -> None:
    """Warn of folders that this user may not read. Others, such as those of a process that has ended, are gone."""
    closed = [str(error.filename) for error in errors if isinstance(error, PermissionError)]
    if closed:
        one = len(closed) == 1
        warnings.warn(
            f"{home}: {len(closed)} folder{'' if one else 's'} cannot be read and {'is' if one else 'are'} left out, "
            f"such as {closed[0]}: check the permissions if photos are there",
            stacklevel=3,
        )


def is_output(folder: Path) -> bool:
    """Return whether a folder is a scene of `reconstruct`, a model, or a comparison."""
    return _is_made_scene(folder) or _is_model(folder) or _are_files(folder, "runs.jsonl", "results.json")


def is_posed(folder: Path) -> bool:
    """Return whether a folder holds poses: a COLMAP model, or files that describe cameras."""
    if find_scene_files(folder):
        return True
    found = colmap_folder(folder)
    return found is not None and bool(models_in(found))


def _is_made_scene(folder: Path) -> bool:
    return (folder / RECORD).is_file() and (folder / "sparse").is_dir()


def _is_model(folder: Path) -> bool:
    """Return whether a folder is a model or a search of clsplat, or a model of 3DGS."""
    if (folder / "point_cloud").is_dir() and (folder / "cameras.json").is_file():
        return True
    for file in (folder / "config.json", folder / "budget.json"):
        try:
            values = read_json(file, "") if file.is_file() else None
        except InputError:
            continue
        if isinstance(values, dict) and all(isinstance(values.get(key), dict) for key in ("config", "scene")):
            return True
    return False


def _are_files(folder: Path, *names: str) -> bool:
    return all((folder / name).is_file() for name in names)
