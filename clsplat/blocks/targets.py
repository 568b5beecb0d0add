"""What a block learns from its photos: its own part of them, while the rest stays as the model before shows it.

Several blocks are visible in one pixel, and all would correct the same error. So the photo counts for a block as far as
its splats make up the pixel. Let w be the block's part of the pixel, I the photo and C the picture of the model before.
The block learns w I + (1 - w) C. The parts of all blocks sum to 1, so their corrections sum to I - C. Outside of its
pixels a block learns to change nothing. With exposures, C is the picture with the exposure of the photo. This is a
partition of unity, as in additive Schwarz methods.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .. import activity
from ..files.images import ImageU8
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene, View
from ..splats.fields import Array, DoubleArray
from ..splats.harmonics import SH_C0
from ..splats.splats import Splats
from ..splats.transform import joined
from ..training.exposure_file import Exposures


def with_block_targets(
    scene: Scene,
    inside: Splats,
    context: Splats,
    renderer: Renderer,
    uncovered: float,
    exposures: Exposures | None = None,
) -> Scene:
    """Return the scene with what a block learns in the place of its photos, in memory.

    Parameters
    ----------
    scene : with the photos of the block. inside, context : its splats of the model before, and those around it.
    uncovered : the block's part of what no splat covers, 0 to 1.
    exposures : of the photos, by name; a photo without one has the colours of the model.
    """
    whole = joined([inside, context]) if len(context) else inside
    views = []
    for number, stored in enumerate(scene.views, 1):
        activity.report(f"looking at photo {number} of {len(scene.views)}")
        exposure = (exposures or {}).get(stored.name)
        views.append(_target(stored.loaded(), whole, len(inside), scene, renderer, uncovered, exposure))
    return replace(scene, views=views)


def _target(
    view: View,
    whole: Splats,
    n_inside: int,
    scene: Scene,
    renderer: Renderer,
    uncovered: float,
    exposure: NDArray[np.float64] | None,
) -> View:
    part, alpha = block_part(view, whole, n_inside, renderer)
    part = np.clip(part + (1.0 - alpha) * uncovered, 0.0, 1.0)
    shown = renderer.render(whole, view.camera, scene.background)
    color = shown.color if exposure is None else shown.color @ exposure[:, :3].T + exposure[:, 3]
    image = _mix(view.image, np.clip(color, 0.0, 1.0), part[..., None])
    opacity = None if view.alpha is None else _mix(view.alpha, shown.alpha, part)
    return View(view.name, view.camera, image, view.mask, opacity)


def block_part(view: View, whole: Splats, n_inside: int, renderer: Renderer) -> tuple[DoubleArray, DoubleArray]:
    """Return the part of each pixel that the first splats make up, and the opacity of all of them, (H, W), 0 to 1."""
    colors = np.full((len(whole), 1, 3), -0.5 / SH_C0, whole.sh.dtype)  # black, and white for the first ones
    colors[:n_inside] = 0.5 / SH_C0
    marked = whole.with_arrays(whole.to_numpy() | {"sh": colors})
    shown = renderer.render(marked, view.camera)
    return shown.color[..., 0].astype(np.float64), shown.alpha.astype(np.float64)


def _mix(photo: ImageU8, shown: Array, part: DoubleArray) -> ImageU8:
    """Return part * photo + (1 - part) * shown as bytes. shown : 0 to 1."""
    mixed = part * photo + (1.0 - part) * 255.0 * shown
    rounded: ImageU8 = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
    return rounded
