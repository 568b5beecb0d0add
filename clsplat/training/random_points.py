"""Random points where the cameras of a scene look, for scenes without points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cameras.orbits import where_axes_meet
from ..splats.fields import Array

if TYPE_CHECKING:
    from ..cameras.camera import Camera
    from ..scenes.scene import Scene

SEEN_BY = 2  # smallest number of cameras that see a point: one camera alone does not determine its place
CENTRAL_SHARE = 0.75  # half of the points are in the region that this share of the cameras sees, if it exists
_FARTHEST = 9.0  # largest distance from the centre, in median distances of the cameras
_AHEAD = 3.0  # distance of the centre in front of parallel cameras, in scene extents
_DRAWS = 16  # number of draws of `count` points; points that cameras see are kept
_TESTED_CAMERAS = 32  # cameras that the points are tested against


def random_points(scene: Scene, count: int, rng: np.random.Generator) -> Array:
    """Return (count, 3) points: half of them where most cameras look, the others where at least two cameras look.

    The points are uniform in a contracted space around the point nearest to all optical axes (Barron et al. 2022,
    Mip-NeRF 360, eq. 10). The unit of this space is the median distance of the cameras, so far points are rare.
    """
    cameras = [view.camera for view in scene.train[:: -(-len(scene.train) // _TESTED_CAMERAS)]]
    centres = np.array([view.camera.position for view in scene.train])
    middle = _middle(cameras, scene.extent)
    unit = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    unit = unit if unit > 0 else 1.0
    min_cameras, half = min(SEEN_BY, len(cameras)), count // 2
    central, outer, unseen = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    for _ in range(_DRAWS):
        drawn = middle + unit * _uncontracted(count, rng)
        n_seeing = _cameras_seeing(cameras, drawn)
        is_central = n_seeing >= max(min_cameras, CENTRAL_SHARE * len(cameras))
        central = np.concatenate([central, drawn[is_central]])
        outer = np.concatenate([outer, drawn[(n_seeing >= min_cameras) & ~is_central]])
        unseen = drawn[n_seeing < min_cameras]
        if len(outer) >= count - half:
            break
    reach = float(np.linalg.norm(central - middle, axis=1).max(initial=0.0))
    for _ in range(_DRAWS if reach > 0 else 0):  # the central region is often a small part of the visible space
        if len(central) >= half:
            break
        drawn = middle + reach * _in_ball(count, rng)
        n_seeing = _cameras_seeing(cameras, drawn)
        central = np.concatenate([central, drawn[n_seeing >= max(min_cameras, CENTRAL_SHARE * len(cameras))]])
    half = min(half, len(central))
    return np.concatenate([central[:half], outer[: count - half], central[half:], unseen])[:count]


def seen(camera: Camera, xyz: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the depths (P,) of points, and whether they are in front of the camera and inside its image."""
    local = xyz @ camera.rotation.T + camera.translation
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = local[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside: NDArray[np.bool_] = (depth > 0) & ((pixel >= 0) & (pixel < (camera.width, camera.height))).all(axis=1)
    return depth, inside


def _cameras_seeing(cameras: Sequence[Camera], xyz: Array) -> NDArray[np.int64]:
    """Return the number of cameras that see each point, (P,)."""
    return np.asarray(np.sum([seen(camera, xyz)[1] for camera in cameras], axis=0), np.int64)


def _middle(cameras: Sequence[Camera], extent: float) -> Array:
    """Return the point nearest to all optical axes, or a point in front of parallel cameras."""
    nearest = where_axes_meet(cameras)
    if nearest is not None:
        return nearest
    centre = np.mean([camera.position for camera in cameras], axis=0)
    return np.asarray(centre + _AHEAD * extent * np.mean([camera.rotation[2] for camera in cameras], axis=0))


def _uncontracted(count: int, rng: np.random.Generator) -> Array:
    """Return (count, 3) points that are uniform in the contracted ball of radius 2."""
    ball = 2.0 * _in_ball(count, rng)
    radius = np.linalg.norm(ball, axis=1, keepdims=True)
    short = np.minimum(radius, 2.0 - 1.0 / _FARTHEST)
    return np.asarray(ball / radius * np.where(short > 1.0, 1.0 / (2.0 - short), short))


def _in_ball(count: int, rng: np.random.Generator) -> Array:
    """Return (count, 3) points that are uniform in the unit ball."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(direction * rng.uniform(size=(count, 1)) ** (1 / 3))
