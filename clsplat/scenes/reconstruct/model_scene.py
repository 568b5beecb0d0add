"""The scene that `clsplat train` makes from photographs without poses. It is a part of the model's folder."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError, OutputError
from ..wrong_folder import model_below, other_poses, scene_above
from .options import RECORD, ReconstructOptions
from .photo_files import find_photos, is_video
from .reconstruct import estimate_seconds, is_made_from

FOLDER = "scene"  # the scene's folder inside the model's folder


@dataclass(frozen=True)
class PlannedScene:
    """A scene to use or to make.

    Attributes
    ----------
    path : the scene's folder. exists : whether it was made from these photos before.
    photos : number of photos, or of frames of a video. seconds : estimated time to make it; None for a video.
    """

    path: Path
    exists: bool
    photos: int = 0
    seconds: float | None = None


def plan_scene(
    photos: Path,
    model: Path,
    options: ReconstructOptions | None = None,
    overwrite: bool = False,
    recorded: Path | None = None,
) -> PlannedScene:
    """Choose the scene of photographs or a video: `scene` in the model's folder.

    Each model has its own scene, so that the photos of one model never replace those of another.

    Parameters
    ----------
    overwrite : replace a scene that was made from other photos.
    recorded : the scene of a run that is resumed; it replaces `scene`.

    Raises
    ------
    InputError : there are no photos, their poses are in the folder above or below, or a resumed run had other photos.
    OutputError : the scene was made from other photos.
    """
    options = options or ReconstructOptions()
    if (posed := scene_above(photos)) is not None:
        raise InputError(
            f"{photos}: the poses of these photos are in {posed}: give that folder, or find new poses with clsplat "
            f"reconstruct {photos} -o SCENE"
        )
    scene = recorded or model / FOLDER
    made = is_made_from(scene, photos)
    if recorded is not None and made is None and not (recorded / RECORD).is_file():
        raise InputError(f"{model}: was trained on {scene}, not on photographs: resume without {photos}")
    if made or (recorded is not None and made is None):  # older scenes do not record their photos
        return PlannedScene(scene, True)
    if recorded is not None:
        raise InputError(f"{scene}: was reconstructed from other photos than {photos} now has: resume without {photos}")
    if made is False and not overwrite:
        raise OutputError(
            f"{scene}: was reconstructed from other photos than {photos} now has: use --overwrite to replace "
            f"it and the model, or another folder for the model"
        )
    if is_video(photos):
        return PlannedScene(scene, False, options.frames)
    if (message := model_below(photos)) is not None:
        raise InputError(f"{message}, or find new poses with clsplat reconstruct {photos} -o SCENE")
    if (message := other_poses(photos)) is not None:
        warnings.warn(message, stacklevel=2)
    files = find_photos(photos)
    return PlannedScene(scene, False, len(files), estimate_seconds(files, options))
