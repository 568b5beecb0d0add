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

# Colour, alpha of a float32 render against float64, absolute. Pixel coordinates below 256 round by
# 1.5e-5 px, which a splat no narrower than sqrt(0.3) px turns into 1.1 * 1.5e-5; a conic of condition 1e2
# adds 6e-8 * 1e2 relative to q <= 11; Phi to 1e-6 and peak to 1e-5 add theirs. Weights sum to at most 1.
# Depth: the same, times the largest camera z. Pixels at a threshold jump instead: see THRESHOLD_JUMP.
IMAGE_FLOAT32 = 1e-4

# Gradients of a float32 render against float64, relative to the largest entry of the same field: the
# errors of IMAGE_FLOAT32 times q <= 11 from differentiating the exponential, in sums that cancel by half.
GRADIENT_FLOAT32 = 2e-3

# A pixel whose alpha lies within rounding of alpha_min = 1/255 gains or loses that splat (1/255 of its
# colour); one within rounding of t_min ends a splat earlier or later (T <= t_min / (1 - alpha_max) = 0.01).
# Such pixels may differ by this times the largest colour, and must be few.
THRESHOLD_JUMP = 0.0101


def relative_error(got: ArrayLike, want: ArrayLike) -> float:
    """Largest difference, relative to the largest entry of `want`; inf if anything is not finite."""
    difference = np.abs(np.asarray(got, dtype=np.float64) - np.asarray(want, dtype=np.float64))
    if difference.size == 0 or difference.max() == 0.0:
        return 0.0
    error = float(difference.max() / max(float(np.abs(want).max()), 1e-300))
    return error if np.isfinite(error) else float("inf")
