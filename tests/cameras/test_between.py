"""Cameras between those of neighbouring photos."""

from __future__ import annotations

import numpy as np
import pytest
from looking_cameras import looking, ring

from clsplat.cameras.between import between

MIDDLE = np.zeros(3)


def test_cameras_stand_on_the_ways_to_the_neighbours() -> None:
    places = ring(12)
    found = between(looking(places, MIDDLE))
    assert len(found) == 24  # 12 neighbours around the ring, two cameras between each pair
    wanted = [
        a + share * (b - a)
        for a, b in zip(places, np.roll(places, -1, axis=0), strict=True)
        for share in (1 / 3, 2 / 3)
    ]
    for place in wanted:
        assert min(np.linalg.norm(camera.position - place) for camera in found) < 1e-9


def test_they_look_where_the_neighbours_look() -> None:
    cameras = looking(ring(12), MIDDLE)
    for camera in between(cameras):
        forward = camera.rotation[2]
        toward = -camera.position / np.linalg.norm(camera.position)
        assert forward @ toward > np.cos(np.radians(2.0))
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
        assert (camera.width, camera.height, camera.fx) == (32, 32, cameras[0].fx)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_cameras_have_none_between(count: int) -> None:
    assert between(looking(ring(12)[:count], MIDDLE)) == []


def test_two_cameras_have_two_between() -> None:
    assert len(between(looking(ring(12)[:2], MIDDLE))) == 2


def test_cameras_that_look_elsewhere_are_no_neighbours() -> None:
    assert between(looking(ring(2), MIDDLE)) == []  # from opposite sides


def test_the_order_of_the_cameras_does_not_matter() -> None:
    cameras = looking(ring(9), MIDDLE)
    places = {tuple(np.round(camera.position, 9)) for camera in between(cameras)}
    assert places == {tuple(np.round(camera.position, 9)) for camera in between(cameras[::-1])}
