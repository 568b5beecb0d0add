"""Renders of a model: views or a camera path, written as images and videos."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from ..cameras.cameras_json import NamedCamera, named_cameras, read_cameras, write_cameras
from ..cameras.interpolate import resized_by_height
from ..cameras.make_path import PathRequest, make_path, name_frames
from ..cameras.path import DEFAULT_FPS, CameraPath, write_path
from ..errors import SMALLER_IMAGES, InputError, OutputError, check_choice
from ..files.existing import refuse_existing
from ..files.host_memory import available_bytes
from ..files.real_path import real_path
from ..files.video import VideoWriter, check_frame_size
from ..rendering.renderer import Renderer
from ..rendering.views import RenderOutput, ViewProgress, files_of, render_to_files
from ..scenes.options import VIEW_SETS
from ..splats.color import Color
from .detail import DetailLevels, DetailRenderer
from .model import LoadedModel, SceneChoice, in_both_forms, model_at

_BYTES = 60  # of a pixel: colour, alpha and depth as float32 on the device and the host, and what is written


@dataclass(frozen=True)
class ViewChoice:
    """Views to render.

    Parameters
    ----------
    cameras : a cameras.json; None means the cameras of the scene, or those in the model's folder.
    scene : the scene that the cameras come from.
    view_set : one of VIEW_SETS; None means the test views, or all views if there are no test views.
    path : a camera path through or around these cameras, instead of the cameras themselves.
    size : (width, height) of the images [px]; the vertical field of view is kept.
    """

    cameras: str | Path | None = None
    scene: SceneChoice = field(default_factory=SceneChoice)
    view_set: str | None = None
    path: PathRequest | None = None
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.view_set is not None:
            check_choice("view_set", self.view_set, VIEW_SETS)


@dataclass(frozen=True)
class ModelRenders:
    """The result of `render_views`.

    Attributes
    ----------
    views : the cameras by name.
    fps : frames per second of the path or the video.
    render_ms : median wall time of a render, without the first [ms].
    depth_scales : see `RenderedViews`.
    """

    views: list[NamedCamera]
    fps: float
    render_ms: float
    depth_scales: dict[str, float]


def render_views(
    model: str | os.PathLike[str] | LoadedModel,
    output: RenderOutput,
    choice: ViewChoice | None = None,
    *,
    background: Color | None = None,
    save_path: str | Path | None = None,
    iteration: int | None = None,
    overwrite: bool = False,
    device: str | None = None,
    detail: float = 0.0,
    progress: ViewProgress | None = None,
) -> ModelRenders:
    """Render views of a model into images, a video, or both, and return their description.

    Parameters
    ----------
    model : a model folder or a file of splats, or what `load_model` returned.
    output : files to write. Images along a path get a cameras.json beside them.
    choice : views to render; by default the model's test views.
    background : colour 0..1; by default the model's.
    save_path : file for the camera path.
    iteration : as for `load_model`.
    overwrite : replace existing files.
    device : OpenCL device, as for `Renderer`.
    detail : levels of detail, as `pixels` of `DetailLevels.choose`; 0 draws all splats.
    progress : called before each view.

    Raises
    ------
    InputError : the model or the views do not exist, two views have the same file, or an image is too large for the
        free memory.
    OutputError : a file exists or cannot be written.
    """
    choice = choice or ViewChoice()
    if output.video is not None:
        VideoWriter(Path(output.video), DEFAULT_FPS)  # raises now if the ending is wrong, not after the work
    loaded = model_at(model, iteration)
    views, path = choose_views(loaded, choice)
    _check_memory(views)
    if output.video is not None:
        for view in views:
            check_frame_size(output.video, view.camera.width, view.camera.height)
    fps = output.fps or (path.fps if path is not None else DEFAULT_FPS)
    path_cameras = None if path is None or output.folder is None else Path(output.folder) / "cameras.json"
    kept = None if loaded.folder is None else loaded.folder.cameras_path
    if path_cameras is not None and kept is not None and real_path(path_cameras) == real_path(kept):
        raise OutputError(f"{output.folder}: is the model itself, whose cameras.json is kept: name another folder")
    named = [Path(file) for file in (save_path, path_cameras) if file is not None]
    refuse_existing([*files_of(output, [view.name for view in views]), *named], overwrite)
    if path is not None and save_path is not None:
        write_path(save_path, path)
    renderer = Renderer(device)
    rendered = render_to_files(
        DetailRenderer(renderer, DetailLevels(loaded.splats), detail) if detail else renderer,
        loaded.splats,
        views,
        replace(output, fps=fps),
        loaded.background if background is None else background,
        progress,
    )
    if path_cameras is not None:
        write_cameras(path_cameras, views)
    return ModelRenders(views, fps, rendered.render_ms, rendered.depth_scales)


def choose_views(model: LoadedModel, choice: ViewChoice) -> tuple[list[NamedCamera], CameraPath | None]:
    """Return the views to render, and the camera path if one was requested.

    Raises
    ------
    InputError : there are no such views, or the scene or a file cannot be read.
    """
    held_out = _HeldOut(model.test_names or frozenset(), model.validation_names)
    source, view_set = model.path, choice.view_set
    if choice.cameras is not None:
        views, source, view_set = read_cameras(choice.cameras), Path(choice.cameras), view_set or "all"
    elif choice.scene or _needs_scene(model, view_set):
        scene = model.load_scene(choice.scene, check=False)
        views = named_cameras(scene.names, scene.cameras)
        held_out, source = _HeldOut(scene.test_names, scene.validation_names), scene.path
    else:
        views = model.read_cameras()
    if choice.path is not None:
        request = choice.path if choice.size is None else replace(choice.path, size=choice.size)
        path = make_path(request, model.splats, views, source)
        return name_frames(path, request.kind), path
    views = _select(views, held_out, view_set, source)
    if choice.size is not None:
        views = [NamedCamera(view.name, resized_by_height(view.camera, *choice.size)) for view in views]
    return views, None


def _needs_scene(model: LoadedModel, view_set: str | None) -> bool:
    """Return whether the views are in the scene alone that the model records: 3DGS's models name no test views."""
    if model.folder is None or model.test_names is not None or not model.scene_record.get("path"):
        return False
    return view_set in ("test", "train") or not model.folder.cameras_path.is_file()


