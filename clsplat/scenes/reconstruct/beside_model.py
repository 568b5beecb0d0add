"""The scene that `clsplat train` makes from photographs without poses, beside the model's folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...errors import OutputError
from .options import ReconstructOptions
from .photo_files import find_photos, is_video
from .reconstruct import estimate_seconds, is_made_from


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
    photos: Path, model: Path, options: ReconstructOptions | None = None, overwrite: bool = False
) -> PlannedScene:
    """Choose the scene of photographs or a video: `NAME-scene` beside the model's folder.

    Parameters
    ----------
    overwrite : replace a scene that was made from other photos.

    Raises
    ------
    InputError : there are no photos.
    OutputError : the scene was made from other photos.
    """
    options = options or ReconstructOptions()
    scene = model.parent / f"{photos.resolve().stem if is_video(photos) else photos.resolve().name}-scene"
    made = is_made_from(scene, photos)
    if made:
        return PlannedScene(scene, True)
    if made is False and not overwrite:
        raise OutputError(
            f"{scene}: was reconstructed from other photos than {photos} now has: use --overwrite to replace "
            f"it, or clsplat reconstruct {photos} -o OTHER and train on that"
        )
    if is_video(photos):
        return PlannedScene(scene, False, options.frames)
    files = find_photos(photos)
    return PlannedScene(scene, False, len(files), estimate_seconds(files, options))
