"""Levels of detail of a model: measure them, and write each as a file."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..cameras.make_path import PathRequest
from ..errors import InputError, OutputError
from ..files.existing import refuse_existing
from ..rendering.renderer import Renderer
from .detail import LEVELS, DetailLevels
from .measure_detail import DistanceMeasure, LevelMeasure, measure_distances, measure_levels
from .model import LoadedModel, model_at
from .render import ViewChoice, choose_views

VIEWS = 4  # cameras that are measured, at most


@dataclass(frozen=True)
class ModelLevels:
    """The levels of a model.

    Attributes
    ----------
    model : what was loaded.
    levels : its levels.
    files : the files of the levels after the first one, if they were asked for.
    """

    model: LoadedModel
    levels: DetailLevels
    files: tuple[Path, ...]

    def measure(
        self, pixels: float, device: str | None = None
    ) -> tuple[Iterator[LevelMeasure], Iterator[DistanceMeasure]]:
        """Return the measures of the levels, and those of images from farther away, as they are made.

        At most four of the model's cameras are used, its test views if there are any. A model without cameras is seen
        from around.

        Parameters
        ----------
        pixels : as of `DetailLevels.choose`. device : OpenCL device, as for `Renderer`.
        """
        around = None if self.model.read_cameras() else PathRequest("orbit", frames=VIEWS)
        views, _ = choose_views(self.model, ViewChoice(path=around))
        cameras = [view.camera for view in views[:: -(-len(views) // VIEWS)]]
        renderer, background = Renderer(device), self.model.background
        return (
            measure_levels(self.levels, cameras, renderer, background),
            measure_distances(self.levels, pixels, cameras, renderer, background),
        )


def model_levels(
    model: str | os.PathLike[str] | LoadedModel,
    levels: int = LEVELS,
    *,
    output: str | os.PathLike[str] | None = None,
    iteration: int | None = None,
    overwrite: bool = False,
) -> ModelLevels:
    """Merge the splats of a model in levels of detail.

    Parameters
    ----------
    model : a model folder or a file of splats, or what `load_model` returned.
    levels : their number, as for `DetailLevels`.
    output : folder for the levels after the first one: level_1.ply and so on; None writes nothing.
    iteration : as for `load_model`. overwrite : replace existing files.

    Raises
    ------
    InputError : the model does not exist, or the number of levels is out of range.
    OutputError : a file exists or cannot be written.
    """
    loaded = model_at(model, iteration)
    if not len(loaded.splats):
        raise InputError(f"{loaded.ply}: has no splats to merge: choose another model")
    folder = None if output is None else Path(output)
    listed = [] if folder is None else folder.glob("level_*.ply")
    existing = {number: file for file in listed if (number := _number(file))}
    for file in existing.values():
        if file.exists() and file.samefile(loaded.ply):
            raise OutputError(f"{file}: is the model itself: choose another folder")
    refuse_existing(existing.values(), overwrite)
    found = DetailLevels(loaded.splats, levels)
    if folder is None:
        return ModelLevels(loaded, found, ())
    files = [folder / f"level_{number}.ply" for number in range(1, len(found))]
    for number, file in enumerate(files, 1):
        found.whole(number).save(file)
    for number, file in existing.items():
        if number >= len(found):  # of more levels than there are now
            file.unlink()
    return ModelLevels(loaded, found, tuple(files))


def _number(file: Path) -> int:
    """Return the number in the name of a level's file; 0 for another file."""
    found = re.fullmatch(r"level_([1-9]\d*)\.ply", file.name)
    return int(found[1]) if found else 0
