"""1 - k of projected slants in float32: the textbook formula, as skew-normal splats are published, beside clsplat's.

1 - k = 1 - D'C^-1 D is the sharpness of the edge on the screen; its root divides the slope. For strong slants on
needles the first seven digits of k are 1.000000. Sums of squares (cl/shape/displacement.clh) keep all digits of 1 - k.
"""

from __future__ import annotations

from typing import Any

import numpy as np

LOW_PASS = 0.3
COUNT = 20_000
SLANTS, ASPECTS, LENGTHS = (2.0, 10.0, 1e3), (1.0, 1e2, 1e4), (30.0, 3000.0)  # px of the long axis


def arithmetic_row(slant: float, aspect: float, length: float) -> dict[str, Any]:
    """Return the share of random splats with 1 - k <= 0 (a NaN edge), and the 99th centile of its relative error."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(COUNT, 3))
    eta = slant * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # Two rows of A R S, from random directions.
    turned = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0]
    b = turned[:, :2] * np.array([length, length / aspect, length / aspect])
    exact = textbook(b, eta, np.float64, by_squares=True)
    result: dict[str, Any] = {"slant": slant, "aspect": aspect, "length_px": length}
    for name, by_squares in (("textbook", False), ("squares", True)):
        with np.errstate(all="ignore"):
            got = textbook(b, eta, np.float32, by_squares)
        error = np.where(np.isfinite(got), np.abs(got - exact) / exact, 1e9)  # 1e9: not finite
        result |= {f"{name}_not_positive": float(np.mean(~(got > 0))), f"{name}_error": float(np.quantile(error, 0.99))}
    return result


def textbook(b: np.ndarray, eta: np.ndarray, dtype: type, by_squares: bool) -> np.ndarray:
    """Return 1 - k, (N,): as 1 minus k, or as a ratio of sums of squares."""
    b, eta = b.astype(dtype), eta.astype(dtype)
    one = dtype(1)
    rest = one / (one + np.sum(eta * eta, axis=1))
    delta = eta * np.sqrt(rest)[:, None]
    b0, b1 = b[:, 0], b[:, 1]
    if not by_squares:
        xx, yy = (np.sum(row * row, axis=1) + dtype(LOW_PASS) for row in (b0, b1))
        xy = np.sum(b0 * b1, axis=1)
        x, y = np.sum(b0 * delta, axis=1), np.sum(b1 * delta, axis=1)
        return one - (yy * x * x - dtype(2) * xy * x * y + xx * y * y) / (xx * yy - xy * xy)

    def squared(vector: np.ndarray) -> np.ndarray:
        return np.sum(vector * vector, axis=1)

    area = np.cross(b0, b1)
    through = np.sum(delta * area, axis=1)
    low = dtype(LOW_PASS)
    whole = squared(area) + low * (squared(b0) + squared(b1) + low)
    part = (
        through * through
        + rest * squared(area)
        + low * (squared(np.cross(b0, delta)) + squared(np.cross(b1, delta)) + rest * (squared(b0) + squared(b1)) + low)
    )
    return part / whole
