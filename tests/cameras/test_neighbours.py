"""Cameras that look at the same place from nearby."""

from __future__ import annotations

import numpy as np
from looking_cameras import looking, ring

from clsplat.cameras.neighbours import nearest_cameras


def test_the_nearest_stand_beside_each_other() -> None:
    cameras = looking(ring(12), np.zeros(3))
    for one, near in enumerate(nearest_cameras(cameras, 4)):
        assert set(near) == {(one + step) % 12 for step in (-2, -1, 1, 2)}


def test_cameras_back_to_back_are_not_near() -> None:
    """Two rings: one looks to the centre, the other away from it, a little further out."""
    inward, outward = looking(ring(12), np.zeros(3)), looking(ring(12, 4.2), np.zeros(3))
    turned = []
    for camera in outward:
        pose = camera.cam_from_world.copy()
        pose[[0, 2]] *= -1.0
        turned.append(camera.posed(pose))
    for one, near in enumerate(nearest_cameras([*inward, *turned], 2)):
        assert all(other // 12 == one // 12 for other in near)


def test_cameras_on_a_tripod_are_near_by_their_direction() -> None:
    cameras = [camera.posed(_in_the_middle(camera.cam_from_world)) for camera in looking(ring(12), np.zeros(3))]
    for one, near in enumerate(nearest_cameras(cameras, 2)):
        assert set(near) == {(one - 1) % 12, (one + 1) % 12}


def test_no_camera_is_near_itself_where_several_share_a_place() -> None:
    cameras = looking(np.repeat(ring(4), 3, axis=0), np.zeros(3))
    near = nearest_cameras(cameras, 2)
    for one, row in enumerate(near):
        assert set(row) == set(range(one // 3 * 3, one // 3 * 3 + 3)) - {one}


def _in_the_middle(pose: np.ndarray) -> np.ndarray:
    middle = pose.copy()
    middle[:3, 3] = 0.0
    return middle
