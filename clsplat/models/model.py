"""A trained model with the record in its folder: iteration, background, cameras and scene."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..cameras.cameras_json import NamedCamera, read_cameras
from ..errors import InputError, Remedy
from ..files.image_names import bare_name
from ..files.json_file import describe, to_real
from ..scenes.options import BEFORE, ORIGIN, TEST_EVERY
from ..splats.color import BLACK, Color
from ..splats.splats import Splats
from ..training.folder import ModelFolder
from ..training.stored_run import checked_record, existing_scene
from .cfg_args import read_cfg_args

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
    masks, alpha : as for `load_scene`.
    test_every, test_list : as for `load_scene`; only for models that do not record their test views.
    allow_changed_photos : warn about photos that have changed since the run, instead of an error.
    """

    path: str | Path | None = None
    images: str | None = None
    resolution: int | None = None
    masks: str | None = None
    alpha: str | None = None
    test_every: int | None = None
    test_list: str | Path | None = None
    allow_changed_photos: bool = False

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

    @property
    def validation_names(self) -> frozenset[str]:
        """Names of the views that the run held out to choose between its models."""
        return frozenset(self.scene_record.get("validation_names", ()))

    @property
    def origin(self) -> tuple[float, float, float]:
        """The point of the scene's files that is the origin of the model, as of `Scene`."""
        x, y, z = self.scene_record.get("origin", ORIGIN)
        return float(x), float(y), float(z)

    def read_cameras(self) -> list[NamedCamera]:
        """Return the cameras in the folder's cameras.json; an empty list if there is no such file."""
        if self.folder is None or not self.folder.cameras_path.is_file():
            return []
        return read_cameras(self.folder.cameras_path)

    def load_scene(
        self, choice: SceneChoice | None = None, *, check: bool = True, background: Color | None = None
    ) -> Scene:
        """Return the scene that the model was trained on, with the same views held out. Photos are decoded at each use.

        Parameters
        ----------
        choice : replaces parts of the record. A model without a record needs its `path`; every eighth view is
            then a test view, as in 3DGS, if `choice` names no others.
        background : colour 0..1 under photos with transparency; None means the model's background.
        check : whether photos must be those of the run. Other `images` or `masks` are not compared.

        Raises
        ------
        InputError : the scene is unknown, does not exist, lacks a test view of the run, or has other photos; or
            `choice` names other test views than the record.
        """
        from ..scenes.changed_photos import check_photos
        from ..scenes.origin import is_far
        from ..scenes.scene import load_scene  # imported late: it loads an image library, which would slow down --help

        choice, record = choice or SceneChoice(), self.scene_record
        path = choice.path or record.get("path")
        if path is None:
            raise InputError(f"{self.path}: does not record its scene: give the scene's folder with -s")
        if choice.path is None:
            path = existing_scene(path, self.path)
        # A file of splats records nothing. Splats far away have the coordinates of the scene's files.
        is_known = "origin" in record or is_far(self.splats.mean)
        origin = self.origin if is_known else None
        test_names = self.test_names
        if test_names is not None and (choice.test_every or choice.test_list):
            leave_out = Remedy("leave out the choice of others", "--test-every", "--test-list")
            raise InputError(f"{self.path}: records its test views", leave_out)
        scene = load_scene(
            path,
            choice.images or record.get("images"),
            record.get("resolution", -1) if choice.resolution is None else choice.resolution,
            test_every=TEST_EVERY if choice.test_every is None else choice.test_every,
            test_list=choice.test_list,
            eval=test_names is None,
            background=self.background if background is None else background,
            masks=choice.masks or record.get("masks"),
            alpha=choice.alpha or record.get("alpha") or BEFORE["alpha"],
            read_photos=False,
            origin=origin,
            bars=record.get("bars") or BEFORE["bars"],
            rim=bool(record.get("rim")),
        )
        as_recorded = all(getattr(choice, name) in (None, record.get(name)) for name in ("images", "masks"))
        if check and as_recorded:
            check_photos(scene, record.get("photos"), self.path, allow=choice.allow_changed_photos)
        if test_names is None:
            return scene
        if missing := sorted(test_names - set(scene.names) - set(scene.left_out)):
            raise InputError(
                f"{path}: lacks view {missing[0]!r}, a test view of {self.path}: "
                "give the scene it was trained on with -s"
            )
        return replace(scene, test_names=test_names, validation_names=self.validation_names)


def load_model(path: str | os.PathLike[str], iteration: int | None = None) -> LoadedModel:
    """Return the model in a folder of clsplat or 3DGS, or in a file of splats in any format of `Splats.load`.

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
        return LoadedModel(path, path, Splats.load(path))
    if not path.is_dir():
        raise InputError(f"{path}: no such model folder or file of splats")
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
    """Return the background and the scene in config.json or 3DGS's cfg_args; black and nothing without these files.

    Each value is checked, because people edit the files.
    """
    file = folder.config_path
    if not file.is_file():
        return read_cfg_args(folder.cfg_args_path) if folder.cfg_args_path.is_file() else (BLACK, {})
    stored = folder.read_config()
    config = stored.get("config", {})
    if not isinstance(config, dict):
        raise InputError(f"{file}: config is {describe(config)}; expected an object: restore the file")
    rgb = config.get("background", [0, 0, 0])
    parts = [to_real(part) for part in rgb] if isinstance(rgb, list) else []
    if len(parts) != 3 or not all(part is not None and 0 <= part <= 1 for part in parts):
        raise InputError(f"{file}: config.background is {describe(rgb)}; expected three numbers from 0 to 1")
    try:
        known = checked_record(stored.get("scene", {}))
    except InputError as error:
        raise InputError(f"{file}: {error}: restore the file") from None
    if "path" in known:  # the path of a scene in the model's folder is relative to that folder
        known["path"] = str(folder.path / known["path"])
    return (float(rgb[0]), float(rgb[1]), float(rgb[2])), known
