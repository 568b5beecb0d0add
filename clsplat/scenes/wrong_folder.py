"""Scenes above and below a folder that is not a scene itself, for messages to users who named the wrong folder."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..errors import InputError
from ..files.image_names import IMAGE_SUFFIXES
from ..files.real_path import real_path
from ..splats.formats.any_file import READ_ENDINGS
from .colmap import find_model, read_model
from .colmap_folder import FILES as COLMAP_FILES
from .colmap_folder import PHOTOS, model_suffix
from .described import read_described
from .photo_listing import is_posed
from .scene_files import OTHER_KINDS, described_by

_PHOTO_FOLDERS = (PHOTOS, "input")  # of scenes, and of 3DGS's convert.py
_LEVELS_UP = 3  # a model's files are two folders below the scene, and photos may be in a subfolder of `images`
_LEVELS_DOWN = 2
_MAX_FOLDERS = 2000  # largest number of folders to look into
_MAX_NAMED = 5
_TO_COLMAP = "export it as a COLMAP model"
_OTHER_PROGRAMS = {  # by name or ending: whose reconstructions these are, and what a user can do
    "sfm_data.json": f"OpenMVG; {_TO_COLMAP} (openMVG_main_openMVG2Colmap)",
    "poses_bounds.npy": "LLFF; give its COLMAP model, or find the poses again with clsplat reconstruct",
    "bundle.out": f"Bundler; {_TO_COLMAP}",
    "*.sfm": f"AliceVision; {_TO_COLMAP}",
    "*.nvm": f"VisualSFM; {_TO_COLMAP}",
}
_MODEL_SUFFIXES = (*READ_ENDINGS, ".ksplat")


def scene_hint(path: Path) -> str | None:
    """Return a message that names the scene that a folder belongs to, or the scenes in it; None without a scene."""
    if (above := scene_above(path)) is not None:
        return f"{path}: is a part of the scene {above}: give that folder"
    below = scenes_below(path)
    return f"{path}: {describe_scenes(path, below)}" if below else None


def describe_scenes(path: Path, scenes: Sequence[str]) -> str:
    """Return a text that asks for one of the scenes below a folder."""
    some = ", ".join(scenes[:_MAX_NAMED]) + (", ..." if len(scenes) > _MAX_NAMED else "")
    if len(scenes) == 1:
        return f"the subfolder {some} is a scene: give {path / scenes[0]}{_photos_above(path, scenes[0])}"
    return f"the subfolders {some} are scenes: give one of them, such as {path / scenes[0]}"


def _photos_above(path: Path, scene: str) -> str:
    """Return words on the photos of a COLMAP model in a subfolder, if they lie beside that folder."""
    sub, photos = path / scene, _photo_folders(path)
    if described_by(sub) or (sub / PHOTOS).is_dir() or not photos:
        return ""
    up = "/".join([".."] * len(Path(scene).parts))
    return f", and its folder of photos: {up}/{photos[0]}"


def model_below(path: Path) -> str | None:
    """Return a message on a COLMAP model in a subfolder of a folder of photos; None without one."""
    for folder, posed in _folders_below(path):
        alone = posed and not described_by(folder) and not (folder / PHOTOS).is_dir()
        if model_suffix(folder) or alone:
            place = folder.relative_to(path)
            photos = "/".join([".."] * len(place.parts) + _photo_folders(path)[:1])
            return (
                f"{path}: has a COLMAP model in {place.as_posix()}: give {folder}, and its folder of photos: {photos}"
            )
    return None


def _photo_folders(path: Path) -> list[str]:
    """Return the names of a folder's folders of photos."""
    return [name for name in _PHOTO_FOLDERS if (path / name).is_dir()]


def other_poses(path: Path) -> str | None:
    """Return a message on the reconstruction of another program in a folder of photos; None without one."""
    for folder in (path, *(folder for folder, _ in _folders_below(path))):
        for file in sorted(folder.glob("*.*")):
            if of_other_program(file):
                return f"{file}: {describe_file(file)}"
    return None


def of_other_program(file: Path) -> bool:
    """Return whether a file is the reconstruction of a program whose files are not read, by its name."""
    return _program_of(file) is not None


def _program_of(file: Path) -> str | None:
    return _OTHER_PROGRAMS.get(file.name.lower()) or _OTHER_PROGRAMS.get(f"*{file.suffix.lower()}")


def describe_file(file: Path) -> str:
    """Return what a user should give instead of a file that is not a scene."""
    kind = file.suffix.lower()
    if file.stem in COLMAP_FILES and kind in (".bin", ".txt"):
        return "is a file of a COLMAP model; give the folder of the scene"
    if program := _program_of(file):
        return f"is a reconstruction of {program}"
    if kind in IMAGE_SUFFIXES:
        return "is one photo; give the folder of the photos"
    if kind in _MODEL_SUFFIXES:
        return f"is a model or a point cloud, not a scene; give the scene's folder, or {OTHER_KINDS}"
    if kind == ".csv":
        return "is a table, which says too little about lenses; export the cameras of RealityScan as a COLMAP model"
    return f"is not a scene; give a folder with photos, a video, {OTHER_KINDS}"


def scene_above(path: Path) -> Path | None:
    """Return the scene that a folder of photos or a folder of a COLMAP model belongs to; None without one."""
    place = real_path(path)
    for parent in place.parents[:_LEVELS_UP]:
        if is_posed(parent):
            first = place.relative_to(parent).parts[0]
            related = first == "sparse" or _has_photos_of(parent, parent / first, place)
            as_named = next((up for up in path.parents if real_path(up) == parent), parent)
            return as_named if related else None
    return None


def scenes_below(path: Path) -> list[str]:
    """Return the scenes in the subfolders of a folder, as paths relative to it."""
    return [folder.relative_to(path).as_posix() for folder, posed in _folders_below(path) if posed]


def _folders_below(path: Path) -> Iterator[tuple[Path, bool]]:
    """Yield the folders below a folder, and whether each has poses: some levels down, but none inside a scene."""
    looked = 0
    for folder, folders, _ in os.walk(path):
        kept = []
        for name in sorted(folders):
            looked += 1
            if name.startswith(".") or looked > _MAX_FOLDERS:
                continue
            try:
                posed = is_posed(Path(folder) / name)
            except PermissionError:  # a user does not mean a folder that is closed to them
                continue
            yield Path(folder) / name, posed
            if not posed:
                kept.append(name)
        folders[:] = kept if len(Path(folder).relative_to(path).parts) + 1 < _LEVELS_DOWN else []


def _has_photos_of(scene: Path, photos: Path, place: Path) -> bool:
    """Return whether a scene's photos are below `place`, if the scene's folder of photos is `photos`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if described := described_by(scene):
                files = list(read_described(described).files.values())
            else:
                files = [photos / photo.name for photo in read_model(find_model(scene)).photos]
    except InputError:
        return False
    return any(file.is_file() and real_path(file).is_relative_to(place) for file in files)
