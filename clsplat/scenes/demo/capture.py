"""Photos of made-up worlds: rays through pixels, and which points a camera sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...cameras.camera import Camera
from ...cameras.orbits import look_at
from .rays import Hits, Rays, RayWorld

_SUBPIXELS = (0.25, 0.75)  # positions of 2x2 samples inside a pixel
_DEPTH_TOLERANCE = 2e-3  # [world units]; float32 rays have an error of about 1e-5 near the middle


def upright_camera(
    width: int, height: int, focal: float, position: NDArray[np.float64], target: NDArray[np.float64]
) -> Camera:
    """Return a camera without roll that looks at a place. focal : focal length [px]."""
    pose = look_at(position, target, np.array([0.0, 0.0, 1.0]))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def photograph(world: RayWorld, camera: Camera) -> NDArray[np.float32]:
    """Return a photo, (H, W, 3), colours 0..1, as the mean of 2x2 rays per pixel."""
    corners = pixels(camera)
    rays = [cast(world, camera, corners + np.array([dx, dy])).color for dy in _SUBPIXELS for dx in _SUBPIXELS]
    return np.mean(rays, axis=0).reshape(camera.height, camera.width, 3)


def visible(
    world: RayWorld, camera: Camera, xyz: NDArray[np.floating], normal: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Return whether the camera sees each surface point, (P,).

    A visible point projects into the image, its surface faces the camera, and no other surface is in front of it.

    Parameters
    ----------
    xyz, normal : (P, 3) positions and normals of the points.
    """
    places, depth = project(camera, xyz)
    inside = (depth > 0) & (places >= 0).all(axis=1) & (places < (camera.width, camera.height)).all(axis=1)
    facing = ((xyz - camera.position) * normal).sum(axis=1) < 0
    seen = np.zeros(len(xyz), np.bool_)
    candidates = np.flatnonzero(inside & facing)
    distance = np.linalg.norm(xyz[candidates] - camera.position, axis=1)
    nearest = world.nearest(*rays_through(camera, places[candidates]))
    seen[candidates] = np.abs(nearest - distance) < _DEPTH_TOLERANCE
    return seen


def pixels(camera: Camera) -> NDArray[np.float64]:
    """Return the corners x, y of all pixels, (H * W, 2), row by row."""
    y, x = np.mgrid[: camera.height, : camera.width]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def rays_through(camera: Camera, places: NDArray[np.float64]) -> tuple[Rays, Rays]:
    """Return origins and unit directions, (R, 3) each, of the rays through pixel positions (R, 2)."""
    local = np.concatenate(
        [(places - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones((len(places), 1))], axis=1
    )
    direction = local @ camera.rotation / np.linalg.norm(local, axis=1, keepdims=True)
    origin = np.broadcast_to(camera.position.astype(np.float32), direction.shape)
    return origin, direction.astype(np.float32)


def cast(world: RayWorld, camera: Camera, places: NDArray[np.float64]) -> Hits:
    """Return what is seen at pixel positions, (R, 2)."""
    return world.cast(*rays_through(camera, places))


def project(camera: Camera, xyz: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixel positions (P, 2) and depths (P,) of world points."""
    local = xyz @ camera.rotation.T + camera.translation
    depth = local[:, 2]
    safe = np.where(depth > 0, depth, 1.0)[:, None]
    return local[:, :2] / safe * (camera.fx, camera.fy) + (camera.cx, camera.cy), depth
