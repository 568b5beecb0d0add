"""Training views in random order without repetition, coarse to fine."""

from __future__ import annotations

import statistics
from collections.abc import Collection

import numpy as np

from ..errors import InputError
from ..scenes.scene import View
from .schedules import downscale_for, resolution_schedule


class ViewSampler:
    """Training views in random order: one random permutation of the views after another.

    Parameters
    ----------
    iterations : length of the run.
    coarse_to_fine : whether the first images are smaller.
    queue : rest of the permutation of a resumed run.
    largest_downscale : limit of the downscales, of a run that was made longer.
    left_out : indices of views that are not sampled.

    Attributes
    ----------
    stages : (first iteration, downscale) of the image sizes.
    pixels : median of the pixels of the views.
    """

    def __init__(
        self,
        views: list[View],
        iterations: int,
        coarse_to_fine: bool,
        rng: np.random.Generator,
        queue: list[int],
        largest_downscale: int | None = None,
        left_out: Collection[int] = (),
    ) -> None:
        if any(not 0 <= view < len(views) for view in (*queue, *left_out)) or len(set(left_out)) >= len(views):
            raise InputError(f"the checkpoint is of a scene with other photos than these {len(views)}: start a new run")
        self.views, self.rng, self.queue, self.left_out = views, rng, list(queue), frozenset(left_out)
        side = min(min(view.camera.width, view.camera.height) for view in views)
        self.pixels = statistics.median(view.camera.width * view.camera.height for view in views)
        stages = resolution_schedule(iterations, image_side=side) if coarse_to_fine else [(0, 1)]
        self.stages = [(first, min(downscale, largest_downscale or downscale)) for first, downscale in stages]

    def next(self, iteration: int, n_splats: int) -> tuple[int, int]:
        """Return the index of the view of an iteration (from 1), and the downscale of its image for `n_splats`."""
        while True:
            if not self.queue:
                self.queue = self.rng.permutation(len(self.views)).tolist()
            view = self.queue.pop()
            if view not in self.left_out:
                return view, self.downscale(iteration, n_splats)

    def downscale(self, iteration: int, n_splats: int) -> int:
        """Return the downscale of the image of an iteration (from 1)."""
        return downscale_for(self.stages, iteration - 1, n_splats, self.pixels)
