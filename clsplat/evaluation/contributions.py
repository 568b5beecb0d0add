"""How much each splat contributes to each view: its blending weight, from the kernels that train.

The gradient of the sum of all pixels with respect to a splat's colour is the sum of its blending weights. Grey replaces
all colours, so that no clamp stops the gradient. One backward pass then gives the weights of all splats in a view.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..files.masks import Mask, resize_mask
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.fields import DoubleArray
from ..splats.harmonics import SH_C0
from ..splats.splats import Splats
from .decoded import decoded

_CHANNEL = 0  # of the three that are equal: that of the gradient


@dataclass(frozen=True)
class Contribution:
    """What one view takes from each splat.

    Attributes
    ----------
    weight : (N,) sum over the pixels that count of |alpha * transmittance| [px].
    depth : (N,) camera z of the centres [world units].
    pixels : number of all pixels of the image.
    """

    weight: DoubleArray
    depth: DoubleArray
    pixels: int


def contributions(
    renderer: Renderer, splats: Splats, views: Sequence[View], longest: int | None = None
) -> Iterator[Contribution]:
    """Return the contributions to each view, one after the other.

    Photos are decoded only if a mask may hide pixels of them.

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
    for view in decoded(views, "looked at", only_masked=True):
        camera = view.camera if longest is None else view.camera.at_most(longest)
        mask = view.mask if view.may_hide_pixels else None
        counts = 1.0 if mask is None else resize_mask(mask, camera.width, camera.height)
        yield Contribution(
            _weights(renderer, grey, camera, counts), depths(splats, camera), camera.width * camera.height
        )


def shares_of_images(renderer: Renderer, splats: Splats, cameras: Sequence[Camera]) -> Iterator[DoubleArray]:
    """Yield for each camera the mean blending weight |alpha * transmittance| of each splat over its pixels, (N,)."""
    grey = _grey(splats)
    for camera in cameras:
        yield _weights(renderer, grey, camera, 1.0 / (camera.width * camera.height))


def _grey(splats: Splats) -> Splats:
    return splats.with_arrays(splats.to_numpy() | {"sh": np.zeros((len(splats), 1, 3), splats.sh.dtype)})


def _weights(renderer: Renderer, grey: Splats, camera: Camera, counts: Mask | float) -> DoubleArray:
    """Return the sum (N,) of each splat's blending weights. counts : (H, W) or a number, the factors of the pixels."""
    renderer.render(grey, camera)
    pixels = np.zeros((camera.height, camera.width, 3))
    pixels[..., _CHANNEL] = counts
    return np.abs(renderer.backward(pixels)["sh"][:, 0, _CHANNEL].astype(np.float64)) / SH_C0


def depths(splats: Splats, camera: Camera) -> DoubleArray:
    """Return the camera z of the centres, (N,) [world units]."""
    pose = camera.cam_from_world
    z: NDArray[np.float64] = splats.mean.astype(np.float64) @ pose[2, :3] + pose[2, 3]
    return z
