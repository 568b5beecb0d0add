"""Files with the exposures of photos: 3DGS's exposure.json of a model, and those that a run begins with."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.json_file import get_matrix, read_object
from .folder import ModelFolder

Exposures = Mapping[str, NDArray[np.float64]]  # (3, 4) by the name of the photo


def exposures_json(names: Sequence[str], exposures: NDArray[np.floating]) -> dict[str, list[list[float]]]:
    """Return the content of 3DGS's exposure.json by photo name.

    The file holds the matrices E[:, :3] transposed, because 3DGS multiplies colours from the left.

    Parameters
    ----------
    exposures : (V, 3, 4). A photo has the colours E[:, :3] render + E[:, 3].
    """
    written = np.concatenate([exposures[:, :, :3].transpose(0, 2, 1), exposures[:, :, 3:]], axis=2)
    return dict(zip(names, written.tolist(), strict=True))


def read_exposures(path: Path) -> Exposures:
    """Return the exposures of a file that `exposures_json` has made; raise InputError if it is damaged."""
    values, remedy = read_object(path), "remove the file, or copy it again"
    try:
        stored = {name: get_matrix(values, name, (3, 4), remedy) for name in values}
    except InputError as error:
        raise InputError(f"{path}: {error}; {remedy}") from None
    return {name: np.concatenate([rows[:, :3].T, rows[:, 3:]], axis=1) for name, rows in stored.items()}


def exposures_of_start(init: str) -> Exposures:
    """Return the exposures that belong to the file of splats with which a run begins; empty without any.

    They are in the file `exposures_beside`, or those of the model in whose folder the file is.
    """
    file = Path(init)
    if not file.is_file():
        return {}
    models = [ModelFolder(folder).exposures_path for folder in file.parents[2:3]]  # point_cloud/iteration_N/
    found = next((path for path in (exposures_beside(file), *models) if path.is_file()), None)
    return {} if found is None else read_exposures(found)


def exposures_beside(splats: Path) -> Path:
    """Return the file of the exposures that a run begins with if it begins with this file of splats."""
    return splats.with_suffix(".exposure.json")


def copy_exposures(source: ModelFolder, target: Path) -> None:
    """Copy the exposures of a model to a file, if it has any."""
    if source.exposures_path.is_file():
        shutil.copyfile(source.exposures_path, target)
