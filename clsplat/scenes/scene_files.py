"""Files that describe the cameras of a scene in place of a COLMAP model: transforms files, OPF, Metashape, OpenSfM."""

from __future__ import annotations

import re
from pathlib import Path

from .transforms_files import find_transforms

OPF_ENDING, METASHAPE_ENDING = ".opf", ".xml"
PHOTOGRAMMETRY_ENDINGS = (OPF_ENDING, METASHAPE_ENDING)
SCENE_ENDINGS = (".json", *PHOTOGRAMMETRY_ENDINGS)
# Beside COLMAP, for messages.
OTHER_KINDS = "a transforms.json, an OPF project (.opf), Metashape's cameras (.xml) or OpenSfM's reconstruction.json"
_OPENSFM = re.compile(r"reconstruction(\.\w+)*\.json")  # OpenDroneMap adds words such as "topocentric"
_OPENSFM_PLACES = ("reconstruction.json", "opensfm/reconstruction.json")  # of a dataset, and of OpenDroneMap's project
_METASHAPE_NAME = "cameras.xml"  # the name that Metashape proposes
# Other programs leave XML files beside photos. The first bytes tell Metashape's from them.
_METASHAPE_START = re.compile(rb"<document\b[^>]*>\s*<chunk\b")
_START_BYTES = 4096


def find_scene_files(path: Path) -> list[Path]:
    """Return the files that describe a scene's cameras; an empty list without any.

    The kinds are looked for in a fixed order, and the first that is there counts: transforms files, an OPF project,
    cameras of Metashape, a reconstruction of OpenSfM.

    Parameters
    ----------
    path : the scene's folder, or one of its files.

    Returns
    -------
    One file, or the transforms files of training and test photos. Several files of another kind are no scene until one
    of them is named.
    """
    if path.is_file():
        return [path] if path.suffix.lower() in PHOTOGRAMMETRY_ENDINGS else find_transforms(path)
    return find_transforms(path) or _ending(path, OPF_ENDING) or _metashape_files(path) or _opensfm_files(path)


def described_by(scene: Path) -> list[Path]:
    """Return the files that a scene is read from in place of a COLMAP model.

    A folder `sparse` with files comes before them. An empty one is left by programs that found no poses.
    """
    if any(file.is_file() for file in (scene / "sparse").rglob("*")):
        return []
    return find_scene_files(scene)


def is_opensfm(file: Path) -> bool:
    """Return whether a file is a reconstruction of OpenSfM, by its name."""
    return _OPENSFM.fullmatch(file.name) is not None


def _opensfm_files(folder: Path) -> list[Path]:
    return [file for file in (folder / place for place in _OPENSFM_PLACES) if file.is_file()][:1]


def _metashape_files(folder: Path) -> list[Path]:
    files = [file for file in _ending(folder, METASHAPE_ENDING) if _is_metashape(file)]
    return [file for file in files if file.name == _METASHAPE_NAME] or files


def _ending(folder: Path, ending: str) -> list[Path]:
    try:
        return sorted(file for file in folder.iterdir() if file.suffix.lower() == ending and file.is_file())
    except OSError:  # no folder, or none that may be read
        return []


def _is_metashape(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return _METASHAPE_START.search(stream.read(_START_BYTES)) is not None
    except OSError:
        return False
