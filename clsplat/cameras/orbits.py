"""Paths that nobody recorded, closed: an orbit, an ellipse through the cameras, a spiral about one of them.

Without cameras they start from a ring of made-up ones, from where nearly all splats are seen, the y axis down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..splats.splats import Splats
from .camera import Camera

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
_RING = 8  # made-up cameras
# The spiral of LLFF (Mildenhall et al. 2019): turns, quantile of the cameras' offsets that gives its radii, and at most
# so much of the distance to what is seen, for captures that surround it.
_SPIRAL_TURNS = 2
_SPIRAL_QUANTILE = 0.9
_SPIRAL_SHARE = 0.2


@dataclass(frozen=True)
class _Capture:
    """What a path goes around.

    Attributes
    ----------
    cameras : at least one. pattern : the image of the path's cameras.
    centres : (N, 3). up : unit. middle : what the cameras look at.
    across, along : unit, square to `up`: towards the first camera, and a quarter turn on.
    """

    cameras: Sequence[Camera]
    pattern: Camera
    centres: Vector
    up: Vector
    middle: Vector
    across: Vector
    along: Vector

    @property
    def heights(self) -> Vector:
        """Of the centres above the middle, (N,)."""
        heights: Vector = (self.centres - self.middle) @ self.up
        return heights

    @property
    def level(self) -> Vector:
        """The centres' offsets from the middle along `across` and `along`, (N, 2)."""
        level: Vector = (self.centres - self.middle) @ np.stack([self.across, self.along], axis=1)
        return level

    def looking(self, places: Vector) -> list[Camera]:
        """Cameras at the places (M, 3) that look at the middle."""
        return [self.pattern.posed(look_at(place, self.middle, self.up)) for place in places]


def orbit(splats: Splats, cameras: Sequence[Camera] = (), frames: int = 60) -> list[Camera]:
    """A full turn around the middle of the scene, looking at it.

    With cameras: their common up, median distance and median height about the point nearest to all their
    optical axes; the image of the first. Without: around the median splat.

    Parameters
    ----------
    splats : at least one.
    frames : cameras to make, at least 1.

    Raises
    ------
    InputError : no splats, or frames below 1.
    """
    capture = _capture("orbit", splats, cameras, frames)
    height = float(np.median(capture.heights))
    radius = float(np.median(np.linalg.norm(capture.level, axis=1)))
    radius = max(radius, 1e-3)  # all cameras straight above the middle
    turn = _turn(frames)
    level = radius * (np.cos(turn)[:, None] * capture.across + np.sin(turn)[:, None] * capture.along)
    return capture.looking(capture.middle + height * capture.up + level)


def ellipse(splats: Splats, cameras: Sequence[Camera] = (), frames: int = 60) -> list[Camera]:
    """A full turn on the ellipse that the cameras stand on, looking at what they look at.

    Its axes are the principal ones of their offsets from the middle, square to their up; it tilts with their heights.
    Cameras evenly about an ellipse give that ellipse: half an axis squared is the variance along it. The image is that
    of the first camera, which the path starts near.

    Parameters, raises: as `orbit`.
    """
    capture = _capture("ellipse", splats, cameras, frames)
    level = capture.level
    variances, axes = np.linalg.eigh(level.T @ level / len(level))
    axes[:, 0] = (axes[1, 1], -axes[0, 1])  # a right-handed pair, so that it turns as the orbit does
    halves = np.maximum(np.sqrt(2 * np.maximum(variances, 0.0)), 1e-3)
    parts = level @ axes / halves
    # Heights as constant + cosine + sine of the place on the ellipse, no further than cameras stood.
    angles = np.arctan2(parts[:, 1], parts[:, 0])
    waves = np.stack([np.ones(len(angles)), np.cos(angles), np.sin(angles)], axis=1)
    fit = np.linalg.lstsq(waves, capture.heights, rcond=1e-3)[0]
    turn = angles[0] + _turn(frames)
    round_ = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    heights = np.clip(fit[0] + round_ @ fit[1:], capture.heights.min(), capture.heights.max())
    flat = (round_ * halves) @ axes.T @ np.stack([capture.across, capture.along])
    return capture.looking(capture.middle + heights[:, None] * capture.up + flat)


