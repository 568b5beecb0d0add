"""Rotations in files of other programs. Rounded and scaled matrices become rotations; other matrices are refused.

All readers of camera poses use `nearest_rotation`, so that they agree.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

# Largest deviation of a singular value from the scale of the matrix. Entries rounded to two decimals are off by up to
# 0.005 each, and the singular values then by up to 3 * 0.005.
TOLERANCE = 0.02
_EXACT = 1e-5  # matrices in float32 deviate by less; they stay as they are
_LARGE = 3e-4  # smallest deviation to warn of; rounding to four decimals gives at most half of it
_SCALES = (1e-6, 1e6)  # range of scales; a matrix outside of it is not a pose


class NotARotation(InputError):
    """A matrix cannot be made a rotation. The message is the rest of a sentence that begins with the matrix."""


@dataclass(frozen=True, eq=False)
class NearestRotation:
    """A rotation and what was wrong with the matrix in the file.

    Parameters
    ----------
    matrix : (3, 3) rotation.
    deviation : largest deviation of a singular value of the file's matrix from its scale, relative to the scale.
    scale : scale of the file's matrix.
    """

    matrix: NDArray[np.float64]
    deviation: float = 0.0
    scale: float = 1.0


def nearest_rotation(matrix: NDArray[np.float64]) -> NearestRotation:
    """Return the rotation nearest to a rounded or scaled one.

    A uniform scale of a camera's axes does not change its image, and some programs write it. So it is removed.

    Parameters
    ----------
    matrix : (3, 3), finite.

    Raises
    ------
    NotARotation : the matrix is mirrored or sheared, has different scales along its axes, or has no sensible scale.
    """
    left, values, right = np.linalg.svd(matrix)
    scale = float(values.mean())
    if not _SCALES[0] < scale < _SCALES[1]:
        raise NotARotation(f"is not a rotation: its scale is {scale:.3g}")
    deviation = float(np.abs(values / scale - 1.0).max())
    if deviation > TOLERANCE:
        raise NotARotation(
            f"is not a rotation: it is sheared or has different scales along its axes, from {values[-1]:.3g} to "
            f"{values[0]:.3g}"
        )
    nearest = left @ right
    if np.linalg.det(nearest) < 0:
        raise NotARotation("is not a rotation: it is mirrored")
    if max(deviation, abs(scale - 1.0)) <= _EXACT:
        return NearestRotation(matrix)
    return NearestRotation(nearest, deviation, scale)


def warn_of_corrections(source: object, rotations: Mapping[str, NearestRotation]) -> None:
    """Warn of rotations that were rounded or scaled in a file; the keys are their places in the file."""
    rounded = {place: rotation for place, rotation in rotations.items() if rotation.deviation > _LARGE}
    if rounded:
        place = max(rounded, key=lambda place: rounded[place].deviation)
        warnings.warn(
            f"{source}: {len(rounded)} of {len(rotations)} rotations are rounded, most of all that of {place} (by "
            f"{rounded[place].deviation:.1g}); they are made rotations again. Write poses with six decimals or more",
            stacklevel=3,
        )
    scaled = [place for place, rotation in rotations.items() if abs(rotation.scale - 1.0) > _LARGE + rotation.deviation]
    if scaled:
        warnings.warn(
            f"{source}: {len(scaled)} of {len(rotations)} rotations have a scale, for example {scaled[0]} "
            f"({rotations[scaled[0]].scale:.4g}); it is removed, because it does not change an image",
            stacklevel=3,
        )
