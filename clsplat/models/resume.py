"""Resuming of an interrupted run or search from its folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..blocks.state import BlocksOptions, BlocksState
from ..compression.rules import BudgetOptions
from ..compression.state import BudgetState
from ..scenes.options import ORIGIN
from ..training.config import TrainConfig
from ..training.log import Progress
from ..training.stored_run import StoredRun, existing_scene, load_recorded_scene, stored_run

if TYPE_CHECKING:
    from ..blocks.train import BlocksModel
    from ..compression.search import Budgeted
    from ..training.model import Model


@dataclass(frozen=True)
class Unfinished:
    """What can be resumed: a run, a search (`search`), or a training in blocks (`blocks`)."""

    run: StoredRun
    search: BudgetOptions | None = None
    blocks: BlocksOptions | None = None


def find_unfinished(path: str | os.PathLike[str]) -> Unfinished:
    """Return what can be resumed in a model folder.

    Raises
    ------
    InputError : there is neither a checkpoint nor an unfinished search or training in blocks, or a file is damaged.
    """
    if (search := BudgetState.stored(Path(path))) is not None:
        return Unfinished(*search)
    if (blocks := BlocksState.stored(Path(path))) is not None:
        return Unfinished(blocks[0], blocks=blocks[1])
    return Unfinished(stored_run(path))


def resume(
    path: str | os.PathLike[str],
    *,
    scene: str | os.PathLike[str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    allow_changed_photos: bool = False,
    **options: Any,
) -> Model | Budgeted | BlocksModel:
    """Continue what is unfinished in a model folder, with its options and scene, and return the result.

    Parameters
    ----------
    path : the model folder.
    scene : the scene's folder; by default the recorded one.
    progress : as for `train`.
    allow_changed_photos : warn about photos that have changed since the run, instead of an error.
    options : arguments of TrainConfig to change. Only those without an effect on the result may change, such as
        `device`, and the `iterations` of a run may rise.

    Raises
    ------
    InputError : there is nothing to resume, an option must not change, or photos have changed.
    Other exceptions : see `train`.
    """
    from ..blocks.train import train_in_blocks
    from ..compression.search import train_budget
    from ..scenes.changed_photos import check_photos
    from ..training.run import train

    stored = find_unfinished(path)
    config = TrainConfig(**(stored.run.options | options))
    # A run that has recorded no origin has not moved its scene.
    record = {"origin": list(ORIGIN), **stored.run.scene}
    found = scene or existing_scene(stored.run.scene_path, Path(path))
    loaded = load_recorded_scene(found, record, config.background)
    check_photos(loaded, stored.run.scene["photos"], Path(path), allow=allow_changed_photos, all_views=True)
    if stored.blocks is not None:
        return train_in_blocks(loaded, stored.blocks, config, progress, output=Path(path), resume=True)
    if stored.search is not None:
        return train_budget(loaded, config, stored.search, progress, output=Path(path), resume=True)
    return train(loaded, config, progress, output=Path(path), resume=True)
