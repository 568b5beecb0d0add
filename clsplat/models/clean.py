"""Cleaning of a trained model, with the photos of its scene or without."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from .. import activity
from ..cleaning.clean import Cleaned, clean, clean_without_views
from ..errors import InputError, OutputError, Remedy
from ..evaluation.evaluate import Evaluation, evaluate
from ..files.atomic import move
from ..files.existing import refuse_existing
from ..files.lock import folder_lock
from ..files.real_path import real_path
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene
from ..splats.color import Color
from ..splats.formats.any_file import check_ending, check_shape
from ..splats.formats.page_payload import PAGE_ENDING
from ..splats.splats import Splats
from ..training.exposure_file import copy_exposures
from ..training.folder import ModelFolder
from .convert import ConvertedModel
from .model import LoadedModel, SceneChoice, model_at

TOLERANCE = 0.05  # dB
MIN_VIEWS = 3


@dataclass(frozen=True)
class CleanedModel:
    """The result of `clean_model`.

    Attributes
    ----------
    source : the model before. output : the file or folder that was written; None if nothing was written.
    cleaned : the splats that are left, what each rule removed, and the metrics of the training views.
    test_before, test_after : metrics of the test views, which decide nothing; None without test views.
    """

    source: LoadedModel
    output: Path | None
    cleaned: Cleaned
    test_before: Evaluation | None = None
    test_after: Evaluation | None = None

    @property
    def written(self) -> ConvertedModel | None:
        """What the file holds of the cleaned splats; None if nothing or a folder was written, which holds all."""
        if self.output is None or not self.output.suffix:
            return None
        splats = self.cleaned.splats
        return ConvertedModel(replace(self.source, splats=splats), self.output, splats, False)


def clean_model(
    model: str | os.PathLike[str] | LoadedModel,
    output: str | os.PathLike[str] | None = None,
    *,
    tolerance: float = TOLERANCE,
    min_views: int = MIN_VIEWS,
    scene: SceneChoice | None = None,
    use_photos: bool | None = None,
    background: Color | None = None,
    iteration: int | None = None,
    overwrite: bool = False,
    device: str | None = None,
) -> CleanedModel:
    """Remove floaters, oversized splats and splats that no training view sees, and return what was removed.

    Photos judge every removal but that of splats which no view sees. Test views are measured and never decide.

    Parameters
    ----------
    model : a model folder or a file of splats, or what `load_model` returned.
    output : a .ply, .splat or .spz file, or the folder of a new model, with the record of the run of the old one. None
        writes nothing.
    tolerance : largest loss of PSNR on the training views [dB].
    min_views : splats that fewer training views see are candidates.
    scene : replaces parts of the scene's record. A file needs the scene's path to be judged by photos.
    use_photos : whether photos judge. None means that they do if the scene is recorded, or if `scene` has a path.
    background : colour 0..1; None means the model's background.
    iteration : as for `load_model`.
    overwrite : replace an existing file or model.
    device : OpenCL device, as for `Renderer`.

    Raises
    ------
    InputError : the model is empty, or it or the scene cannot be read; or an option has a bad value.
    OutputError : the output exists, is the model itself, or cannot be written.
    """
    target = None if output is None else Path(output)
    loaded = model_at(model, iteration)
    if not len(loaded.splats):
        raise InputError(f"{loaded.path}: has no splats")
    if target is not None:
        _check_output(target, loaded, overwrite)
    choice = scene or SceneChoice()
    if use_photos is None:
        use_photos = (choice.path or loaded.scene_record.get("path")) is not None
    if not use_photos:
        result = CleanedModel(loaded, target, clean_without_views(loaded.splats))
    else:
        colour = loaded.background if background is None else background
        photos = loaded.load_scene(choice, background=colour)
        result = _judged(loaded, target, photos, colour, tolerance, min_views, Renderer(device))
    if target is not None:
        _write(result.cleaned.splats, loaded, target)
    return result


def _judged(
    loaded: LoadedModel,
    target: Path | None,
    scene: Scene,
    background: Color,
    tolerance: float,
    min_views: int,
    renderer: Renderer,
) -> CleanedModel:
    """Return the model that the photos of the scene allow, with the metrics of its views."""
    cleaned = clean(loaded.splats, scene.train, scene.extent, renderer, background, tolerance, min_views)
    if not scene.test:
        return CleanedModel(loaded, target, cleaned)
    activity.report(f"measuring {len(scene.test)} test views")
    before, after = (evaluate(renderer, one, scene.test, background) for one in (loaded.splats, cleaned.splats))
    return CleanedModel(loaded, target, cleaned, before, after)


def _check_output(output: Path, model: LoadedModel, overwrite: bool) -> None:
    """Raise OutputError if the output cannot be written for this model, before any work is done for it."""
    if output.suffix:
        if output.is_dir():
            raise OutputError(f"{output}: is a folder: name a file, or a folder without a dot in its name")
        check_shape(output, check_ending(output, PAGE_ENDING), model.splats.shape)
        refuse_existing([output], overwrite)
        return
    if model.folder is None or not model.folder.config_path.is_file():
        raise OutputError(
            f"{output}: {model.path} has no config.json to copy: name a file instead, such as {output}.ply"
        )
    if real_path(output) == real_path(model.folder.path):
        raise OutputError(f"{output}: is the model itself: name another folder")
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output}: is not a folder: choose another name")
    if ModelFolder(output).is_used and not overwrite:
        replaces = Remedy("replace it", "--overwrite")
        raise OutputError(f"{output}: already holds a model", Remedy("choose another folder"), replaces)


def _write(splats: Splats, model: LoadedModel, output: Path) -> None:
    """Write the splats to a file, or to a folder with the options, scene and cameras of the model's run."""
    if output.suffix:
        splats.save(output)
        return
    is_new = not output.exists()
    ModelFolder(output).prepare()
    with folder_lock(output):
        _replace_model(splats, model, output, is_new)


def _replace_model(splats: Splats, model: LoadedModel, output: Path, is_new: bool) -> None:
    """Write the model's folder, or raise OutputError and leave the old model in it. A new folder goes then."""
    assert model.folder is not None
    assert model.iteration is not None
    try:
        # The new model is complete before the old one goes. It lies in the folder, so that its files only change place.
        with tempfile.TemporaryDirectory(prefix=".", dir=output) as temporary:
            _write_folder(splats, model, model.folder, model.iteration, ModelFolder(temporary))
            ModelFolder(output).clear()
            for file in [path for path in Path(temporary).rglob("*") if path.is_file()]:
                target = output / file.relative_to(temporary)
                target.parent.mkdir(parents=True, exist_ok=True)
                move(file, target)
    except (OutputError, OSError) as error:
        if is_new:
            shutil.rmtree(output, ignore_errors=True)
        cause = error.__cause__ if isinstance(error, OutputError) else error
        reason = getattr(cause, "strerror", None) or cause or error
        raise OutputError(f"{output}: cannot be written ({reason}); free some space, or choose another place") from None


def _write_folder(splats: Splats, model: LoadedModel, source: ModelFolder, iteration: int, folder: ModelFolder) -> None:
    """Write the splats into a folder, with what the folder of the model has for later commands."""
    stored = source.read_config()
    if "path" in model.scene_record:  # the record may be relative to the old folder
        stored["scene"] = {**stored["scene"], "path": real_path(model.scene_record["path"]).as_posix()}
    folder.write_config(stored)
    if cameras := model.read_cameras():
        folder.write_cameras(cameras)
    copy_exposures(source, folder.exposures_path)
    folder.save(splats, iteration)
