"""Splats as interchange formats such as glTF and USD store them: with their values after the activations.

These are the unit quaternion w, x, y, z, the standard deviations and the opacity 0..1. `StoredSplats` have a quaternion
of any norm, logarithms and raw opacities. Position, harmonics and the fields of the shape are the same in both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..errors import InputError, named_place
from .axes import Signs, flipped
from .fields import Array, DoubleArray
from .shapes import GAUSSIAN, GENERALISED_EXPONENTIAL, SKEW_NORMAL, shape_named
from .similarity import moved, similarity
from .stored import StoredSplats

# The kernels of interchange files, and the field that each has besides those of a Gaussian.
EXTRA_FIELDS = {GAUSSIAN.name: "", SKEW_NORMAL.name: "skew", GENERALISED_EXPONENTIAL.name: "beta"}
SCALE, OPACITY = "scale", "opacity"
_LARGEST_LOG_SCALE = float(np.log(np.finfo(np.float32).max))
_ACTIVATED = ("log_scale", "opacity_logit")


def activated(splats: StoredSplats, signs: Signs) -> dict[str, Array]:
    """Return mean, quat, scale, opacity, sh and the field of the shape, with other signs of the axes.

    Computed values are float64, the others have the type of the splats. InputError : float32 does not hold a scale.

    splats : of a shape in EXTRA_FIELDS.
    """
    largest = splats.arrays["log_scale"].max(axis=1, initial=-np.inf)
    if (largest > _LARGEST_LOG_SCALE).any():
        number = int(np.argmax(largest))
        raise InputError(
            f"splat {number} has the scale e^{largest[number]:.4g}, which float32 does not hold: remove it, or "
            "write a .ply"
        )
    values = flipped(splats.arrays, signs)
    raw = {name: splats.arrays[name].astype(np.float64) for name in _ACTIVATED}
    quat = values["quat"].astype(np.float64)
    changed = {
        "quat": quat / np.linalg.norm(quat, axis=1, keepdims=True),
        SCALE: np.exp(raw["log_scale"]),
        OPACITY: np.clip(shape_named(splats.shape).opacity(raw["opacity_logit"]), 0.0, 1.0),
    }
    return {name: array for name, array in values.items() if name not in _ACTIVATED} | changed


def raw_arrays(shape: str, values: Mapping[str, Array], signs: Signs) -> dict[str, Array]:
    """Return the arrays of `StoredSplats` from the values that `activated` returns.

    Values without a finite logarithm or logit become infinite or NaN. `usable_arrays` treats these.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        changed = {
            "log_scale": np.log(values[SCALE].astype(np.float64)),
            "opacity_logit": shape_named(shape).raw_opacity(values[OPACITY].astype(np.float64)),
        }
    kept = {name: array for name, array in values.items() if name not in (SCALE, OPACITY)}
    return flipped(kept | changed, signs)


def placed(path: object, splats: StoredSplats, matrix: DoubleArray, signs: Signs) -> StoredSplats:
    """Return splats with the axes of a PLY after x -> A x, where A (4, 4) has the other signs of the axes.

    Raises
    ------
    InputError : the matrix scales the axes differently, shears or mirrors.
    """
    flips = np.diag([*signs, 1])
    matrix = flips @ matrix @ flips
    if np.array_equal(matrix, np.eye(4)):
        return splats
    with named_place(f"{path}: the place of its splats"):
        scale, rotation, translation = similarity(matrix)
    arrays = moved(splats.arrays, scale, rotation, translation)
    return replace(splats, arrays=arrays, near_plane=scale * splats.near_plane)
