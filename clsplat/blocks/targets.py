"""What a block learns from its photos: its own part of them, while the rest stays as the model before shows it.

Several blocks are visible in one pixel, and all would correct the same error. So the photo counts for a block as far as
its splats make up the pixel. Let w be the block's part of the pixel, I the photo and C the picture of the model before.
The block learns w I + (1 - w) C. The parts of all blocks sum to 1, so their corrections sum to I - C. Outside of its
pixels a block learns to change nothing. With exposures, C is the picture with the exposure of the photo. This is a
partition of unity, as in additive Schwarz methods.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from .. import activity
from ..files.host_memory import give_back_free_memory
from ..files.images import ImageU8
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene, View
from ..scenes.view import StoredView
from ..splats.color import Color
from ..splats.fields import Array, DoubleArray
from ..splats.harmonics import SH_C0
from ..splats.splats import Splats
from ..splats.transform import joined
from ..training.exposure_file import Exposures


class BlockTargets:
    """The pictures that a block learns from.

    Parameters
    ----------
    inside, context : its splats of the model before, and those around it.
    renderer : should keep two models on its device (`Renderer.keep`), because each picture needs two.
    background : of the run. uncovered : the block's part of what no splat covers, 0 to 1.
    exposures : of the photos, by name; a photo without one has the colours of the model.
    """

    def __init__(
        self,
        inside: Splats,
        context: Splats,
        renderer: Renderer,
        background: Color,
        uncovered: float,
        exposures: Exposures | None = None,
    ) -> None:
        self.inside, self.renderer, self.background, self.uncovered = inside, renderer, background, uncovered
        self.whole = joined([inside, context]) if len(context) else inside
        colors = np.full((len(self.whole), 1, 3), -0.5 / SH_C0, self.whole.sh.dtype)  # black, and white for the first
        colors[: len(inside)] = 0.5 / SH_C0
        self._marked = self.whole.with_arrays(self.whole.to_numpy() | {"sh": colors})
        self.exposures = exposures or {}

    def of(self, view: View) -> View:
        """Return the view with what the block learns in the place of its photo."""
        view = view.loaded()
        part, alpha = self.part(view)
        part = np.clip(part + (1.0 - alpha) * self.uncovered, 0.0, 1.0)
        shown = self.renderer.render(self.whole, view.camera, self.background)
        exposure = self.exposures.get(view.name)
        color = shown.color if exposure is None else shown.color @ exposure[:, :3].T + exposure[:, 3]
        image = _mix(view.image, np.clip(color, 0.0, 1.0), part[..., None])
        opacity = None if view.alpha is None else _mix(view.alpha, shown.alpha, part)
        return View(view.name, view.camera, image, view.mask, opacity)

    def part(self, view: View) -> tuple[DoubleArray, DoubleArray]:
        """Return the block's part of each pixel, and the opacity of all splats, (H, W), 0 to 1."""
        shown = self.renderer.render(self._marked, view.camera)
        return shown.color[..., 0].astype(np.float64), shown.alpha.astype(np.float64)


def with_block_targets(scene: Scene, make: Callable[[], BlockTargets]) -> Scene:
    """Return the scene with what a block learns in the place of its photos, in memory.

    A run may give these pictures up, once its device has them. If it needs one again, it is made again.

    Parameters
    ----------
    scene : with the photos of the block.
    make : returns the targets, whose splats and renderer stay in memory only while they are in use.
    """
    targets, views = make(), list[View]()
    for number, photo in enumerate(scene.views, 1):
        activity.report(f"looking at photo {number} of {len(scene.views)}")
        kept = targets.of(photo)
        again = partial(_made_again, make, photo)
        views.append(StoredView(kept.name, kept.camera, again, kept=kept, may_hide_pixels=kept.mask is not None))
    del targets
    give_back_free_memory()
    return replace(scene, views=views)


def _made_again(make: Callable[[], BlockTargets], photo: View) -> View:
    return make().of(photo)


def _mix(photo: ImageU8, shown: Array, part: DoubleArray) -> ImageU8:
    """Return part * photo + (1 - part) * shown as bytes. shown : 0 to 1."""
    mixed = part * photo + (1.0 - part) * 255.0 * shown
    rounded: ImageU8 = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
    return rounded
