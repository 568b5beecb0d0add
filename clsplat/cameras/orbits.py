"""Closed camera paths around a scene: an orbit, an ellipse through the cameras, and a spiral about one of them.

Without cameras, a path starts from a ring of default cameras that see nearly all splats, with the y axis down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..splats.fields import DoubleArray
from ..splats.splats import Splats
from .camera import Camera

# Optical axes d count as parallel if the smallest eigenvalue of the mean of I - d d' is below this (about 4 degrees).
_PARALLEL = 5e-3
# Cameras that look ahead: shortest mean of their axes, and how far these miss the point nearest to all, in units of the
# cameras' spread side by side. The square of this ratio is about the part by which the point is too near.
_ONE_DIRECTION, _MISSED = 0.9, 0.5
ROUNDING = 1e-12  # of the distance from the origin: centres closer than this are one place
# Weight of the cameras' mean up direction against levelling: a variance of the x axes about level, (6 degrees)^2.
_LEVELLING = 1e-2
# Default cameras: 3DGS worlds are camera worlds, whose y axis points down. Images are 60 degrees wide, 4:3.
_UP = np.array([0.0, -1.0, 0.0])
_SIZE = (800, 600)
_FOCAL = 0.87  # focal length over the image width
_DISTANCE = 2.5  # distance over the splats' radius
_LIFT = 0.3  # height above the centre over the distance
_N_DEFAULT = 8  # number of default cameras
# A model shows what its photos show, and little more: past this angle a one-sided capture falls apart into blobs.
# Cameras around a scene are closer together than twice this angle.
SEEN_ANGLE = np.radians(30.0)
# The spiral of LLFF (Mildenhall et al. 2019).
_SPIRAL_TURNS = 2
_SPIRAL_QUANTILE = 0.9  # quantile of the cameras' offsets that becomes the radius
_SPIRAL_SHARE = 0.2  # largest radius over the distance to the target, for cameras that surround the scene


@dataclass(frozen=True)
class _Capture:
    """The cameras and the frame of reference that a path goes around.

    Attributes
    ----------
    cameras : at least one.
    pattern : camera with the path's image size and intrinsics.
    centres : (N, 3) camera centres.
    up : unit vector, the cameras' common up direction.
    middle : point that the cameras look at.
    across, along : unit vectors perpendicular to `up`: towards the first camera, and a quarter turn further.
    """

    cameras: Sequence[Camera]
    pattern: Camera
    centres: DoubleArray
    up: DoubleArray
    middle: DoubleArray
    across: DoubleArray
    along: DoubleArray

    @property
    def heights(self) -> DoubleArray:
        """Heights of the centres above the middle, (N,)."""
        return (self.centres - self.middle) @ self.up

    @property
    def level(self) -> DoubleArray:
        """Offsets of the centres from the middle along `across` and `along`, (N, 2)."""
        return (self.centres - self.middle) @ np.stack([self.across, self.along], axis=1)

    def look_from(self, positions: DoubleArray) -> list[Camera]:
        """Return cameras at the positions (M, 3) that look at the middle."""
        return [self.pattern.posed(look_at(position, self.middle, self.up)) for position in positions]


def orbit(splats: Splats, cameras: Sequence[Camera] = (), frames: int = 60) -> list[Camera]:
    """Return cameras on a circle that look at the middle of the scene.

    The middle is the point nearest to all optical axes. The circle has the cameras' common up direction, their median
    distance and their median height. Its images have the size of the first camera. Without cameras, the circle goes
    around the median splat.

    Parameters
    ----------
    splats : at least one.
    cameras : the cameras of the scene.
    frames : number of cameras to return, at least 1.

    Raises
    ------
    InputError : there are no splats, or `frames` is below 1.
    """
    capture = _capture("orbit", splats, cameras, frames)
    height = float(np.median(capture.heights))
    radius = float(np.median(np.linalg.norm(capture.level, axis=1)))
    radius = max(radius, 1e-3)  # cameras may all be straight above the middle
    turn = _angles(frames)
    level = radius * (np.cos(turn)[:, None] * capture.across + np.sin(turn)[:, None] * capture.along)
    return capture.look_from(capture.middle + height * capture.up + level)


def ellipse(splats: Splats, cameras: Sequence[Camera] = (), frames: int = 60) -> list[Camera]:
    """Return cameras on the ellipse that fits the cameras' positions, which look at the middle of the scene.

    The ellipse's axes are the principal axes of the cameras' offsets from the middle, perpendicular to their up
    direction; the ellipse tilts with their heights. Half the square of a semi-axis is the variance along it, so that
    cameras spread evenly on an ellipse give that ellipse. The path starts near the first camera and has its image size.

    Parameters and errors are those of `orbit`.
    """
    capture = _capture("ellipse", splats, cameras, frames)
    level = capture.level
    variances, axes = np.linalg.eigh(level.T @ level / len(level))
    axes[:, 0] = (axes[1, 1], -axes[0, 1])  # a right-handed pair turns in the same direction as the orbit
    halves = np.maximum(np.sqrt(2 * np.maximum(variances, 0.0)), 1e-3)
    parts = level @ axes / halves
    # The height is a constant plus a cosine and a sine of the angle, within the range of the cameras' heights.
    angles = np.arctan2(parts[:, 1], parts[:, 0])
    waves = np.stack([np.ones(len(angles)), np.cos(angles), np.sin(angles)], axis=1)
    fit = np.linalg.lstsq(waves, capture.heights, rcond=1e-3)[0]
    turn = angles[0] + _angles(frames)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    heights = np.clip(fit[0] + circle @ fit[1:], capture.heights.min(), capture.heights.max())
    flat = (circle * halves) @ axes.T @ np.stack([capture.across, capture.along])
    return capture.look_from(capture.middle + heights[:, None] * capture.up + flat)


def spiral(splats: Splats, cameras: Sequence[Camera] = (), frames: int = 60) -> list[Camera]:
    """Return cameras on a spiral about the most central camera, which look at one point in front of it.

    This is the path of LLFF (Mildenhall et al. 2019) for captures that face one way. It turns twice and moves once
    forwards and back. Its radii are the cameras' spread along the central camera's axes, at most a fifth of the
    distance to the target.

    Parameters and errors are those of `orbit`.
    """
    capture = _capture("spiral", splats, cameras, frames)
    centres = capture.centres
    others = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    centre = capture.cameras[int(np.argmin(others.sum(axis=1)))]
    ahead = float(centre.rotation[2] @ (capture.middle - centre.position))
    if ahead <= 0:  # the central camera looks away from the middle
        ahead = float(np.linalg.norm(capture.middle - centre.position)) or 1.0
    target = centre.position + ahead * centre.rotation[2]
    offsets = np.abs((centres - centre.position) @ centre.rotation.T)
    radii = np.minimum(np.quantile(offsets, _SPIRAL_QUANTILE, axis=0), _SPIRAL_SHARE * ahead)
    # A radius is zero for a single camera, and along one axis if all cameras lie in a plane.
    radii = np.where(radii > 1e-6 * ahead, radii, 0.25 * _SPIRAL_SHARE * ahead)
    turn = _SPIRAL_TURNS * _angles(frames)
    local = radii * np.stack([np.cos(turn), np.sin(turn), np.sin(turn / _SPIRAL_TURNS)], axis=1)
    up = -centre.rotation[1]
    return [centre.posed(look_at(place, target, up)) for place in centre.position + local @ centre.rotation]


def share_unseen(path: Sequence[Camera], splats: Splats, cameras: Sequence[Camera]) -> float:
    """Return the share of a path's frames that look at the scene from a side that no camera saw.

    Sides are directions from the middle of the scene. A frame's side counts as seen if a camera's direction is within
    `SEEN_ANGLE`.

    Parameters
    ----------
    path : at least one camera. splats, cameras : those that the path was made of.
    """
    if not cameras:
        return 0.0
    middle = _capture("path", splats, cameras, len(path)).middle
    sides, seen = (
        np.array([_unit(camera.position - middle, -camera.rotation[2]) for camera in part]) for part in (path, cameras)
    )
    return float(np.mean((sides @ seen.T).max(axis=1) < np.cos(SEEN_ANGLE)))


def where_axes_meet(cameras: Sequence[Camera]) -> DoubleArray | None:
    """Return the point nearest to all optical axes, (3,); None if the axes do not meet.

    Axes that are parallel but for the trembling of a hand do not meet. The point nearest to them lies at the cameras.
    """
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] <= _PARALLEL:
        return None
    point = np.asarray(np.linalg.solve(system, np.einsum("nij,nj->i", across, centres) / len(cameras)), np.float64)
    missed = np.einsum("nij,nj->ni", across, point - centres)
    return None if _look_ahead(centres, axes, missed) else point


def in_one_place(centres: DoubleArray) -> bool:
    """Return whether centres (N, 3) differ by no more than rounding, as those of a panorama."""
    largest = float(np.abs(centres).max())
    return bool(np.abs(centres - centres.mean(axis=0)).max() <= ROUNDING * largest)


def _look_ahead(centres: DoubleArray, axes: DoubleArray, missed: DoubleArray) -> bool:
    """Return whether cameras side by side look in one direction, and not at one point.

    missed : from each axis to the point nearest to all of them. Parallel axes miss it by as much as the cameras are
    away from their mean.
    """
    ahead = axes.mean(axis=0)
    length = float(np.linalg.norm(ahead))
    if length < _ONE_DIRECTION:
        return False
    offsets = centres - centres.mean(axis=0)
    along = offsets @ ahead / length
    beside = offsets - along[:, None] * ahead / length
    spread = np.sqrt((beside**2).sum() / len(centres))
    return bool(np.sqrt((along**2).mean()) < spread and np.sqrt((missed**2).sum() / len(centres)) > _MISSED * spread)


def look_at(position: DoubleArray, target: DoubleArray, up: DoubleArray) -> DoubleArray:
    """Return cam_from_world, (4, 4), of a camera at `position` with `target` in its centre and `up` upwards."""
    forward = _unit(target - position, np.array([0.0, 0.0, 1.0]))
    right = _unit(np.cross(forward, up), np.array([1.0, 0.0, 0.0]))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _capture(name: str, splats: Splats, cameras: Sequence[Camera], frames: int) -> _Capture:
    """Return the frame of reference of the cameras, or of default cameras around the splats; raises InputError."""
    if frames < 1 or len(splats) == 0:
        raise InputError(f"{name}: {frames} frames around {len(splats)} splats; both must be at least 1")
    means = splats.mean.astype(np.float64)
    cameras = cameras or _default_cameras(means)
    centres = np.array([camera.position for camera in cameras])
    up, middle = _up_direction(cameras), _middle(cameras, means)
    towards = centres[0] - middle
    towards = towards - (towards @ up) * up
    across = _unit(towards, np.cross(up, [1.0, 0.0, 0.0]) + np.cross(up, [0.0, 0.0, 1.0]))
    across = _unit(across - (across @ up) * up, across)
    return _Capture(cameras, cameras[0], centres, up, middle, across, np.cross(up, across))


def _default_cameras(means: DoubleArray) -> list[Camera]:
    """Return default cameras around the median splat that see nearly all splats."""
    width, tall = _SIZE
    middle = np.median(means, axis=0)
    distance = _DISTANCE * float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.9)) or 1.0
    turn = _angles(_N_DEFAULT)
    flat = np.stack([np.sin(turn), np.zeros(_N_DEFAULT), -np.cos(turn)], axis=1)
    places = middle + distance * (flat + _LIFT * _UP)
    return [
        Camera(width, tall, _FOCAL * width, _FOCAL * width, width / 2, tall / 2, look_at(place, middle, _UP))
        for place in places
    ]


def _angles(frames: int) -> DoubleArray:
    """Return evenly spaced angles of a full turn, without its end."""
    return 2 * np.pi * np.arange(frames) / frames


def _up_direction(cameras: Sequence[Camera]) -> DoubleArray:
    """Return the cameras' mean up direction, moved towards the perpendicular of their x axes.

    Photographers tilt cameras up and down, but they keep the horizon level.
    """
    mean = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    right = np.array([camera.rotation[0] for camera in cameras])
    levelled = np.linalg.solve(right.T @ right / len(cameras) + _LEVELLING * np.eye(3), mean)
    return _unit(levelled, _UP)


def _middle(cameras: Sequence[Camera], means: DoubleArray) -> DoubleArray:
    """Return the point nearest to all optical axes; for parallel axes, the point ahead at the splats' median depth."""
    nearest = where_axes_meet(cameras)
    if nearest is not None:
        return nearest
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    forward, centre = _unit(axes.sum(axis=0), axes[0]), centres.mean(axis=0)
    depths = (means - centre) @ forward
    ahead = depths[depths > 0]
    return centre + forward * (float(np.median(ahead)) if len(ahead) else 1.0)


def _unit(vector: DoubleArray, fallback: DoubleArray) -> DoubleArray:
    """Return the vector scaled to length 1, or `fallback` scaled so if the vector is zero."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-9 else fallback / np.linalg.norm(fallback)