def _check_memory(views: Sequence[NamedCamera]) -> None:
    """Raise InputError if the largest image cannot fit into the free memory of the machine."""
    width, height = max(((view.camera.width, view.camera.height) for view in views), key=lambda size: size[0] * size[1])
    needed, free = _BYTES * width * height, available_bytes()
    if needed > free:
        raise InputError(
            f"an image of {width}x{height} px needs at least {needed / 1e6:.0f} MB of memory, {free / 1e6:.0f} MB are "
            "free",
            SMALLER_IMAGES,
        )


class _HeldOut(NamedTuple):
    """Names of the views that a run did not train on, as far as they are known."""

    test: frozenset[str]
    validation: frozenset[str]


def _select(views: Sequence[NamedCamera], held_out: _HeldOut, view_set: str | None, source: Path) -> list[NamedCamera]:
    """Return the views of a set; by default the test views, or all if there are no test views."""
    if not views:
        raise InputError(
            f"{source}: no cameras to render: give --cameras cameras.json, a scene with -s, or --path orbit"
        )
    test_names, validation_names = in_both_forms(held_out.test), in_both_forms(held_out.validation)
    test = [view for view in views if view.name in test_names]
    if view_set in (None, "all"):
        return test if test and view_set is None else list(views)
    if view_set == "validation":
        validation = [view for view in views if view.name in validation_names]
        if not validation:
            raise InputError(
                f"{source}: no validation views are known: choose others with --set, or train with "
                "clsplat train --validate"
            )
        return validation
    if not test:
        raise InputError(f"{source}: no test views are known: use --set all, or train with clsplat train --eval")
    if view_set == "test":
        return test
    train = [view for view in views if view.name not in test_names | validation_names]
    if not train:
        raise InputError(f"{source}: no training views are known: choose others with --set")
    return train
