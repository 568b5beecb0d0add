"""The first splats of a block: coarse splats first, then points of its own cell, never more than the cap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clsplat.blocks.cells import Cells, make_cells
from clsplat.blocks.start import with_points
from clsplat.scenes.colmap import Points
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide
from clsplat.training.run import train

N_COARSE = 40


@pytest.fixture(scope="module")
def config(scene: Scene) -> TrainConfig:
    return decide(scene, TrainConfig(shape="skew-normal", iterations=20, cap_max=N_COARSE, sh_degree=1)).config


@pytest.fixture(scope="module")
def coarse(scene: Scene, config: TrainConfig) -> Splats:
    return train(scene, config).splats


@pytest.fixture(scope="module")
def cells(scene: Scene, coarse: Splats) -> Cells:
    return make_cells(coarse.mean, np.ones(len(coarse)), [view.camera.position for view in scene.train], 2, 1)


@pytest.mark.parametrize("number", [0, 1])
def test_points_of_the_cell_fill_the_room(
    scene: Scene, coarse: Splats, cells: Cells, config: TrainConfig, number: int
) -> None:
    inside = coarse.select(cells.of(coarse.mean) == number)
    first = with_points(inside, scene, cells, number, 200, config)
    assert len(first) == 200
    n = len(inside)
    for name, array in inside.arrays.items():
        np.testing.assert_array_equal(first.arrays[name][:n], array)
    new = first.select(np.arange(n, 200))
    assert (cells.of(new.mean) == number).all()
    points = {tuple(point) for point in scene.points.xyz.astype(np.float32)}
    assert {tuple(mean) for mean in new.mean} <= points
    assert len({tuple(mean) for mean in new.mean}) == len(new)
    np.testing.assert_allclose(1 / (1 + np.exp(-new.opacity_logit)), config.density.init_opacity, rtol=1e-5)
    assert (np.linalg.norm(new.skew, axis=1) > 0.01).all(), "no skew is a stationary point"
    nearest = [np.sort(np.linalg.norm(first.mean - mean, axis=1))[1:4] for mean in new.mean]
    expected = config.density.init_scale * np.sqrt(np.mean(np.square(nearest), axis=1))
    np.testing.assert_allclose(np.exp(new.log_scale[:, 0]), expected, rtol=1e-3)
    again = with_points(inside, scene, cells, number, 200, config)
    assert all((again.arrays[name] == array).all() for name, array in first.arrays.items())


def test_without_room_or_points_nothing_is_added(
    scene: Scene, coarse: Splats, cells: Cells, config: TrainConfig
) -> None:
    inside = coarse.select(cells.of(coarse.mean) == 0)
    assert with_points(inside, scene, cells, 0, len(inside), config) is inside
    nothing = replace(scene, points=Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.int64)))
    assert len(with_points(inside, nothing, cells, 0, 200, config)) == len(inside)
    empty = coarse.select([])
    assert len(with_points(empty, nothing, cells, 0, 200, config)) == 0
    assert len(with_points(empty, scene, cells, 0, 50, config)) == 50
