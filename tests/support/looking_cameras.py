"""Cameras that look at a point."""

from __future__ import annotations

import numpy as np

from clsplat.cameras.camera import Camera


def looking(places: np.ndarray, at: np.ndarray, field: float = 0.7) -> list[Camera]:
    """Square cameras with an angle of view [rad] that look at a point, y down."""
    cameras = []
    for place in places:
        forward = (at - place) / np.linalg.norm(at - place)
        right = np.cross([0.0, 0.0, 1.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place
        focal = 16 / np.tan(field / 2)
        cameras.append(Camera(32, 32, focal, focal, 16, 16, pose))
    return cameras


def ring(n: int = 12, radius: float = 4.0) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(n, 1.0)], axis=1)
