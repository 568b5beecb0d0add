"""morton.py: an order of points in which neighbours stay together."""

from __future__ import annotations

import numpy as np

from clsplat.splats.morton import morton_order


def test_corners_of_a_cube_come_in_z_order() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    assert corners[morton_order(corners)].tolist() == sorted(corners.tolist(), key=lambda p: (p[2], p[1], p[0]))


def test_neighbours_stay_together_and_far_points_take_no_detail() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (5000, 3))
    points[::1000] *= 1e6
    order = morton_order(points)
    assert np.array_equal(np.sort(order), np.arange(5000))
    near = np.abs(points).max(1) < 2

    def step(which: np.ndarray) -> float:
        walk = points[which[near[which]]]
        return float(np.median(np.linalg.norm(np.diff(walk, axis=0), axis=1)))

    assert step(order) < 0.2 * step(np.arange(5000))


def test_none_one_and_equal_points() -> None:
    assert morton_order(np.zeros((0, 3))).tolist() == []
    assert morton_order(np.ones((1, 3))).tolist() == [0]
    assert sorted(morton_order(np.ones((3, 3))).tolist()) == [0, 1, 2]
