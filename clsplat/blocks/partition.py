"""Which splats, photos and surroundings belong to each block: what a coarse model shows in the photos decides."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import activity
from ..errors import InputError
from ..evaluation.contributions import contributions
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene
from ..splats.fields import DoubleArray
from ..splats.splats import Splats
from .cells import Cells, make_cells

LONGEST_SIDE = 200  # of the images in which visibility is measured [px]
SMALLEST_SHARE = 0.02  # of a photo that a block must fill for the photo to be among its training views
FEWEST_VIEWS = 3  # of a block, unless fewer show it
SEEN_WEIGHT = 0.5  # pixels that a splat around a block must fill in one of its photos to be shown in its run


@dataclass(frozen=True)
class BlockViews:
    """A block of a partition.

    Attributes
    ----------
    number : of the cell. splats : of the coarse model. points : of the scene.
    views : names of the training views, those that show most of it first.
    shares : part of each of these photos that the block fills.
    """

    number: int
    splats: int
    points: int
    views: tuple[str, ...]
    shares: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Partition:
    """The blocks of a scene. Their numbers are those of the cells."""

    cells: Cells
    blocks: tuple[BlockViews, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain values of all attributes."""
        return {"cells": self.cells.to_json(), "blocks": [asdict(block) for block in self.blocks]}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Partition:
        """Return the partition of the values of `to_json`."""
        blocks = tuple(
            BlockViews(**{**block, "views": tuple(block["views"]), "shares": tuple(block["shares"])})
            for block in values["blocks"]
        )
        return cls(Cells.from_json(values["cells"]), blocks)


def make_partition(scene: Scene, coarse: Splats, renderer: Renderer, n_columns: int, n_rows: int) -> Partition:
    """Return blocks of a scene that fill about equal parts of its photos.

    Parameters
    ----------
    coarse : a model of the whole scene. renderer : measures how much of each photo each splat fills.
    """
    total = np.zeros(len(coarse))
    for weights in _shares(scene, coarse, renderer):
        total += weights
    cells = make_cells(coarse.mean, total, [view.camera.position for view in scene.train], n_columns, n_rows)
    cell, cell_of_points = cells.of(coarse.mean), cells.of(scene.points.xyz)
    filled = np.array([np.bincount(cell, w, cells.count) for w in _shares(scene, coarse, renderer)])  # (V, cells)
    blocks = []
    for number, shares in enumerate(filled.T):
        views = _views_of_block(shares)
        blocks.append(
            BlockViews(
                number,
                int(np.count_nonzero(cell == number)),
                int(np.count_nonzero(cell_of_points == number)),
                tuple(scene.train[view].name for view in views),
                tuple(round(float(shares[view]), 4) for view in views),
            )
        )
    return Partition(cells, tuple(blocks))


def surroundings(scene: Scene, coarse: Splats, renderer: Renderer, partition: Partition) -> list[NDArray[np.int64]]:
    """Return for each block the splats outside of it that its training views show, in rising order."""
    cell = partition.cells.of(coarse.mean)
    views = [set(block.views) for block in partition.blocks]
    seen = np.zeros((len(views), len(coarse)), np.bool_)
    for view, shares in zip(scene.train, _shares(scene, coarse, renderer), strict=True):
        visible = shares * view.camera.width * view.camera.height >= SEEN_WEIGHT
        for number, names in enumerate(views):
            if view.name in names:
                seen[number] |= visible
    return [np.flatnonzero(row & (cell != number)) for number, row in enumerate(seen)]


def _shares(scene: Scene, splats: Splats, renderer: Renderer) -> Iterator[DoubleArray]:
    """Yield for each training view the part of it that each splat fills, (N,); raise InputError if its mask is gone."""
    number = 0
    for number, seen in enumerate(contributions(renderer, splats, scene.train, LONGEST_SIDE), 1):
        activity.report(f"looking at photo {number} of {len(scene.train)}")
        yield seen.weight / seen.pixels
    if number < len(scene.train):
        raise InputError(f"{scene.path}: a photo or its mask cannot be read any more: copy it there again")


def _views_of_block(shares: DoubleArray) -> NDArray[np.int64]:
    """Return the numbers of the views that show a block, first those that show most of it. shares : (V,)."""
    order = np.argsort(-shares, kind="stable")
    enough, visible = np.count_nonzero(shares >= SMALLEST_SHARE), np.count_nonzero(shares > 0)
    return order[: max(enough, min(FEWEST_VIEWS, visible))]
