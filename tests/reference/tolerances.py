"""Allowed differences between two computations of one value, with their reasons. Tests use these names."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Two float64 computations of one value, relative to the largest entry. Each of about 1e3 operations rounds by
# 1.1e-16. Two factors multiply that: the inverse of a screen covariance of condition 1e3, and 1/(1-k) <= 90 of a
# bounded skew.
ROUNDING = 1e-10

# Central differences of step 1e-5 against an exact derivative, on scenes of order 1, relative to the largest
# entry. The truncation h² f'''/6 is about 1e-10 |f'''|, and the rounding 1e-16 |f| / h about 1e-11 |f|. Sums over
# pixels with random signs lose at most two more digits. Thresholds (alpha_min, t_min) must be 0, and alpha_max 1.
DIFFERENCES = 1e-6

# Colour and alpha of a float32 render against float64: absolute, for images below 256 pixels. A coordinate below
# 64 rounds by 4e-6 px (1.5e-5 below 256). A splat is at least sqrt(0.3) px wide, so this changes alpha by 1.1 times
# that. A conic of condition 1e2 adds 6e-8 * 1e2 relative to q <= 11 near the rim, where alpha is small. The errors of
# exp, Phi and peak are 3.2e-7, 2.7e-7 and 3e-7. Weights sum to at most 1. The measured error is 2e-6. The tolerance of
# depth is this one times the largest camera z. Pixels at a threshold differ far more, so comparisons exclude them
# (kernel_checks.Case.decided).
IMAGE_FLOAT32 = 1e-5

# Gradients of a float32 render against float64, relative to the largest entry of the same field. The derivative of
# the exponential multiplies the errors of IMAGE_FLOAT32 by q <= 11. The measured error is 5e-6. It is up to 4e-5 if
# 1 - opacity loses digits (logits above 6) or the terms of a field's sum cancel.
GRADIENT_FLOAT32 = 1e-4

# Two float32 renders of one scene, absolute: the errors above except those that both renders share.
SAME_FLOAT32 = 5e-6


def relative_error(got: ArrayLike, want: ArrayLike, floor: float = 0.0) -> float:
    """Return the largest difference relative to the largest entry of `want` (at least `floor`), inf if not finite."""
    difference = np.abs(np.asarray(got, dtype=np.float64) - np.asarray(want, dtype=np.float64))
    if difference.size == 0 or difference.max() == 0.0:
        return 0.0
    error = float(difference.max() / max(float(np.abs(want).max()), floor, 1e-300))
    return error if np.isfinite(error) else float("inf")
