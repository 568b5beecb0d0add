"""Pruning of a trained model on the scene that it shows."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from ..compression.prune import SHARES, Pruned, Validation, check_tolerance, prune
from ..compression.prune_and_refine import prune_in_rounds
from ..device.device import open_device
from ..errors import InputError, OutputError
from ..files.existing import refuse_existing
from ..files.json_file import describe_any, is_whole
from ..rendering.renderer import Renderer
from ..scenes.split import hold_out
from ..splats.formats.any_file import PLY_ENDING, stored_bytes
from ..training.log import Progress
from .model import LoadedModel, SceneChoice, model_at

TOLERANCE = 0.1  # dB


@dataclass(frozen=True)
class PrunedModel:
    """The result of `prune_model`.

    Attributes
    ----------
    source : the model before. output : the file that was written.
    pruned : the smaller model, and its loss of quality.
    source_bytes : size of the model before, which may have been the same file.
    """

    source: LoadedModel
    output: Path
    pruned: Pruned
    source_bytes: int


def prune_model(
    model: str | os.PathLike[str] | LoadedModel,
    output: str | os.PathLike[str],
    *,
    tolerance: float = TOLERANCE,
    iterations: int = 0,
    compact: bool = True,
    scene: SceneChoice | None = None,
    iteration: int | None = None,
    overwrite: bool = False,
    device: str | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> PrunedModel:
    """Write a model without the splats, fields and SH bands that its images do not need, and return it.

    Some of the training views are held out to measure the loss. Test views are never used.

    Parameters
    ----------
    model : a model folder or a file of splats, or what `load_model` returned.
    output : the PLY file to write.
    tolerance : largest loss of PSNR on the held-out views [dB].
    iterations : iterations of training after each round that removes a quarter of the splats; 0 means no training.
    compact : whether to omit columns that are not in use, instead of writing all columns of 3DGS.
    scene : replaces parts of the scene's record. A file needs the scene's path.
    iteration : as for `load_model`.
    overwrite : replace an existing file.
    device : OpenCL device, as for `Renderer`.
    progress : as for `train`.

    Raises
    ------
    InputError : a number is below 0 or none at all, or the model is empty. Or the model or the scene cannot be read.
    OutputError : the file exists or cannot be written.
    """
    check_tolerance(tolerance)
    if not is_whole(iterations):
        raise InputError(f"iterations is {describe_any(iterations)}; expected a whole number")
    if iterations < 0:
        raise InputError(f"iterations {iterations}: must be at least 0")
    output = Path(output)
    if output.is_dir():
        raise OutputError(f"{output}: is a folder: name the PLY file to write")
    if output.suffix.lower() != PLY_ENDING:
        raise OutputError(f"{output}: writes .ply files: choose this ending")
    refuse_existing([output], overwrite)
    loaded = model_at(model, iteration)
    if not len(loaded.splats):
        raise InputError(f"{loaded.path}: has no splats")
    pruned = _pruned(loaded, scene, tolerance, iterations, device, progress)
    source_bytes = stored_bytes(loaded.ply)
    pruned.splats.save(output, compact=compact)
    return PrunedModel(loaded, output, pruned, source_bytes)


def _pruned(
    model: LoadedModel,
    choice: SceneChoice | None,
    tolerance: float,
    iterations: int,
    device: str | None,
    progress: Callable[[Progress], None] | None,
) -> Pruned:
    scene = model.load_scene(choice)
    opened = open_device(device)
    validation = Validation(Renderer(opened), hold_out(scene).test, model.background)
    if not iterations:
        return prune(model.splats, scene.train, validation, tolerance)
    before = validation.psnr(model.splats)
    floor = before - SHARES["splats"] * tolerance
    splats = prune_in_rounds(scene, model.splats, validation, floor, iterations, opened, progress)
    now = validation.psnr(splats)
    parts = prune(splats, scene.train, validation, max(now - before + tolerance, 0.0), ("fields", "bands"))
    return replace(parts, before=before, costs={"splats": before - now, **parts.costs})
