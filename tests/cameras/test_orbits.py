"""Paths between key cameras and around a scene: laws of smoothness, and paths with a known shape."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.cameras.interpolate import interpolate, resized_by_height
from clsplat.cameras.make_path import PathRequest, make_path
from clsplat.cameras.orbits import ellipse, look_at, orbit, share_unseen, spiral, where_axes_meet
from clsplat.errors import InputError
from clsplat.splats.splats import Splats


def facing(position: object, target: object = (0, 0, 0), up: object = (0, 0, 1), focal: float = 50.0) -> Camera:
    pose = look_at(np.array(position, float), np.array(target, float), np.array(up, float))
    return Camera(60, 40, focal, focal, 30, 20, pose)


def keys(n: int = 5) -> list[Camera]:
    rng = np.random.default_rng(3)
    return [facing(rng.normal((4, 0, 1), 1.0), rng.normal(0, 0.3, 3), focal=40 + 10 * i) for i in range(n)]


def positions(cameras: list[Camera]) -> np.ndarray:
    return np.array([camera.position for camera in cameras])


def turns(cameras: list[Camera]) -> np.ndarray:
    rotations = Rotation.from_matrix([camera.rotation.T for camera in cameras])
    return (rotations[:-1].inv() * rotations[1:]).as_rotvec()


def cloud() -> Splats:
    rng = np.random.default_rng(0)
    return Splats.from_points(rng.normal(0, 0.5, (200, 3)), rng.random((200, 3)), sh_degree=0)


# --- between -----------------------------------------------------------------------------------


def test_a_path_begins_and_ends_at_its_keys_and_passes_the_others() -> None:
    key_cameras = keys()
    path = interpolate(key_cameras, 2001)
    for key, camera in ((key_cameras[0], path[0]), (key_cameras[-1], path[-1])):
        np.testing.assert_allclose(camera.cam_from_world, key.cam_from_world, atol=1e-9)
        assert camera.fx == pytest.approx(key.fx)
    for key in key_cameras[1:-1]:
        nearest = path[int(np.argmin(np.linalg.norm(positions(path) - key.position, axis=1)))]
        np.testing.assert_allclose(nearest.position, key.position, atol=5e-3)
        np.testing.assert_allclose(nearest.rotation, key.rotation, atol=5e-3)
        assert nearest.fx == pytest.approx(key.fx, rel=5e-3)


@pytest.mark.parametrize("closed", [False, True])
def test_positions_and_turns_are_smooth_to_the_second_derivative(closed: bool) -> None:
    """Second differences change little from frame to frame, also where a closed path meets its start.

    So position, direction and speed have no kink.
    """
    path = interpolate(keys(), 1500, closed)
    if closed:
        path += path[:4]
    for steps in (np.diff(positions(path), axis=0), turns(path)):
        speed = np.abs(steps).max()
        assert np.abs(np.diff(steps, axis=0)).max() < 0.03 * speed
        assert np.abs(np.diff(steps, n=2, axis=0)).max() < 1e-3 * speed


def test_a_closed_path_returns_to_its_first_key() -> None:
    path = interpolate(keys(), 400, closed=True)
    step = np.linalg.norm(np.diff(positions(path), axis=0), axis=1).max()
    assert 0 < np.linalg.norm(path[-1].position - path[0].position) < 2 * step


def test_focal_lengths_do_not_overshoot_the_keys() -> None:
    key_cameras = [facing((4, y, 1), focal=focal) for y, focal in ((0, 40), (1, 40), (2, 90), (3, 90))]
    focal = [camera.fx for camera in interpolate(key_cameras, 300)]
    assert min(focal) > 40 - 1e-9
    assert max(focal) < 90 + 1e-9


def test_speed_is_nearly_constant_for_keys_at_any_distances() -> None:
    key_cameras = [facing((4, y, 1), (0, y, 1)) for y in (0, 0.1, 2, 2.2, 6)]
    steps = np.linalg.norm(np.diff(positions(interpolate(key_cameras, 200)), axis=0), axis=1)
    assert steps.max() < 2.5 * np.median(steps)


def test_two_keys_give_a_straight_line_and_one_key_a_still_camera() -> None:
    two = keys(2)
    path = positions(interpolate(two, 5))
    np.testing.assert_allclose(path, np.linspace(two[0].position, two[1].position, 5), atol=1e-12)
    for camera in interpolate(two[:1], 3):
        np.testing.assert_array_equal(camera.cam_from_world, two[0].cam_from_world)


def test_equal_keys_in_a_row_are_a_short_stop() -> None:
    first, second = keys(2)
    path = interpolate([first, first, second], 50)
    assert np.isfinite(positions(path)).all()
    np.testing.assert_allclose(path[-1].position, second.position, atol=1e-9)
    for camera in interpolate([first, first], 4):
        np.testing.assert_allclose(camera.cam_from_world, first.cam_from_world, atol=1e-12)


def test_keys_of_other_sizes_keep_their_vertical_field_of_view() -> None:
    wide = Camera(200, 80, 100, 100, 110, 30, np.eye(4))
    shown = resized_by_height(wide, 60, 40)
    assert (shown.fx, shown.fy, shown.cx, shown.cy) == (50, 50, 35, 15)
    assert {(camera.width, camera.height) for camera in interpolate([*keys(2), wide], 4)} == {(60, 40)}


def test_no_keys_and_no_frames_are_refused() -> None:
    for bad in (([], 3), (keys(2), 0)):
        with pytest.raises(InputError, match="at least 1"):
            interpolate(*bad)


# --- around ------------------------------------------------------------------------------------


def test_cameras_on_an_ellipse_give_that_ellipse() -> None:
    """The ellipse has semi-axes 4 and 2, is turned by 0.5, and rises along its long axis."""
    angles = 2 * np.pi * np.arange(24) / 24 + 0.1
    x, y = 4 * np.cos(angles), 2 * np.sin(angles)
    flat = np.stack([x * math.cos(0.5) - y * math.sin(0.5), x * math.sin(0.5) + y * math.cos(0.5)], axis=1)
    ring = [facing((*place, 1 + 0.25 * a)) for place, a in zip(flat, x, strict=True)]
    made = positions(ellipse(cloud(), ring, 24))
    distance = np.linalg.norm(made[:, None] - positions(ring)[None], axis=2).min(axis=1)
    assert distance.max() < 0.05
    for camera in ellipse(cloud(), ring, 5):
        ahead = camera.rotation @ (np.zeros(3) - camera.position)
        np.testing.assert_allclose(ahead[:2] / ahead[2], 0, atol=0.05)
        assert camera.rotation[1] @ [0, 0, 1] < -0.5


def test_a_spiral_stays_near_the_central_camera_and_looks_at_one_point() -> None:
    row = [facing((x, -5, z), (x, 0, z)) for x in (-0.5, -0.2, 0, 0.2, 0.5) for z in (-0.3, 0, 0.3)]
    made = spiral(cloud(), row, 40)
    offsets = np.abs(positions(made) - (0, -5, 0)).max(axis=0)
    np.testing.assert_allclose(offsets[[0, 2]], [0.5, 0.3], rtol=0.05)
    assert offsets[1] < 1.01
    lines = np.array([camera.rotation[2] for camera in made])
    across = np.eye(3) - lines[:, :, None] * lines[:, None, :]
    target = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, positions(made)))
    for camera in made:
        ahead = camera.rotation @ (target - camera.position)
        np.testing.assert_allclose(ahead[:2] / ahead[2], 0, atol=1e-6)


@pytest.mark.parametrize("path", [orbit, ellipse, spiral])
def test_paths_close_and_need_no_cameras(path: object) -> None:
    splats = cloud()
    made = path(splats, (), 60)  # type: ignore[operator]
    steps = np.linalg.norm(np.diff(positions([*made, made[0]]), axis=0), axis=1)
    assert steps.max() < 3 * np.median(steps)
    for camera in made[::15]:
        local = splats.mean @ camera.rotation.T + camera.translation
        assert (local[:, 2] > 0).all()
        pixels = local[:, :2] / local[:, 2:] * camera.fx + (camera.cx, camera.cy)
        assert ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=1).mean() > 0.8
    for few in (splats.select([0]), splats.select([0, 0])):
        assert len(path(few, (), 2)) == 2  # type: ignore[operator]
    with pytest.raises(InputError):
        path(splats.select([]), (), 2)  # type: ignore[operator]


@pytest.mark.parametrize("path", [orbit, ellipse, spiral])
@pytest.mark.parametrize("n", [1, 2])
def test_one_camera_or_two_are_enough(path: object, n: int) -> None:
    made = path(cloud(), [facing((4, 0, 1)), facing((0, 4, 1))][:n], 7)  # type: ignore[operator]
    assert len(made) == 7
    assert np.isfinite(positions(made)).all()


# --- sides that no camera saw -------------------------------------------------------------------


def arc(degrees: float, n: int = 20, height: float = 1.0) -> list[NamedCamera]:
    """Return cameras on an arc about the z axis, which look at the origin."""
    turn = np.radians(degrees) * np.arange(n) / n
    return [NamedCamera(f"{i}", facing((4 * np.cos(angle), 4 * np.sin(angle), height))) for i, angle in enumerate(turn)]


@pytest.mark.parametrize(("degrees", "unseen"), [(360, 0.0), (180, (180 - 60) / 360), (60, (300 - 60) / 360)])
def test_the_share_of_unseen_sides_is_that_of_the_circle(degrees: float, unseen: float) -> None:
    """SEEN_ANGLE of 30 degrees is added at both ends of an arc."""
    cameras = [view.camera for view in arc(degrees, 60, height=0.0)]
    assert share_unseen(orbit(cloud(), cameras, 360), cloud(), cameras) == pytest.approx(unseen, abs=0.02)
    assert share_unseen(cameras, cloud(), cameras) == 0.0


@pytest.mark.parametrize("kind", ["orbit", "ellipse"])
def test_a_path_behind_a_scene_that_is_seen_from_one_side_warns(kind: str) -> None:
    message = rf"^--path {kind}: \d+% of the frames look from sides that no camera saw: --path spiral and --path interp"
    with pytest.warns(UserWarning, match=message):
        make_path(PathRequest(kind), cloud(), arc(90))


@pytest.mark.parametrize(
    ("kind", "views"),
    [("orbit", arc(360)), ("ellipse", arc(360)), ("spiral", arc(90)), ("interpolate", arc(90)), ("orbit", [])],
)
def test_a_path_within_seen_sides_does_not_warn(kind: str, views: list[NamedCamera]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_path(PathRequest(kind), cloud(), views)


def window(target: object, trembling: float, seed: int, n: int = 28) -> list[Camera]:
    """Return cameras in a window of 0.8 x 0.5 that look at a target, but for some trembling [degrees]."""
    rng = np.random.default_rng(seed)
    places = rng.uniform((-0.4, -0.25, -0.05), (0.4, 0.25, 0.05), (n, 3))
    turned = np.radians(trembling) * rng.standard_normal((n, 3)) * (1, 1, 0)
    target = np.asarray(target, float)
    aims = np.tile(target, (n, 1)) if np.isfinite(target).all() else places + np.array([0, 0, 1])
    return [
        facing(place, place + Rotation.from_rotvec(turn).apply(aim - place), up=(0, -1, 0))
        for place, turn, aim in zip(places, turned, aims, strict=True)
    ]


@pytest.mark.parametrize("seed", range(5))
def test_cameras_that_a_hand_holds_ahead_meet_nowhere(seed: int) -> None:
    """Trembling makes the axes cross at the cameras, where nothing is."""
    ahead = window((np.inf, 0, 0), 5.0, seed)
    centres, axes = positions(ahead), np.array([camera.rotation[2] for camera in ahead])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    nearest = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    assert np.linalg.norm(nearest - centres.mean(axis=0)) < 0.4, "the least squares alone are wrong here"
    assert where_axes_meet(ahead) is None
    found = where_axes_meet(window((0, 0, 2), 1.0, seed))
    assert found is not None
    assert np.linalg.norm(found - (0, 0, 2)) < 0.2


def test_cameras_on_a_way_ahead_meet_as_before() -> None:
    """They are behind each other, not side by side."""
    rng = np.random.default_rng(0)
    walk = [facing((rng.normal(0, 0.2), 0, z), (rng.normal(0, 2.0), 0, z + 10)) for z in np.linspace(0, 14, 30)]
    assert where_axes_meet(walk) is not None