def spiral(splats: Splats, cameras: Sequence[Camera] = (), frames: int = 60) -> list[Camera]:
    """Two turns about the most central camera, once to and fro, looking at one point before it.

    The path of LLFF, for captures that face one way: radii are the cameras' spread along that camera's axes, at most a
    fifth of the distance to what is seen.

    Parameters, raises: as `orbit`.
    """
    capture = _capture("spiral", splats, cameras, frames)
    centres = capture.centres
    others = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    centre = capture.cameras[int(np.argmin(others.sum(axis=1)))]
    ahead = float(centre.rotation[2] @ (capture.middle - centre.position))
    if ahead <= 0:  # it looks away from what the others see
        ahead = float(np.linalg.norm(capture.middle - centre.position)) or 1.0
    target = centre.position + ahead * centre.rotation[2]
    offsets = np.abs((centres - centre.position) @ centre.rotation.T)
    radii = np.minimum(np.quantile(offsets, _SPIRAL_QUANTILE, axis=0), _SPIRAL_SHARE * ahead)
    radii = np.where(radii > 1e-6 * ahead, radii, 0.25 * _SPIRAL_SHARE * ahead)  # one camera, or all in a plane
    turn = _SPIRAL_TURNS * _turn(frames)
    local = radii * np.stack([np.cos(turn), np.sin(turn), np.sin(turn / _SPIRAL_TURNS)], axis=1)
    up = -centre.rotation[1]
    return [centre.posed(look_at(place, target, up)) for place in centre.position + local @ centre.rotation]


def where_axes_meet(cameras: Sequence[Camera]) -> NDArray[np.float64] | None:
    """(3,) the point nearest to all optical axes; None where they are parallel."""
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] <= _PARALLEL:
        return None
    return np.asarray(np.linalg.solve(system, np.einsum("nij,nj->i", across, centres) / len(cameras)), np.float64)


def look_at(position: Vector, target: Vector, up: Vector) -> Vector:
    """(4, 4) cam_from_world of a camera at `position` that sees `target` in its middle, `up` upwards."""
    forward = _unit(target - position, np.array([0.0, 0.0, 1.0]))
    right = _unit(np.cross(forward, up), np.array([1.0, 0.0, 0.0]))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _capture(name: str, splats: Splats, cameras: Sequence[Camera], frames: int) -> _Capture:
    """The cameras, or a ring of them around the splats; raises InputError."""
    if frames < 1 or len(splats) == 0:
        raise InputError(f"{name}: {frames} frames around {len(splats)} splats; both must be at least 1")
    means = splats.mean.astype(np.float64)
    cameras = cameras or _ring(means)
    centres = np.array([camera.position for camera in cameras])
    up, middle = _upwards(cameras), _looked_at(cameras, means)
    towards = centres[0] - middle
    towards = towards - (towards @ up) * up
    across = _unit(towards, np.cross(up, [1.0, 0.0, 0.0]) + np.cross(up, [0.0, 0.0, 1.0]))
    across = _unit(across - (across @ up) * up, across)
    return _Capture(cameras, cameras[0], centres, up, middle, across, np.cross(up, across))


def _ring(means: Vector) -> list[Camera]:
    """Cameras around the median splat, from where nearly all are seen."""
    width, tall = _SIZE
    middle = np.median(means, axis=0)
    distance = _DISTANCE * float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.9)) or 1.0
    turn = _turn(_RING)
    flat = np.stack([np.sin(turn), np.zeros(_RING), -np.cos(turn)], axis=1)
    places = middle + distance * (flat + _LIFT * _UP)
    return [
        Camera(width, tall, _FOCAL * width, _FOCAL * width, width / 2, tall / 2, look_at(place, middle, _UP))
        for place in places
    ]


def _turn(frames: int) -> Vector:
    """Angles of a full turn, the last one short of it."""
    turn: Vector = 2 * np.pi * np.arange(frames) / frames
    return turn


def _upwards(cameras: Sequence[Camera]) -> Vector:
    """The cameras' mean up, pulled square to their x axes: photographers keep horizons level, not cameras."""
    mean = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    right = np.array([camera.rotation[0] for camera in cameras])
    levelled: Vector = np.linalg.solve(right.T @ right / len(cameras) + _LEVELLING * np.eye(3), mean)
    return _unit(levelled, _UP)


def _looked_at(cameras: Sequence[Camera], means: Vector) -> Vector:
    """The point nearest to all optical axes; where they are parallel, at the splats' median depth."""
    nearest = where_axes_meet(cameras)
    if nearest is not None:
        return nearest
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
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
