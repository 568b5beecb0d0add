"""Photos that a file of a photogrammetry program names, which is often moved to another place than its photos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from ...errors import InputError
from ...files.file_names import can_be_file
from ...files.image_names import IMAGE_SUFFIXES
from ..photo_listing import list_images
from ..photo_names import last_parts, place_photos
from ..posed_images import photo_folder
from ..reduced_photos import with_reduced_photos

_FOLDER = "images"


def find_named_photos(source: Path, names: Sequence[str], images: str | None) -> dict[str, tuple[str, Path]]:
    """Return a photo's name and its file for each name in a file.

    The photos are in the scene's folder `images` or in the scene's folder: the one that has more of them. A name may be
    a path on another computer, whose last parts are looked for, and may lack its suffix. The photo may be in a
    subfolder of `images`, if it is the only one of its name.

    Parameters
    ----------
    source : the file that has the names; the scene is its folder.
    names : names of photos, paths relative to the scene, or absolute paths.
    images : folder of the photos inside the scene, instead of the two.

    Returns
    -------
    (name, file) by the name in the file. The name is relative to the folder of the photos. A photo that is missing has
    a file that does not exist.

    Raises
    ------
    InputError : no file can have one of the names, two names are equal or stand for one photo, or the folder `images`
        is missing.
    """
    bad = next((name for name in names if not can_be_file(name)), None)
    if bad is not None:
        raise InputError(f"{source}: {ascii(bad)[:60]} is not the name of a photo; export the cameras again")
    if len(set(names)) < len(names):
        twice = Counter(names).most_common(1)[0][0]
        raise InputError(f"{source}: two cameras name the photo {twice!r}; remove one, and export the cameras again")
    scene = source.parent
    folders = [scene / _FOLDER, scene] if images is None else [photo_folder(scene, images)]
    found = [{name: _found(folder, name, images is None) for name in names} for folder in folders]
    found[0] |= _found_below(folders[0], [name for name, path in found[0].items() if path is None])
    best = max(range(len(folders)), key=lambda index: sum(each is not None for each in found[index].values()))
    stored = {name: path or PurePosixPath(_slashed(name)).name for name, path in found[best].items()}
    owners: dict[str, str] = {}
    for name, path in stored.items():
        if path in owners:
            raise InputError(
                f"{source}: {owners[path]!r} and {name!r} are both the photo {path!r} in {folders[best]}; keep the "
                "folders of the photos, or rename one"
            )
        owners[path] = name
    placed = place_photos(folders[best], list(owners))
    files = with_reduced_photos(folders[best], dict(placed.values()))
    return {name: (placed[path][0], files[placed[path][0]]) for name, path in stored.items()}


def _found_below(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the paths of photos that are in subfolders of a folder, by their names without folders."""
    below: dict[str, list[str]] = {}
    if names and folder.is_dir():
        for path in list_images(folder, IMAGE_SUFFIXES).names:
            below.setdefault(PurePosixPath(path).name, []).append(path)
    found = {}
    for name in names:
        bare = PurePosixPath(_slashed(name)).name
        paths = [path for suffix in _suffixes(bare) for path in below.get(bare + suffix, [])]
        if len(paths) == 1:  # of several photos of one name, nothing says which it is
            found[name] = paths[0]
    return found


def _found(folder: Path, name: str, anywhere: bool) -> str | None:
    """Return the path of a photo relative to a folder, or its absolute path; None if it is not there.

    Parameters
    ----------
    anywhere : whether the whole name counts, which can lead out of the folder.
    """
    tails = last_parts(name)
    for stem in [_slashed(name), *tails] if anywhere else tails:
        for suffix in _suffixes(stem):
            if (folder / (stem + suffix)).is_file():
                return stem + suffix
    return None


def _suffixes(name: str) -> list[str]:
    """Return the suffixes that a photo may have beyond its name: none, or all of them if the name lacks one."""
    if PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES:
        return [""]
    return [each for suffix in sorted(IMAGE_SUFFIXES) for each in (suffix, suffix.upper())]


def _slashed(name: str) -> str:
    return name.replace("\\", "/")
