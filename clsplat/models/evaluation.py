"""Evaluation of trained models on views of their scenes, with 3DGS's result files and a report."""

from __future__ import annotations

import os
import statistics
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError, check_choice
from ..evaluation.evaluate import Evaluation
from ..evaluation.evaluate import evaluate as evaluate_views
from ..evaluation.floaters import measure_floaters
from ..evaluation.metrics import DEFAULT_PROTOCOL, MetricProtocol
from ..evaluation.perceptual import Flip, Lpips
from ..files.existing import refuse_existing
from ..files.image_names import match_names
from ..files.json_file import read_object, write_json
from ..files.real_path import real_path
from ..rendering.outputs import ImageWriter, output_stems
from ..rendering.renderer import Rendered, Renderer
from ..rendering.views import RenderOutput, ViewProgress, files_of
from ..scenes.options import VIEW_SETS
from ..scenes.scene import Scene, View
from ..splats.color import Color
from ..splats.formats.any_file import stored_bytes
from ..splats.stats import complexity
from ..training.folder import ModelFolder
from .evaluation_report import write_model_report
from .measurements import ModelEvaluation, ViewRecorder
from .model import LoadedModel, SceneChoice, load_model, model_at

REPORT = "report.html"
_ONE_SCENE = "compare models of one scene, or measure them without a common report"
UNIT_RANGE_PROTOCOL = "3dgs"  # 3DGS's script passes images in 0..1 to LPIPS


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of an evaluation: views, metrics and report.

    Parameters
    ----------
    view_set : views to measure: "test", "train", "validation" or "all".
    protocol : how PSNR and SSIM are computed. If `protocol.corrected`, LPIPS, FLIP and the report's images use
        colour-corrected renders too.
    lpips, flip : whether to measure these too. Each requires the extra of its name.
    background : colour 0..1; None means the model's background.
    scene : replaces parts of the scene's record.
    report : whether to write a page with the images.
    scene_name : name of the scene in the report; None means `Scene.name`.
    """

    view_set: str = "test"
    protocol: MetricProtocol = DEFAULT_PROTOCOL
    lpips: bool = False
    flip: bool = False
    background: Color | None = None
    scene: SceneChoice = field(default_factory=SceneChoice)
    report: bool = True
    scene_name: str | None = None

    def __post_init__(self) -> None:
        check_choice("view_set", self.view_set, VIEW_SETS)


def evaluate(
    model: str | os.PathLike[str] | LoadedModel,
    options: EvaluationOptions | None = None,
    *,
    iteration: int | None = None,
    renders: str | Path | None = None,
    overwrite: bool = False,
    device: str | None = None,
    progress: ViewProgress | None = None,
) -> ModelEvaluation:
    """Measure a model on its scene's views, and write results.json, per_view.json and report.html into its folder.

    Nothing is written for a file of splats, which has no folder. In folders of other programs, whose results.json may
    have entries `ours_N`, ours are called `clsplat_N`.

    Parameters
    ----------
    model : a model folder, a file of splats, or what `load_model` returned.
    options : views and metrics; by default PSNR and SSIM of the test views.
    iteration : as for `load_model`.
    renders : folder for the rendered images as PNG; None writes no images.
    overwrite : replace existing files of `renders`. The files in the model's folder are always replaced.
    device : OpenCL device, as for `Renderer`.
    progress : called before each view.

    Raises
    ------
    InputError : the model or its scene cannot be read, or the scene has no such views.
    OutputError : a file exists or cannot be written.
    """
    options = options or EvaluationOptions()
    evaluator = Evaluator(options, Renderer(device), overwrite=overwrite)
    measured = evaluator(model_at(model, iteration), None if renders is None else Path(renders), progress)
    if measured.write_error is not None:
        raise measured.write_error
    return measured


def evaluate_models(
    paths: Sequence[Path],
    options: EvaluationOptions,
    *,
    comparison: Path | None = None,
    iteration: int | None = None,
    renders: Path | None = None,
    numbers: Path | None = None,
    overwrite: bool = False,
    device: str | None = None,
    progress: ViewProgress | None = None,
) -> list[ModelEvaluation]:
    """Measure several models like `evaluate`, and return their measurements.

    A model is also measured if its result files cannot be written; see `ModelEvaluation.write_error`. If the caller
    named other places, with `comparison` or `numbers`, that is only a warning. A warning says that models were measured
    on different views. With `comparison`, that is an InputError before anything is measured.

    Parameters
    ----------
    comparison : file of a report that compares the models. It replaces the reports of the single models.
    renders : folder of the images. If there are several models, each has a subfolder.
    numbers : JSON file for the numbers of all models, by path: the entries of results.json and per_view.json.
    overwrite : replace existing files of `comparison`, `numbers` and `renders`.
    """
    names = [real_path(path).name for path in paths]
    if renders is not None and len(set(names)) < len(names):
        raise InputError("the images of models in folders of one name would mix: measure these models one by one")
    refuse_existing([path for path in (comparison, numbers) if path is not None], overwrite)
    write = options.report and comparison is None
    evaluator = Evaluator(options, Renderer(device), write_reports=write, overwrite=overwrite)
    scenes: list[Scene] = []
    if comparison is not None and len(paths) > 1:
        sizes = []
        for path in paths:
            model = load_model(path, iteration)
            scenes.append(evaluator.scene_of(model))
            sizes.append(evaluator.view_sizes(model, scenes[-1]))
            if not _are_equal_views(sizes[0], sizes[-1]):
                raise InputError(_different(paths[0], path, _ONE_SCENE))
    measured = []
    for number, (path, name) in enumerate(zip(paths, names, strict=True)):
        folder = renders / name if renders is not None and len(paths) > 1 else renders
        scene = scenes[number] if scenes else None
        measured.append(evaluator(load_model(path, iteration), folder, progress, scene))
        if not _are_equal_views(measured[0].view_sizes, measured[-1].view_sizes):
            if comparison is not None:  # a photo has become unreadable meanwhile
                raise InputError(_different(paths[0], path, _ONE_SCENE))
            warnings.warn(_different(paths[0], path, "do not compare their numbers"), stacklevel=2)
    try:
        if numbers is not None:
            entries = zip(paths, measured, strict=True)
            write_json(numbers, {str(path): {"results": one.result, "per_view": one.per_view} for path, one in entries})
        if comparison is not None:
            # Whole paths if two folders have one name.
            labels = names if len(set(names)) == len(names) else [str(path) for path in paths]
            write_model_report(comparison, measured[-1].scene.name, measured, labels)
    except OutputError as error:
        return [*measured[:-1], replace(measured[-1], write_error=error)]
    if numbers is None and comparison is None:
        return measured
    for one in measured:
        if one.write_error is not None:
            warnings.warn(str(one.write_error), stacklevel=2)
    return [replace(one, write_error=None) for one in measured]


class Evaluator:
    """Evaluation of several models on one device.

    Parameters
    ----------
    write_reports : whether each model gets a report if the options request reports.
    overwrite : whether existing images may be replaced.

    Raises
    ------
    InputError : LPIPS or FLIP is not installed.
    """

    def __init__(
        self, options: EvaluationOptions, renderer: Renderer, write_reports: bool = True, overwrite: bool = False
    ) -> None:
        self.options, self.renderer, self.write_reports = options, renderer, write_reports and options.report
        self.overwrite = overwrite
        self.lpips = Lpips(unit_range=options.protocol.name == UNIT_RANGE_PROTOCOL) if options.lpips else None
        self.flip = Flip() if options.flip else None

    def __call__(
        self,
        model: LoadedModel,
        renders: Path | None = None,
        progress: ViewProgress | None = None,
        scene: Scene | None = None,
    ) -> ModelEvaluation:
        """Return the measurements of a model. Other parameters and errors are those of `evaluate`.

        scene : what `scene_of` has returned, if it is known.
        """
        options, background = self.options, self._background(model)
        scene = scene or self.scene_of(model)
        views = self._views_of(scene, model)
        recorder = ViewRecorder(self.lpips, self.flip, options.report, options.protocol.corrected)
        names, numbers = [view.name for view in views], count(1)
        refuse_existing(files_of(RenderOutput(renders), names), self.overwrite, scene.photo_files)
        writer = None if renders is None else ImageWriter(renders)
        stems = dict(zip(names, output_stems(names), strict=True)) if writer else {}

        def on_view(view: View, image: Rendered) -> None:
            if progress is not None:
                progress(next(numbers), len(names))
            if writer is not None:
                writer.write(stems[view.name], image)
            recorder(view, image)

        measured = evaluate_views(self.renderer, model.splats, views, background, options.protocol, on_view)
        per_view = {
            metric: {name: values[metric] for name, values in measured.per_view.items()} for metric in ("SSIM", "PSNR")
        } | recorder.per_view
        result = self._result(model, views, measured, recorder, background)
        if scene.train:
            test_psnr = measured.psnr if options.view_set == "test" else None
            result["floaters"] = measure_floaters(
                self.renderer, model.splats, scene.train, background, options.protocol, test_psnr
            ).to_json()
        evaluation = ModelEvaluation(model, scene, result, per_view, recorder.images)
        return evaluation if model.folder is None else self._written(evaluation, model.folder)

    def scene_of(self, model: LoadedModel) -> Scene:
        """Return the scene of a model. Errors and warnings are those of `LoadedModel.load_scene`."""
        return model.load_scene(self.options.scene, background=self._background(model))

    def _background(self, model: LoadedModel) -> Color:
        return model.background if self.options.background is None else self.options.background

    def view_sizes(self, model: LoadedModel, scene: Scene) -> dict[str, tuple[int, int]]:
        """Return (width, height) [px] of the views of a model to measure, by name. No photo is decoded.

        Raises
        ------
        InputError : the scene has no such views.
        """
        views = self._views_of(scene, model)
        return {view.name: (view.camera.width, view.camera.height) for view in views}

    def _views_of(self, scene: Scene, model: LoadedModel) -> list[View]:
        """Return the views to measure. Raise InputError if there are none."""
        view_set = self.options.view_set
        views = {
            "test": scene.test,
            "train": scene.train,
            "validation": scene.validation,
            "all": scene.views,
        }[view_set]
        if views:
            return views
        if view_set == "test" and scene.test_names:
            raise InputError(
                f"{model.path}: none of its {len(scene.test_names)} test photos can be used: "
                "copy them to the scene, or measure training views with --set train"
            )
        if view_set == "validation":
            raise InputError(
                f"{model.path}: has no validation views: measure others with --set, or train with "
                "clsplat train --validate"
            )
        raise InputError(
            f"{model.path}: was trained on all views, none is left to test it on: "
            "measure training views with --set train, or train with clsplat train --eval"
        )

    def _result(
        self, model: LoadedModel, views: Sequence[View], measured: Evaluation, recorder: ViewRecorder, background: Color
    ) -> dict[str, Any]:
        """Return the entry of results.json, without floaters."""
        return {
            "SSIM": measured.ssim,
            "PSNR": measured.psnr,
            **{metric: statistics.fmean(values.values()) for metric, values in recorder.per_view.items()},
            "render_ms": measured.render_ms,
            "bytes": stored_bytes(model.ply),
            **complexity(model.splats).to_json(),
            "shape": model.splats.shape,
            "normalisation": model.splats.normalisation,
            "set": self.options.view_set,
            "views": len(views),
            "sizes": sorted({(view.camera.width, view.camera.height) for view in views}),
            "background": list(background),
            "device": str(self.renderer.device.info),
            "protocol": self.options.protocol.describe() | recorder.describe(),
        }

    def _written(self, evaluation: ModelEvaluation, folder: ModelFolder) -> ModelEvaluation:
        """Write the measurements into the model's folder, and the report if it is asked for.

        Returns
        -------
        The evaluation with its report, or with the error that stopped the writing.
        """
        options, model = self.options, evaluation.model
        ending = "" if options.view_set == "test" else f"_{options.view_set}"
        key = f"{'ours' if folder.config_path.is_file() else 'clsplat'}_{model.iteration}"
        try:
            for stem, entry in (("results", evaluation.result), ("per_view", evaluation.per_view)):
                _add_entry(folder.path / f"{stem}{ending}.json", key, entry)
            if not self.write_reports:
                return evaluation
            file = folder.path / f"{Path(REPORT).stem}{ending}.html"
            name = options.scene_name or evaluation.scene.name
            report = write_model_report(file, name, [evaluation], [real_path(model.path).name])
        except OutputError as error:
            return replace(evaluation, write_error=error)
        return replace(evaluation, report=report)


def _are_equal_views(sizes: Mapping[str, tuple[int, int]], others: Mapping[str, tuple[int, int]]) -> bool:
    """Return whether the views of two models have equal names and sizes."""
    named = match_names(list(sizes), list(others))
    return named is not None and all(sizes[named[name]] == size for name, size in others.items())


def _different(first: Path, other: Path, remedy: str) -> str:
    return f"{other} and {first} are measured on different views or sizes: {remedy}"


def _add_entry(path: Path, key: str, entry: Mapping[str, Any]) -> None:
    """Add an entry to the JSON object in a file, which may hold entries of other iterations."""
    try:
        known = read_object(path)
    except InputError:  # A missing or damaged file is replaced: it holds only measurements.
        known = {}
    write_json(path, known | {key: entry})
