"""Scenes above and below a folder that is not a scene itself, for messages to users who named the wrong folder."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from ..files.image_names import IMAGE_SUFFIXES
from ..files.real_path import real_path
from ..splats.formats.any_file import READ_ENDINGS
from .colmap import find_model, read_model
from .colmap_folder import PHOTOS
from .described import read_described
from .photo_listing import is_posed
from .scene_files import OTHER_KINDS, described_by

_LEVELS_UP = 3  # a model's files are two folders below the scene, and photos may be in a subfolder of `images`
_LEVELS_DOWN = 2
_MAX_FOLDERS = 2000  # largest number of folders to look into
_MAX_NAMED = 5
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
    """Return words on the photos of a COLMAP model in a subfolder, if they lie beside that folder: its `images`."""
    sub = path / scene
    if described_by(sub) or (sub / PHOTOS).is_dir() or not (path / PHOTOS).is_dir():
        return ""
    up = "/".join([".."] * len(Path(scene).parts))
    return f", and its folder of photos: {up}/{PHOTOS}"


def describe_file(file: Path) -> str:
    """Return what a user should give instead of a file that is not a scene."""
    kind = file.suffix.lower()
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
    found: list[str] = []
    looked = 0
    for folder, folders, _ in os.walk(path):
        below = Path(folder).relative_to(path)
        kept = []
        for name in sorted(folders):
            looked += 1
            if name.startswith(".") or looked > _MAX_FOLDERS:
                continue
            if is_posed(Path(folder) / name):
                found.append((below / name).as_posix())
            else:
                kept.append(name)
        folders[:] = kept if len(below.parts) + 1 < _LEVELS_DOWN else []
    return found


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
