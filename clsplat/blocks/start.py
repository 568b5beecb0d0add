"""The first splats of a block: those of the coarse model in its cell, and points of the scene in the room that is left.

A coarse model has a quarter of the splats, and so only some of the points of a scene with many. Densification alone may
not fill that room: it splits only splats whose gradient asks for it.
"""

from __future__ import annotations

import numpy as np

from ..scenes.distinct_points import distinct
from ..scenes.scene import Scene
from ..splats.splats import Splats
from ..splats.transform import joined
from ..training.config import TrainConfig
from ..training.initialise import MIN_POINTS, best_observed, started
from .cells import Cells


def with_points(inside: Splats, scene: Scene, cells: Cells, number: int, cap: int, config: TrainConfig) -> Splats:
    """Return the splats of a block with new splats from points of its cell, up to the cap.

    Parameters
    ----------
    inside : splats of the coarse model in the cell. number : of the cell. cap : largest number of splats.
    config : options of the whole training. New splats have its first opacity, and its factor of the distance to the
        three nearest points and splats.
    """
    of_cell = np.flatnonzero(cells.of(scene.points.xyz) == number)
    rows = of_cell[distinct(scene.points.xyz[of_cell])]
    points, room = scene.points, cap - len(inside)
    if room <= 0 or not len(rows) or len(rows) + len(inside) < MIN_POINTS:
        return inside
    if len(rows) > room:
        rows = rows[best_observed(points.xyz[rows], points.track_length[rows], room, scene)]
    around = np.concatenate([points.xyz[rows], inside.mean.astype(np.float64)])
    colors = np.concatenate([points.rgb[rows], np.zeros((len(inside), 3), np.uint8)])
    new = Splats.from_points(
        around,
        colors,
        shape=inside.shape,
        sh_degree=inside.sh_degree,
        normalisation=inside.normalisation,
        opacity=config.density.init_opacity,
        scale_factor=config.density.init_scale,
    ).select(np.arange(len(rows)))
    random = np.random.default_rng([config.seed, number])
    return joined([inside, inside.with_arrays(started(new, random).to_numpy())])
