"""Random splats and cameras for tests. The images are small and not square. Each scene comes from one seed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from reference.formulas import SKEW_MAX, SLANT_MAX
from reference.renderer import FIELDS, REFERENCES

Arrays = dict[str, NDArray[np.float64]]


def random_camera(seed: int = 0, width: int = 23, height: int = 17) -> Camera:
    """A camera about 4 units from the origin that looks near it. fx and fy differ, and the centre is shifted."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    pose[:3, 3] = [*rng.uniform(-0.2, 0.2, 2), 4.0]
    return Camera(width, height, 1.1 * width, 1.2 * width, 0.45 * width, 0.57 * height, pose)


def random_splats(seed: int = 0, n: int = 6, sh_degree: int = 2, dtype: type = np.float64) -> Arrays:
    """`n` splats around the origin: anisotropic, of every opacity and skew, with quaternions of any norm."""
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


def for_shape(arrays: Mapping[str, NDArray[np.floating]], shape: str) -> Arrays:
    """Convert `arrays` to the fields of `shape`. Fields of the shape that are missing become random.

    The other side's opacity is that of the previous splat, so a scene of dim splats stays dim. `skew` holds m and
    becomes the slant of the same skewness. If the shape allows both signs, every third opacity becomes negative.
    """
    own, rng, n = REFERENCES[shape], np.random.default_rng(11), len(arrays["mean"])
    normal, nu, beta = rng.normal(size=(n, 3)), 10.0 ** rng.uniform(0.0, 4.0, n), 0.5 * 16.0 ** rng.uniform(0.0, 1.0, n)
    minus = np.roll(arrays["opacity_logit"], 1)
    fields = {"opacity_minus_logit": minus, "normal": normal, "nu": nu, "beta": beta, **arrays}
    if own.direct:
        fields["skew"] = slant_of(arrays["skew"])
    if own.signed:
        positive = 0.5 * (1.0 + np.tanh(0.5 * arrays["opacity_logit"].astype(np.float64)))
        sign = np.where(np.arange(n) % 3, 1.0, -1.0)
        fields["opacity_logit"] = sign * np.arctanh(np.minimum(positive, 1.0 - 1e-12))
    return {name: np.asarray(fields[name]) for name in FIELDS[shape]}


def slant_of(shift: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the slants eta (N, 3) of the shifts m (N, 3).

    |eta|² = k / (1 - k), k = (pi/2) t / (1 + t), t = |m|². The slant stays a little below SLANT_MAX, so that a finite
    difference does not cross the bound.
    """
    t = (shift.astype(np.float64) ** 2).sum(1, keepdims=True)
    most = (0.99 * SLANT_MAX) ** 2
    k = np.minimum(0.5 * np.pi * t / (1.0 + t), most / (1.0 + most))
    return shift * np.sqrt(k / (1.0 - k) / np.maximum(t, 1e-30))
