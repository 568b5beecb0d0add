"""Splats that stand before the scene in views between the photos, and that no photo shows as large.

With few photos, a splat near the cameras can be at the edge of each photo, or in its sky. It can cover the whole
picture of a camera between them. No photo corrects it. So cameras between those of neighbouring photos look at the
splats now and then. A splat goes if one of them shows it much larger than any photo does.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from ..cameras.between import between
from ..evaluation.contributions import shares_of_images
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.splats import Splats
from .config import TrainConfig
from .density.control import DensityControl

CHECKS = 10  # the run has a check after each tenth, except the last one
LONGEST = 200  # longest side of the images [px]
LARGER = 5.0  # times what any photo shows of a splat
LEAST = 0.002  # part of an image; smaller splats stay


class OccluderCheck:
    """The checks of a run: when they are due, and which splats go.

    Parameters
    ----------
    views : the training views.
    density : removes the splats.
    last : the last iteration that may remove splats.
    """

    def __init__(
        self, config: TrainConfig, views: Sequence[View], renderer: Renderer, density: DensityControl, last: int
    ) -> None:
        self.renderer, self.density = renderer, density
        cameras = [view.camera for view in views] if config.views.occluder_check else []
        self.photos = [camera.at_most(LONGEST) for camera in cameras]
        self.between = between(self.photos)
        self.every = max(config.iterations // CHECKS, 1)
        self.last = min(config.iterations * (CHECKS - 1) // CHECKS, last)

    def is_due(self, iteration: int) -> bool:
        """Whether a check follows this iteration."""
        return bool(self.between) and iteration % self.every == 0 and iteration <= self.last

    def remove(self, splats: Splats) -> None:
        """Remove the occluders. splats : the finite ones; if there are others, a densification removes them first."""
        if len(splats) == self.density.splats.n:
            self.density.remove(self.occluders(splats))

    def occluders(self, splats: Splats) -> NDArray[np.bool_]:
        """Return which splats cover much of a view between the photos, (N,)."""
        shown, covering = (
            reduce(np.maximum, shares_of_images(self.renderer, splats, cameras), np.zeros(len(splats)))
            for cameras in (self.photos, self.between)
        )
        found: NDArray[np.bool_] = (covering > LEAST) & (covering > LARGER * shown)
        return found
