"""Camera paths through key cameras, smooth in position, direction and lens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from ..splats.fields import DoubleArray
from .camera import Camera

# Number of keys repeated on either side of a closed path. A cubic spline's end condition decays by 2 + sqrt(3) per key.
_WRAPPED = 10
_MIN_TURN = 0.1  # radians per key; a smaller mean turn is raised to this, so that small turns hardly change the speed
_MIN_GAP = 0.05  # smallest duration of a segment over the mean; two equal keys in a row become a short stop


def interpolate(keys: Sequence[Camera], frames: int, closed: bool = False, even: bool = False) -> list[Camera]:
    """Return `frames` cameras on a smooth path through the keys, starting at the first key.

    Positions follow a natural cubic spline (C2). Directions follow SciPy's spline of rotations, with continuous angular
    acceleration. Focal lengths (as logarithms) and principal points follow monotone cubics, which do not overshoot the
    keys. The speed is nearly constant: the duration of a segment grows with its length and its turn. All frames have
    the first key's size; keys of other sizes keep their vertical field of view.

    Parameters
    ----------
    keys : at least one.
    closed : whether the path returns to the first key after the last.
    even : whether every segment takes the same time, for example to change the number of frames of a path.

    Raises
    ------
    InputError : there are no keys, or `frames` is below 1.
    """
    from scipy.interpolate import CubicSpline, PchipInterpolator  # imported late: slow to load
    from scipy.spatial.transform import Rotation, RotationSpline

    if not keys or frames < 1:
        raise InputError(f"path: {frames} frames between {len(keys)} cameras; both must be at least 1")
    first = keys[0]
    framed = [resized_by_height(key, first.width, first.height) for key in keys]
    if len(framed) == 1:
        return framed * frames
    n, wrapped = len(framed), _WRAPPED if closed else 0
    order = np.arange(-wrapped, n + (wrapped + 1 if closed else 0)) % n
    places = np.array([camera.position for camera in framed])[order]
    turns = Rotation.from_matrix(np.array([camera.rotation.T for camera in framed])[order])
    lenses = np.array([(np.log(camera.fx), np.log(camera.fy), camera.cx, camera.cy) for camera in framed])[order]
    turned = np.asarray((turns[:-1].inv() * turns[1:]).magnitude())
    gaps = np.ones(len(turned)) if even else _gaps(places, turned)
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    start, end = times[wrapped], times[wrapped + n - (not closed)]
    at = start + (end - start) * np.arange(frames) / max(frames if closed else frames - 1, 1)
    at = np.minimum(at, end)
    position = CubicSpline(times, places, bc_type="natural")(at)
    rotation = RotationSpline(times, turns)(at).as_matrix()
    lens = PchipInterpolator(times, lenses)(at)
    return [_camera(first, *frame) for frame in zip(position, rotation, lens, strict=True)]


def resized_by_height(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera for an image of another size and aspect; the vertical field of view and the centre stay."""
    scale = height / camera.height
    return Camera(
        width,
        height,
        camera.fx * scale,
        camera.fy * scale,
        width / 2 + (camera.cx - camera.width / 2) * scale,
        camera.cy * scale,
        camera.cam_from_world,
    )


def _gaps(places: DoubleArray, turns: DoubleArray) -> DoubleArray:
    """Return the duration of each segment between two keys: its length plus its turn, each over the mean."""
    moves = np.linalg.norm(np.diff(places, axis=0), axis=1)
    gaps = turns / max(float(turns.mean()), _MIN_TURN)
    if moves.any():
        gaps = gaps + moves / moves.mean()
    mean = float(gaps.mean())
    return np.maximum(gaps, _MIN_GAP * mean) if mean > 0 else np.ones(len(gaps))


def _camera(pattern: Camera, position: DoubleArray, rotation: DoubleArray, lens: DoubleArray) -> Camera:
    """Return a camera of the pattern's size; `rotation` is camera-to-world."""
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ position
    fx, fy = np.exp(lens[:2])
    return Camera(pattern.width, pattern.height, float(fx), float(fy), float(lens[2]), float(lens[3]), pose)
