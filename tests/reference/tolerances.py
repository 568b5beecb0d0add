"""How far two computations of the same thing may differ, and why. Tests name one of these."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Two float64 routes to one value. Each of some 1e3 operations rounds by 1.1e-16; inverting a screen
# covariance of condition 1e3 and 1/(1-k) <= 90 of a bounded skew multiply that. Relative to the
# largest entry.
ROUNDING = 1e-10

# Central differences of step 1e-5 against an exact derivative, on scenes of order 1: truncation h² f'''/6
# is about 1e-10 |f'''|, rounding 1e-16 |f| / h about 1e-11 |f|; sums over pixels with random signs add two
# digits at most. Relative to the largest entry. Thresholds (alpha_min, t_min) must be 0, alpha_max 1.
DIFFERENCES = 1e-6

# Colour, alpha of a float32 render against float64, absolute, images below 256 pixels. A coordinate below 64
# rounds by 4e-6 px (1.5e-5 below 256), which a splat no narrower than sqrt(0.3) px turns into 1.1 times that;
# a conic of condition 1e2 adds 6e-8 * 1e2 relative to q <= 11 near the rim, where alpha is small; exp is good
# to 3.2e-7, Phi to 2.7e-7, peak to 3e-7. Weights sum to at most 1. Measured: 2e-6. Depth: the same, times the
# largest camera z. Pixels at a threshold jump by far more: comparisons leave them out
# (kernel_checks.Case.decided).
IMAGE_FLOAT32 = 1e-5

# Gradients of a float32 render against float64, relative to the largest entry of the same field: the
# errors of IMAGE_FLOAT32 times q <= 11 from differentiating the exponential. Measured: 5e-6; up to 4e-5 where
# 1 - opacity loses digits (logits above 6) or a field's sum cancels.
GRADIENT_FLOAT32 = 1e-4

# Two float32 renders of one scene, absolute: the errors above without those that both share.
SAME_FLOAT32 = 5e-6


def relative_error(got: ArrayLike, want: ArrayLike, floor: float = 0.0) -> float:
    """Largest difference, relative to the largest entry of `want` (at least `floor`); inf if not finite."""
    difference = np.abs(np.asarray(got, dtype=np.float64) - np.asarray(want, dtype=np.float64))
    if difference.size == 0 or difference.max() == 0.0:
        return 0.0
    error = float(difference.max() / max(float(np.abs(want).max()), floor, 1e-300))
    return error if np.isfinite(error) else float("inf")
