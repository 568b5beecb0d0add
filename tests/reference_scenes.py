"""Random splats and cameras for tests: small, off-centre, non-square, all from one seed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from reference_formulas import SKEW_MAX
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera

Arrays = dict[str, NDArray[np.float64]]


def random_camera(seed: int = 0, width: int = 23, height: int = 17) -> Camera:
    """A camera some 4 units from the origin that looks near it, fx != fy principal point off centre."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    pose[:3, 3] = [*rng.uniform(-0.2, 0.2, 2), 4.0]
    return Camera(width, height, 1.1 * width, 1.2 * width, 0.45 * width, 0.57 * height, pose)


def random_splats(seed: int = 0, n: int = 6, sh_degree: int = 2, dtype: type = np.float64) -> Arrays:
    """`n` splats around the origin: anisotropic, of every opacity and skew, quaternions of any norm."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0.0, 0.3, (n, (sh_degree + 1) ** 2, 3))
    sh[:, 0] += rng.uniform(-0.5, 1.5, (n, 3))
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    arrays = {
        "mean": rng.uniform(-1.0, 1.0, (n, 3)),
        "quat": rng.normal(size=(n, 4)) * rng.uniform(0.3, 3.0, (n, 1)),
        "log_scale": rng.uniform(-2.5, -0.5, (n, 3)),
        "opacity_logit": rng.uniform(-2.0, 4.0, n),
        "sh": sh,
        "skew": direction * rng.uniform(0.0, 0.99 * SKEW_MAX, (n, 1)),
    }
    return {name: array.astype(dtype) for name, array in arrays.items()}
