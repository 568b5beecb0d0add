"""A trained model with the record in its folder: iteration, background, cameras and scene."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..cameras.cameras_json import NamedCamera, read_cameras
from ..errors import InputError
from ..files.image_names import bare_name
from ..files.json_file import to_real
from ..scenes.options import ALPHA_USES
from ..splats.any_file import load_splats
from ..splats.color import BLACK, Color
from ..splats.splats import Splats
from ..training.folder import ModelFolder

if TYPE_CHECKING:
    from ..scenes.scene import Scene


@dataclass(frozen=True)
class SceneChoice:
    """Changes of the scene that a model's folder records. None keeps the recorded value.

    Parameters
    ----------
    path : the scene's folder or transforms file.
    images : the folder of photos inside the scene.
    resolution : size of the photos, as for `load_scene`.
    """

    path: str | Path | None = None
    images: str | None = None
    resolution: int | None = None

    def __bool__(self) -> bool:
        return self != SceneChoice()


@dataclass(frozen=True)
class LoadedModel:
    """Splats and the record of their run.

    Attributes
    ----------
    path : the model folder or file that was loaded.
    ply : the file that holds the splats.
    splats : the model itself.
    folder, iteration : None if `path` is a file.
    background : colour of the run, 0..1; black if it is not recorded.
    scene_record : config.json's record of the scene; empty if there is none.
    """

    path: Path
    ply: Path
    splats: Splats
    folder: ModelFolder | None = None
    iteration: int | None = None
    background: Color = BLACK
    scene_record: dict[str, Any] = field(default_factory=dict)

    @property
    def test_names(self) -> frozenset[str] | None:
        """Names of the views that were held out from training; None if the folder does not record them."""
        names = self.scene_record.get("test_names")
        return None if names is None else frozenset(names)

    def read_cameras(self) -> list[NamedCamera]:
        """Return the cameras in the folder's cameras.json; an empty list if there is no such file."""
        if self.folder is None or not self.folder.cameras_path.is_file():
            return []
        return read_cameras(self.folder.cameras_path)

    def load_scene(self, choice: SceneChoice | None = None) -> Scene:
        """Return the scene that the model was trained on, with the same test views.

        Parameters
        ----------
        choice : replaces parts of the record. A model without a record needs its `path`; every eighth view is
            then a test view, as in 3DGS.

        Raises
        ------
        InputError : the scene is unknown, does not exist, or lacks a test view of the run.
        """
        from ..scenes.scene import load_scene  # imported late: it loads an image library, which would slow down --help

        choice, record = choice or SceneChoice(), self.scene_record
        path = choice.path or record.get("path")
        if path is None:
            raise InputError(f"{self.path}: does not record its scene: give the scene's folder with -s")
        if choice.path is None and not Path(path).exists():
            raise InputError(f"{self.path}: its scene {path} does not exist: give the scene's folder with -s")
        test_names = self.test_names
        scene = load_scene(
            path,
            choice.images or record.get("images"),
            record.get("resolution", -1) if choice.resolution is None else choice.resolution,
            eval=test_names is None,
            background=self.background,
            masks=record.get("masks"),
            alpha=record.get("alpha", ALPHA_USES[0]),
        )
        if test_names is None:
            return scene
        if missing := sorted(test_names - set(scene.names)):
            raise InputError(
                f"{path}: lacks view {missing[0]!r}, a test view of {self.path}: "
                "give the scene it was trained on with -s"
            )
        return replace(scene, test_names=test_names)


def load_model(path: str | os.PathLike[str], iteration: int | None = None) -> LoadedModel:
    """Return the model in a folder of clsplat or 3DGS, or in a file of splats (.ply, .splat, .spz).

    Parameters
    ----------
    iteration : iteration of the point cloud in a folder; by default the last.

    Raises
    ------
    InputError : the model or the iteration does not exist, or a file is damaged.
    """
    path = Path(path)
    if path.is_file():
        if iteration is not None:
            raise InputError(f"{path}: --iteration is for model folders, this is a file")
        return LoadedModel(path, path, load_splats(path))
    if not path.is_dir():
        raise InputError(f"{path}: no such model folder or PLY file")
    folder = ModelFolder(path)
    ply, number = folder.latest_ply(iteration)
    background, record = _read_record(folder)
    return LoadedModel(path, ply, Splats.load(ply), folder, number, background, record)


def model_at(model: str | os.PathLike[str] | LoadedModel, iteration: int | None = None) -> LoadedModel:
    """Return the model; load it unless it is a `LoadedModel`."""
    return model if isinstance(model, LoadedModel) else load_model(model, iteration)


def in_both_forms(names: frozenset[str]) -> frozenset[str]:
    """Return the names of images, and the same names without extension, which cameras.json uses."""
    return names | {bare_name(name) for name in names}


def _read_record(folder: ModelFolder) -> tuple[Color, dict[str, Any]]:
    """Return the background and the scene in config.json. Each value is checked, because people edit the file."""
    file = folder.config_path
    if not file.is_file():
        return BLACK, {}
    stored = folder.read_config()
    config, scene = stored.get("config", {}), stored.get("scene", {})
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
