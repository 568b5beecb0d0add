"""Interface between a shape and the reference renderer: one `ShapeReference` for each name of a shape.

Every function accepts complex arrays (reference/formulas.py explains the complex step).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

LOW_PASS = 0.3  # added to the screen covariance [px²]


def logistic(raw: Array) -> Array:
    """Return the opacity of a shape whose opacities lie in (0, 1)."""
    return 1.0 / (1.0 + np.exp(-raw))


def gaussian_falloff(q: Array) -> Array:
    return np.exp(-0.5 * q)


class Kernel(NamedTuple):
    """B screen kernels: alpha(d) = falloff(q) (amplitude_minus + (amplitude - amplitude_minus) Phi(slope' d)).

    Parameters
    ----------
    location : (B, 2) centre of the kernel [px]; d = pixel - location.
    scale2d : (B, 2, 2), low-pass included [px²]; q = d' inverse(scale2d) d.
    amplitude : (B,), factor before the falloff: opacity and normalisation.
    slope : (B, 2) [1/px], or None for shapes without sides, which have no Phi.
    amplitude_minus : (B,) the factor where slope' d is far below 0, or None for 0.
    falloff : rho of q (B, P); it includes the splats' own parameters.
    """

    location: Array
    scale2d: Array
    amplitude: Array
    slope: Array | None = None
    amplitude_minus: Array | None = None
    falloff: Callable[[Array], Array] = gaussian_falloff


@dataclass(frozen=True)
class Geometry:
    """The projection that all shapes share.

    Attributes
    ----------
    point_px : (B, 2) image of the projected point [px].
    affine : (B, 2, 3) affine map about that point [px per world unit].
    axes : (B, 3, 3) matrices R S, from the unit frame to the world.
    low_pass : added variance [px²].
    """

    point_px: Array
    affine: Array
    axes: Array
    low_pass: float = field(default_factory=lambda: LOW_PASS)

    def matrix2d(self, inner: Array | None = None) -> Array:
        """Return the screen matrix A R S inner S R' A' + low-pass. `inner` is (B, 3, 3); None is the identity."""
        b = self.affine @ self.axes
        half = b if inner is None else b @ inner
        return half @ np.swapaxes(b, 1, 2) + self.low_pass * np.eye(2)

    def vector2d(self, inner: Array) -> Array:
        """Return A R S inner (B, 2), for `inner` (B, 3)."""
        return np.einsum("bij,bjk,bk->bi", self.affine, self.axes, inner)


@dataclass(frozen=True)
class ShapeReference:
    """The reference's description of one shape.

    Parameters
    ----------
    fields : the shape's fields in addition to mean, quat, log_scale, opacity_logit and sh.
    kernel : (arrays, geometry, normalisation) -> Kernel.
    centre : arrays -> (B, 3), the projected point in the unit frame, relative to (x, y, z); None for (x, y, z) itself.
    direct : whether the field `skew` is the slant eta, and not the centred m.
    signed : whether opacities are tanh of the raw values, and not the logistic function.
    """

    fields: tuple[str, ...]
    kernel: Callable[[Mapping[str, Array], Geometry, str], Kernel]
    centre: Callable[[Mapping[str, Array]], Array] | None = None
    direct: bool = False
    signed: bool = False
