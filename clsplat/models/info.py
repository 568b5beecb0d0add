"""Contents of a model or a scene, without rendering it or decoding photos."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..scenes.info import SceneInfo, is_scene, scene_info
from ..scenes.reconstruct.photo_files import is_photographs
from ..scenes.scene_files import OTHER_KINDS
from ..scenes.wrong_folder import describe_file, scene_hint
from ..splats.formats.any_file import ELSEWHERE, READ_ENDINGS, READ_NAMES, stored_bytes
from ..splats.stats import Complexity, complexity
from ..training.folder import ModelFolder
from .model import LoadedModel, load_model


@dataclass(frozen=True)
class ModelInfo:
    """A model's contents.

    Attributes
    ----------
    model : the loaded model. complexity : numbers of splats and parameters in use.
    """

    model: LoadedModel
    complexity: Complexity

    def to_json(self) -> dict[str, Any]:
        """Return plain values, which `clsplat info --json` prints."""
        splats = self.model.splats
        return {
            "shape": splats.shape,
            "normalisation": splats.normalisation,
            "sh_degree": splats.sh_degree,
            "antialiased": splats.antialiased,
            "low_pass": splats.low_pass,
            "origin": list(self.model.origin),
            "bytes": stored_bytes(self.model.ply),
            **self.complexity.to_json(),
        }


def inspect(
    path: str | os.PathLike[str], *, iteration: int | None = None, images: str | None = None
) -> ModelInfo | SceneInfo:
    """Return the contents of a model folder, a file of splats or a scene.

    Parameters
    ----------
    iteration : iteration of a model folder, as for `load_model`.
    images : folder of the photos of a scene.

    Raises
    ------
    InputError : the path is neither a model nor a scene, or it is damaged.
    """
    path = Path(path)
    if _is_scene(path):
        return scene_info(path, images)
    model = load_model(path, iteration)
    return ModelInfo(model, complexity(model.splats))


def _is_scene(path: Path) -> bool:
    if path.suffix.lower() in ELSEWHERE:
        return False  # load_model says what to do with them
    if path.is_file() and not is_scene(path) and not path.name.lower().endswith(READ_ENDINGS):
        raise InputError(f"{path}: {describe_file(path)}")
    if path.is_file() or not path.is_dir() or ModelFolder(path).iterations():
        return path.is_file() and is_scene(path) and path.name not in READ_NAMES
    if is_scene(path):
        return True
    if ModelFolder(path).is_used or any((path / name).is_file() for name in READ_NAMES):
        return False  # load_model reports what is missing
    if (hint := scene_hint(path)) is not None:
        raise InputError(hint)
    if is_photographs(path):
        raise InputError(f"{path}: photographs without poses: clsplat reconstruct {path} -o SCENE finds them")
    raise InputError(f"{path}: neither a model (point_cloud/) nor a scene (sparse/, {OTHER_KINDS})")
