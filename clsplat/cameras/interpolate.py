"""Paths through chosen cameras: smooth in place, direction and lens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from ..splats.fields import DoubleArray
from .camera import Camera

# Keys repeated on either side of a closed path: what an end changes in a cubic spline decays by 2 + sqrt(3) a key.
_WRAPPED = 10
_LEAST_TURN = 0.1  # radians a key, below which turning counts for little in how long a stretch takes
_LEAST_GAP = 0.05  # of the mean: two equal keys one after the other are a short stop


def interpolate(keys: Sequence[Camera], frames: int, closed: bool = False, even: bool = False) -> list[Camera]:
    """`frames` cameras on a smooth path through the keys, the first key first.

    Positions go by a natural cubic spline (C2), directions by SciPy's spline of rotations (continuous angular
    acceleration), focal lengths (their logarithms) and principal points by monotone cubics, which do not swing beyond
    the keys. The speed is about even: a stretch takes as long as it is far and turns. All frames have the first key's
    size; keys of others keep their vertical field of view.

    Parameters
    ----------
    keys : at least one.
    closed : go back to the first key after the last; else end at the last.
    even : every stretch takes the same time, as for frames that are to be fewer or more.

    Raises
    ------
    InputError : no keys, or frames below 1.
    """
    from scipy.interpolate import CubicSpline, PchipInterpolator  # half a second to import
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
    position: DoubleArray = CubicSpline(times, places, bc_type="natural")(at)
    rotation: DoubleArray = RotationSpline(times, turns)(at).as_matrix()
    lens: DoubleArray = PchipInterpolator(times, lenses)(at)
    return [_camera(first, *frame) for frame in zip(position, rotation, lens, strict=True)]


def resized_by_height(camera: Camera, width: int, height: int) -> Camera:
    """The camera for an image of another size and aspect: the vertical field of view is kept, the middle stays."""
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
    """How long each stretch between two keys takes: its length and its turn, each over the mean one."""
    moves = np.linalg.norm(np.diff(places, axis=0), axis=1)
    gaps: DoubleArray = turns / max(float(turns.mean()), _LEAST_TURN)
    if moves.any():
        gaps = gaps + moves / moves.mean()
    mean = float(gaps.mean())
    return np.maximum(gaps, _LEAST_GAP * mean) if mean > 0 else np.ones(len(gaps))


def _camera(pattern: Camera, position: DoubleArray, rotation: DoubleArray, lens: DoubleArray) -> Camera:
    """A camera of the pattern's size; `rotation` is camera to world."""
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ position
    fx, fy = np.exp(lens[:2])
    return Camera(pattern.width, pattern.height, float(fx), float(fy), float(lens[2]), float(lens[3]), pose)
