"""The exploration noise of 3DGS-MCMC, with random numbers that a kernel can repeat (cl/math/philox.clh).

Random integers come from Philox4x32-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"). They are a
pure function of (seed, iteration, splat), so they do not depend on order, device or number of threads. The uniform
numbers are exact in float32. Only log, sqrt and sin/cos may differ by some ulp between devices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...splats.fields import Array
from ...splats.quaternions import rotations

Words = NDArray[np.uint32]
FourWords = tuple[Words, Words, Words, Words]

_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)  # added to the key after each round: golden ratio, sqrt(3) - 1
_ROUNDS = 10
_MASK = 0xFFFFFFFF

DROPOUT_STREAM = 2  # of the words that hide splats (dropout.py)

# The gate of 3DGS-MCMC (ubc-vision/3dgs-mcmc): sigmoid(100 ((1 - o) - 0.995)) = sigmoid(0.5 - 100 o). It is open only
# for nearly transparent splats.
GATE_SHARPNESS = 100.0
GATE_OFFSET = 0.5
# Extent of the scenes for which 3DGS-MCMC and SSS publish their constants [world units].
PUBLISHED_EXTENT = 7.45176


def philox4x32(counter: FourWords, key: tuple[int, int]) -> FourWords:
    """Return four random words for every counter, by Philox4x32-10.

    Parameters
    ----------
    counter : four uint32 arrays that broadcast, least significant word first.
    key : two 32-bit integers.
    """
    c0, c1, c2, c3 = (np.asarray(word, np.uint32) for word in counter)
    k0, k1 = key
    for _ in range(_ROUNDS):
        product0 = c0.astype(np.uint64) * np.uint64(_MULTIPLIERS[0])
        product1 = c2.astype(np.uint64) * np.uint64(_MULTIPLIERS[1])
        high0, low0 = _halves(product0)
        high1, low1 = _halves(product1)
        c0, c1, c2, c3 = high1 ^ c1 ^ np.uint32(k0), low1, high0 ^ c3 ^ np.uint32(k1), low0
        k0, k1 = (k0 + _WEYL[0]) & _MASK, (k1 + _WEYL[1]) & _MASK
    return c0, c1, c2, c3


def normal3(seed: int, iteration: int, n: int, stream: int = 0) -> NDArray[np.float32]:
    """Return three independent standard normals for each of `n` splats, (n, 3).

    The key is (seed low, seed high), the counter (index, iteration, stream, 0). By Box-Muller, words 0 and 1 give
    components 0 and 1, and words 2 and 3 give component 2; the second number of that pair is not used. The radius is
    sqrt(-2 ln uniform(word a)), the angle 2 pi uniform(word b). |normal| < 5.8.

    Parameters
    ----------
    seed : 0 <= seed < 2^64. iteration : 0 <= iteration < 2^32.
    stream : number of the use in an iteration, for independent numbers: 0 for this noise, 1 for SGHMC (sghmc.py), and
        DROPOUT_STREAM.
    """
    index = np.arange(n, dtype=np.uint32)
    rest = [np.asarray(word, np.uint32) for word in (iteration, stream, 0)]
    words = philox4x32((index, rest[0], rest[1], rest[2]), (seed & _MASK, seed >> 32))
    u0, u1, u2, u3 = (_uniform(word) for word in words)
    radius01, angle01 = np.sqrt(-2.0 * np.log(u0)), 2.0 * np.pi * u1
    radius2, angle2 = np.sqrt(-2.0 * np.log(u2)), 2.0 * np.pi * u3
    normals = (radius01 * np.cos(angle01), radius01 * np.sin(angle01), radius2 * np.cos(angle2))
    return np.stack(normals, axis=1).astype(np.float32)


def noise_amount(noise_lr: float, mean_lr: float, extent: float) -> float:
    """Return the factor of the noise, from its rate and the rate of positions (which includes the extent).

    The published displacement is the product of both rates and the covariance. It grows with the third power of the
    extent, so splats would leave a scene in large units. Above PUBLISHED_EXTENT it grows only in proportion to the
    extent here.
    """
    return noise_lr * mean_lr * min(PUBLISHED_EXTENT / extent, 1.0) ** 2


def noise_reach(extent: float) -> float:
    """Return the largest distance that noise moves a splat in one step [world units]."""
    return 0.1 * extent


def noise_gate(strength: Array) -> NDArray[np.float64]:
    """Return the factor of the noise by the largest |opacity| of a splat, (N,): .62 at 0, .5 at .005, .01 at .05."""
    gate: NDArray[np.float64] = 1.0 / (1.0 + np.exp(GATE_SHARPNESS * strength.astype(np.float64) - GATE_OFFSET))
    return gate


def covariance_times(quat: Array, log_scale: Array, vector: Array) -> NDArray[np.float64]:
    """Return Sigma v for (N, 3) vectors, with Sigma = R S S R'."""
    rotation = rotations(quat.astype(np.float64))
    in_frame = np.einsum("nji,nj->ni", rotation, vector) * np.exp(2.0 * log_scale.astype(np.float64))
    product: NDArray[np.float64] = np.einsum("nij,nj->ni", rotation, in_frame)
    return product


def _halves(product: NDArray[np.uint64]) -> tuple[Words, Words]:
    """Return the high and the low 32 bits."""
    return (product >> np.uint64(32)).astype(np.uint32), product.astype(np.uint32)


def _uniform(words: Words) -> NDArray[np.float64]:
    """Return the top 23 bits as the centre of their interval in (0, 1), exact in float32."""
    return ((words >> np.uint32(9)).astype(np.float64) + 0.5) * 2.0**-23
