"""How much each splat contributes to each view: its blending weight, from the kernels that train.

The gradient of the sum of all pixels with respect to a splat's colour is the sum of its blending weights. Grey replaces
all colours, so that no clamp stops the gradient. One backward pass then gives the weights of all splats in a view, and
each channel can weigh the pixels in its own way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.fields import DoubleArray
from ..splats.harmonics import SH_C0
from ..splats.splats import Splats
from .decoded import decoded

_ALL, _CLEAR = 0, 1  # channels


@dataclass(frozen=True)
class Contribution:
    """What one view takes from each splat.

    Attributes
    ----------
    weight : (N,) sum over the pixels that count of |alpha * transmittance| [px].
    clear : (N,) the same sum, each pixel times the transparency of the photo there; zeros for photos without.
    depth : (N,) camera z of the centres [world units].
    """

    weight: DoubleArray
    clear: DoubleArray
    depth: DoubleArray


def contributions(
    renderer: Renderer, splats: Splats, views: Sequence[View], longest: int | None = None
) -> Iterator[Contribution]:
    """Return the contributions to each view, one after the other.

    Parameters
    ----------
    views : the training views. Pixels that a mask hides do not count.
    longest : larger images are reduced to this longest side [px]; None keeps the size.

    Warns
    -----
    UserWarning : a photo cannot be decoded; its view is left out.

    Raises
    ------
    InputError : no photo can be decoded.
    """
    grey = _grey(splats)
    for whole in decoded(views, "looked at"):
        view = whole if longest is None else _at_most(whole, longest)
        weights = np.zeros((view.camera.height, view.camera.width, 3))
        weights[..., _ALL] = 1.0 if view.mask is None else view.mask
        if view.alpha is not None:
            weights[..., _CLEAR] = weights[..., _ALL] * (1.0 - view.alpha / 255.0)
        sums = _weights(renderer, grey, view.camera, weights)
        yield Contribution(sums[:, _ALL], sums[:, _CLEAR], depths(splats, view))


def shares_of_images(renderer: Renderer, splats: Splats, cameras: Sequence[Camera]) -> Iterator[DoubleArray]:
    """Yield for each camera the mean blending weight |alpha * transmittance| of each splat over its pixels, (N,)."""
    grey = _grey(splats)
    for camera in cameras:
        pixels = np.zeros((camera.height, camera.width, 3))
        pixels[..., _ALL] = 1.0 / (camera.width * camera.height)
        yield _weights(renderer, grey, camera, pixels)[:, _ALL]


def _grey(splats: Splats) -> Splats:
    return splats.with_arrays(splats.to_numpy() | {"sh": np.zeros((len(splats), 1, 3), splats.sh.dtype)})


def _weights(renderer: Renderer, grey: Splats, camera: Camera, pixels: DoubleArray) -> DoubleArray:
    """Return the sums (N, 3) of the blending weights over the pixels, each pixel times its value in `pixels`."""
    renderer.render(grey, camera)
    return np.abs(renderer.backward(pixels)["sh"][:, 0].astype(np.float64)) / SH_C0


def depths(splats: Splats, view: View) -> DoubleArray:
    """Return the camera z of the centres, (N,) [world units]."""
    pose = view.camera.cam_from_world
    z: NDArray[np.float64] = splats.mean.astype(np.float64) @ pose[2, :3] + pose[2, 3]
    return z


def _at_most(view: View, longest: int) -> View:
    """Return the view with its longest side reduced to `longest` px."""
    camera = view.camera.at_most(longest)
    return view.resized(camera.width, camera.height)
