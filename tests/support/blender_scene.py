"""A scene for the Blender tests: cameras around a cloud of splats."""

from __future__ import annotations

import math

import numpy as np

from clsplat.cameras.camera import Camera
from clsplat.cameras.orbits import look_at
from clsplat.splats.splats import Splats

WIDTH, HEIGHT = 96, 64


def facing(angle: float, distance: float = 4.0, off: tuple[float, float] = (0.0, 0.0)) -> Camera:
    place = np.array([distance * math.sin(angle), -0.7, -distance * math.cos(angle)])
    pose = look_at(place, np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return Camera(WIDTH, HEIGHT, 90.0, 90.0, WIDTH / 2 + off[0], HEIGHT / 2 + off[1], pose)


def some_splats(seed: int = 0, shape: str = "skew-normal") -> Splats:
    """Return a cloud in all colours with SH bands, and with skew if the shape has one."""
    rng = np.random.default_rng(seed)
    start = Splats.from_points(rng.normal(0, 0.5, (300, 3)), rng.random((300, 3)), shape, 2, opacity=0.7)
    arrays = start.to_numpy()
    arrays["sh"][:, 1:] = rng.normal(0, 0.15, arrays["sh"][:, 1:].shape)
    arrays["log_scale"] += rng.normal(-0.8, 0.5, arrays["log_scale"].shape)
    arrays["quat"] = rng.normal(size=(300, 4)).astype(np.float32)
    if "skew" in arrays:
        arrays["skew"] = rng.normal(0, 0.4, (300, 3)).clip(-0.7, 0.7).astype(np.float32)
    return Splats(shape, arrays)


def encoded(linear: np.ndarray) -> np.ndarray:
    """Convert light to sRGB display values."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
