"""Dropout of splats: in each iteration a random part of the splats is not drawn, and so not trained.

With few photos, a run makes splats that fit a single photo between that camera and the scene. If the splats before them
are missing at times, splats further back must show the photo too, so they learn the scene (Park et al. 2025,
"DropGaussian"). Other than there, the opacities of the drawn splats are not raised: the last part of the run has all
splats, and fits them to each other.
"""

from __future__ import annotations

from collections.abc import Callable

from ..device.program import lane_group
from ..rendering.frame import ProjectedSplats
from ..rendering.splat_buffers import SplatBuffers
from .config import TrainConfig
from .programs import dropout_program

UNTIL = 0.9  # fraction of the run after which all splats are drawn
_WORDS = 2**32


class SplatDropout:
    """The splats that are hidden in each iteration of a run: those whose random word is below a part of all words.

    The words are those of Philox (optim/noise.py), so they depend on seed, iteration and splat only.
    """

    def __init__(self, config: TrainConfig, splats: SplatBuffers) -> None:
        self.rate, self.seed = config.views.dropout, config.seed
        self.last = int(UNTIL * config.iterations) if self.rate else 0
        self.group = lane_group(splats.device)
        self.program = dropout_program(splats.device) if self.rate else None

    def of(self, iteration: int) -> Callable[[ProjectedSplats], None] | None:
        """Return what hides splats in an iteration; None if all are drawn."""
        program = self.program
        if program is None or iteration > self.last:
            return None

        def hide(projected: ProjectedSplats) -> None:
            program.drop_splats.over(
                projected.n,
                self.group,
                depth_key=projected.depth_key,
                tile_rect=projected.tile_rect,
                n=projected.n,
                seed_lo=self.seed & 0xFFFFFFFF,
                seed_hi=self.seed >> 32,
                iteration=iteration,
                below=int(self.rate * _WORDS),
            )

        return hide
