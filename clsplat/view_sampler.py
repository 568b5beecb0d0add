"""Training views in random order without repetition, coarse to fine."""

from __future__ import annotations

import numpy as np

from .camera import Camera
from .images import ImageU8, resize_area
from .scene import View
from .schedules import downscale_at, resolution_schedule


class ViewSampler:
    """Draws from `rng`, one permutation of the views after another.

    Parameters
    ----------
    iterations : length of the run. coarse_to_fine : False: full size throughout.
    queue : what is left of a permutation, of a resumed run.
    """

    def __init__(self, views: list[View], iterations: int, coarse_to_fine: bool, rng: np.random.Generator,
                 queue: list[int]) -> None:
        self.views, self.rng, self.queue = views, rng, list(queue)
        side = min(min(view.camera.width, view.camera.height) for view in views)
        self.stages = resolution_schedule(iterations, image_side=side) if coarse_to_fine else [(0, 1)]
        self._downscale = 0
        self._cache: dict[int, tuple[Camera, ImageU8]] = {}

    def next(self, iteration: int) -> tuple[Camera, ImageU8]:
        """The view of an iteration (from 1), at that iteration's size."""
        if not self.queue:
            self.queue = self.rng.permutation(len(self.views)).tolist()
        index = self.queue.pop()
        downscale = downscale_at(self.stages, iteration - 1)
        if downscale != self._downscale:
            self._downscale, self._cache = downscale, {}
        if index not in self._cache:
            view = self.views[index]
            self._cache[index] = (view.camera, view.image) if downscale == 1 else reduced(view, downscale)
        return self._cache[index]


def reduced(view: View, downscale: int) -> tuple[Camera, ImageU8]:
    """A view at 1/downscale of its size."""
    width, height = max(view.camera.width // downscale, 1), max(view.camera.height // downscale, 1)
    return view.camera.resized(width, height), resize_area(view.image, width, height)
