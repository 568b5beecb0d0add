"""Reconstructions of OpenSfM with known cameras, and its lenses by the formulas of its documentation."""

from __future__ import annotations

from typing import Any

import numpy as np
import photogrammetry_files as made
from scipy.spatial.transform import Rotation

Values = dict[str, Any]
SIDE = max(made.WIDTH, made.HEIGHT)
BROWN = {
    "projection_type": "brown",
    "focal_x": 0.81,
    "focal_y": 0.79,
    "c_x": 0.012,
    "c_y": -0.009,
    "k1": -0.06,
    "k2": 0.03,
    "k3": -0.01,
    "p1": 0.002,
    "p2": -0.003,
}
LENSES: dict[str, Values] = {
    "perspective": {"projection_type": "perspective", "focal": 0.8, "k1": -0.05, "k2": 0.02},
    "simple_radial": {key: BROWN[key] for key in ("focal_x", "focal_y", "c_x", "c_y", "k1")}
    | {"projection_type": "simple_radial"},
    "radial": {key: BROWN[key] for key in ("focal_x", "focal_y", "c_x", "c_y", "k1", "k2")}
    | {"projection_type": "radial"},
    "brown": BROWN,
    "fisheye": {"projection_type": "fisheye", "focal": 0.6, "k1": -0.02, "k2": 0.004},
    "fisheye_opencv": {key: BROWN[key] for key in ("focal_x", "focal_y", "c_x", "c_y", "k1", "k2")}
    | {"projection_type": "fisheye_opencv", "k3": 0.002, "k4": -0.001},
}


def pixels_of(lens: Values, local: np.ndarray) -> np.ndarray:
    """Return the pixels of points in the camera's frame by OpenSfM's documentation, with 0 at the image's corner."""
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    k1, k2, k3, k4, p1, p2 = (lens.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    s = x * x + y * y
    if "fisheye" in lens["projection_type"]:
        angle, radius = np.arctan(np.sqrt(s)), np.sqrt(s)
        a2 = angle**2
        factor = angle / radius * (1 + k1 * a2 + k2 * a2**2 + k3 * a2**3 + k4 * a2**4)
        u, v = factor * x, factor * y
    else:
        factor = 1 + k1 * s + k2 * s**2 + k3 * s**3
        u = factor * x + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        v = factor * y + 2 * p2 * x * y + p1 * (s + 2 * y * y)
    u = lens.get("focal", lens.get("focal_x")) * u + lens.get("c_x", 0.0)
    v = lens.get("focal", lens.get("focal_y")) * v + lens.get("c_y", 0.0)
    # The documentation's pixels have 0 at the centre of the first one.
    centres = np.array([(made.WIDTH - 1) / 2, (made.HEIGHT - 1) / 2])
    return SIDE * np.stack([u, v], axis=1) + centres + 0.5


def reconstruction(lens: Values | None = None, size: Values | None = None) -> Values:
    camera = (lens or LENSES["perspective"]) | ({"width": made.WIDTH, "height": made.HEIGHT} if size is None else size)
    xyz, rgb = made.points()
    shots = {}
    for name, shot in zip(made.NAMES, made.shots(), strict=True):
        offset = shot.local(np.zeros((1, 3)))[0]
        turn = np.stack([shot.local(axis[None])[0] - offset for axis in np.eye(3)], axis=1)
        shots[name] = {
            "camera": "v2 maker",
            "rotation": Rotation.from_matrix(turn).as_rotvec().tolist(),
            "translation": offset.tolist(),
            "gps_dop": 15.0,
            "orientation": 1,
        }
    points = {
        str(row): {"coordinates": place.tolist(), "color": color.astype(float).tolist()}
        for row, (place, color) in enumerate(zip(xyz, rgb, strict=True))
    }
    return {"cameras": {"v2 maker": camera}, "shots": shots, "points": points, "reference_lla": {"latitude": 50.0}}
