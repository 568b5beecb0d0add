"""A trained model as `render` and `eval` take it: splats, where they came from, and the scene behind them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.cameras.cameras_json import NamedCamera, read_cameras
from clsplat.errors import InputError
from clsplat.files.image_names import bare_name
from clsplat.files.json_file import to_real
from clsplat.scenes.options import ALPHA_USES
from clsplat.splats.color import BLACK, Color
from clsplat.splats.splats import Splats
from clsplat.training.folder import ModelFolder

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene


@dataclass(frozen=True)
class LoadedModel:
    """Splats with what their folder knows of them.

    Attributes
    ----------
    path : as given: a model folder or a PLY. ply : the file read.
    folder, iteration : None for a PLY.
    background : the run's, black where unknown.
    scene : config.json's record of the scene, {} where unknown.
    """

    path: Path
    ply: Path
    splats: Splats
    folder: ModelFolder | None = None
    iteration: int | None = None
    background: Color = BLACK
    scene: dict[str, Any] | None = None

    @property
    def test_names(self) -> frozenset[str] | None:
        """Views held out from training; None where the folder does not say."""
        names = (self.scene or {}).get("test_names")
        return None if names is None else frozenset(names)


def load_model(path: Path, iteration: int | None = None) -> LoadedModel:
    """A model folder (clsplat's or 3DGS's) at an iteration, the last by default, or a file of splats.

    Raises
    ------
    InputError : nothing there, no such iteration, or a damaged file.
    """
    if path.is_file():
        if iteration is not None:
            raise InputError(f"{path}: --iteration is for model folders, this is a file")
        return LoadedModel(path, path, load_splats(path))
    if not path.is_dir():
        raise InputError(f"{path}: no such model folder or PLY file")
    folder = ModelFolder(path)
    ply, found = folder.latest_ply(iteration)
    background: Color = BLACK
    scene: dict[str, Any] = {}
    if folder.config_path.is_file():
        background, scene = _recorded(folder)
    return LoadedModel(path, ply, Splats.load(ply), folder, found, background, scene)


def load_splats(path: Path) -> Splats:
    """What a .ply, .splat or .spz file holds; raises InputError."""
    if path.suffix.lower() == ".splat":
        from clsplat.splats.dot_splat import read_splat

        return read_splat(path)
    if path.suffix.lower() == ".spz":
        from clsplat.splats.spz import read_spz

        return read_spz(path)
    return Splats.load(path)


def scene_of(
    model: LoadedModel, source_path: Path | None = None, images: str | None = None, resolution: int | None = None
) -> Scene:
    """The scene that the model was trained on, read and split as then; every argument replaces its record.

    A model without a record needs `source_path`; every 8th view is then a test view, as in 3DGS.

    Raises
    ------
    InputError : no scene known, not where it was, or without the views that were held out.
    """
    from clsplat.scenes.scene import load_scene

    record = model.scene or {}
    path = source_path or record.get("path")
    if path is None:
        raise InputError(f"{model.path}: does not say which scene it shows: give the scene's folder with -s")
    if source_path is None and not Path(path).exists():
        raise InputError(f"{model.path}: its scene {path} is not there: give the scene's folder with -s")
    held_out = model.test_names
    scene = load_scene(
        path,
        images or record.get("images"),
        record.get("resolution", -1) if resolution is None else resolution,
        eval=held_out is None,
        background=model.background,
        masks=record.get("masks"),
        alpha=record.get("alpha", ALPHA_USES[0]),
    )
    if held_out is None:
        return scene
    if missing := sorted(held_out - set(scene.names)):
        raise InputError(
            f"{path}: lacks view {missing[0]!r}, a test view of {model.path}: give the scene it was trained on with -s"
        )
    return replace(scene, test_names=held_out)


def recorded_cameras(model: LoadedModel) -> list[NamedCamera]:
    """The cameras in the model's folder; none for a PLY or a folder without them."""
    if model.folder is None or not model.folder.cameras_path.is_file():
        return []
    return read_cameras(model.folder.cameras_path)


def both_forms(names: frozenset[str]) -> frozenset[str]:
    """Names of images and their forms in cameras.json, which has them without the extension."""
    return names | {bare_name(name) for name in names}


def one_model(model: Path | None, model_path: Path | None) -> Path:
    """The model given as an argument or as -m; raises click.UsageError unless there is one."""
    given = model or model_path
    if given is None or (model and model_path and model != model_path):
        raise click.UsageError("give one model folder or PLY file")
    return given


def _recorded(folder: ModelFolder) -> tuple[Color, dict[str, Any]]:
    """Background and scene of a config.json; checked, because people edit it."""
    stored = folder.read_config()
    config, scene = stored.get("config", {}), stored.get("scene", {})
    file = folder.config_path
    if not isinstance(config, dict) or not isinstance(scene, dict):
        raise InputError(f"{file}: config and scene must be objects: restore the file as it was written")
    rgb = config.get("background", [0, 0, 0])
    parts = [to_real(part) for part in rgb] if isinstance(rgb, list) else []
    if len(parts) != 3 or not all(part is not None and 0 <= part <= 1 for part in parts):
        raise InputError(f"{file}: config.background is {rgb!r}: expected three numbers from 0 to 1")
    kinds = {"path": str, "images": str, "resolution": int, "masks": str, "alpha": str, "test_names": list}
    for key, kind in kinds.items():
        if scene.get(key) is not None and not isinstance(scene[key], kind):
            raise InputError(f"{file}: scene.{key} is {scene[key]!r}: restore the file as it was written")
    if not all(isinstance(name, str) for name in scene.get("test_names") or []):
        raise InputError(f"{file}: scene.test_names must be names: restore the file as it was written")
    known = {key: value for key, value in scene.items() if value is not None}
    return (float(rgb[0]), float(rgb[1]), float(rgb[2])), known
