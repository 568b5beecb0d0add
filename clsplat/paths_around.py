"""Camera paths that nobody recorded: an orbit around what the cameras look at, or around the splats alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .errors import InputError
from .splats import Splats

Vector = NDArray[np.float64]

# Least eigenvalue of the mean of I - d d' below which the optical axes d count as parallel (about 4 degrees).
_PARALLEL = 5e-3
# Variance of x axes about level, (6 degrees)^2, below which tilting up no further is worth it.
_LEVELLING = 1e-2
# Without cameras: 3DGS worlds come from cameras, whose y axis points down; 60 degrees across, 4:3.
_UP = np.array([0.0, -1.0, 0.0])
_SIZE = (800, 600)
_FOCAL = 0.87
_DISTANCE = 2.5  # radii of the splats
_LIFT = 0.3  # of the distance


def orbit(splats: Splats, cameras: Sequence[Camera] = (), frames: int = 60) -> list[Camera]:
    """A full turn around the middle of the scene, looking at it.

    With cameras: their common up, median distance and median height about the point nearest to all their
    optical axes; the image of the first. Without: around the median splat, from where nearly all are seen.

    Parameters
    ----------
    splats : at least one.
    frames : cameras to make, at least 1.

    Raises
    ------
    InputError : no splats, or frames below 1.
    """
    if frames < 1 or len(splats) == 0:
        raise InputError(f"orbit: {frames} frames around {len(splats)} splats; both must be at least 1")
    means = splats.mean.astype(np.float64)
    if cameras:
        pattern = cameras[0]
        centres = np.array([camera.position for camera in cameras])
        up = _upwards(cameras)
        middle = _looked_at(cameras, means)
        offsets = centres - middle
        heights = offsets @ up
        height = float(np.median(heights))
        radius = float(np.median(np.linalg.norm(offsets - heights[:, None] * up, axis=1)))
        towards = offsets[0] - heights[0] * up
    else:
        width, tall = _SIZE
        pattern = Camera(width, tall, _FOCAL * width, _FOCAL * width, width / 2, tall / 2, np.eye(4))
        up, middle = _UP, np.median(means, axis=0)
        distance = _DISTANCE * float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.9)) or 1.0
        height, radius = _LIFT * distance, distance
        towards = np.array([0.0, 0.0, -1.0])
    radius = max(radius, 1e-3)  # all cameras straight above the middle
    first = _unit(towards, np.cross(up, [1.0, 0.0, 0.0]) + np.cross(up, [0.0, 0.0, 1.0]))
    first = _unit(first - (first @ up) * up, first)
    second = np.cross(up, first)
    turn = 2 * np.pi * np.arange(frames) / frames
    places = middle + height * up + radius * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    return [pattern.posed(look_at(place, middle, up)) for place in places]


def look_at(position: Vector, target: Vector, up: Vector) -> Vector:
    """(4, 4) cam_from_world of a camera at `position` that sees `target` in its middle, `up` upwards."""
    forward = _unit(target - position, np.array([0.0, 0.0, 1.0]))
    right = _unit(np.cross(forward, up), np.array([1.0, 0.0, 0.0]))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _upwards(cameras: Sequence[Camera]) -> Vector:
    """The cameras' mean up, pulled square to their x axes: photographers keep horizons level, not cameras."""
    mean = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    right = np.array([camera.rotation[0] for camera in cameras])
    levelled: Vector = np.linalg.solve(right.T @ right / len(cameras) + _LEVELLING * np.eye(3), mean)
    return _unit(levelled, _UP)


def _looked_at(cameras: Sequence[Camera], means: Vector) -> Vector:
    """The point nearest to all optical axes; where they are parallel, at the splats' median depth."""
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] > _PARALLEL:
        nearest: Vector = np.linalg.solve(system, np.einsum("nij,nj->i", across, centres) / len(cameras))
        return nearest
    forward, centre = _unit(axes.sum(axis=0), axes[0]), centres.mean(axis=0)
    depths = (means - centre) @ forward
    ahead = depths[depths > 0]
    middle: Vector = centre + forward * (float(np.median(ahead)) if len(ahead) else 1.0)
    return middle


def _unit(vector: Vector, otherwise: Vector) -> Vector:
    """The vector at length 1, or `otherwise` where it has none."""
    length = float(np.linalg.norm(vector))
    chosen: Vector = vector / length if length > 1e-9 else otherwise / np.linalg.norm(otherwise)
    return chosen
