"""Splats that a run shows but does not change: what lies around the part of a scene that it learns.

They are the last ones of the model on the device (`SplatBuffers.n_frozen`). The optimizer steps and strategies see only
the splats before them, and only these have moments.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError, Remedy
from ..splats.low_pass import LOW_PASS
from ..splats.splats import Splats
from .checkpoint import Checkpoint, UnusableCheckpoint
from .config import TrainConfig
from .options.density import Adc


def context_of(context: Splats | Path | None) -> Splats | None:
    """Return the splats of a context, which may be a file of them; None if there are none."""
    splats = Splats.load(context) if isinstance(context, Path) else context
    return splats if splats is not None and len(splats) else None


def check_context(context: Splats | None, config: TrainConfig, checkpoint: Checkpoint | None = None) -> None:
    """Raise InputError if a run with these options cannot leave the splats of `context` as they are.

    checkpoint : that the run goes on from; its last splats must be those of the context, else UnusableCheckpoint.
    """
    if context is None:
        return
    if checkpoint is not None:
        stored = checkpoint.splats["mean"]
        if not np.array_equal(stored[len(stored) - len(context) :], context.mean):
            same = Remedy("resume with the same one, or start a new run")
            raise UnusableCheckpoint("the context is not that of the checkpoint", same)
    if config.strategy != Adc.strategy or config.optim.optimizer != "fused" or config.optim.visible_adam:
        raise InputError("a context needs the strategy adc and steps of all splats on the device")
    if config.sghmc.position_optimizer != "adam" or config.density.noise_lr:
        raise InputError("a context needs Adam for positions, without noise")
    resets = isinstance(config.density, Adc) and config.density.opacity_reset
    if config.density.opacity_reg or config.density.scale_reg or config.loss.bisect_reg or resets:
        raise InputError("a context needs a run without penalties and without opacity resets")
    low_pass = config.low_pass or LOW_PASS
    kind = (context.shape, context.sh_degree, context.normalisation, context.antialiased, context.low_pass)
    if kind != (config.shape, config.sh_degree, config.normalisation, bool(config.antialiased), low_pass):
        raise InputError("the context has another shape, SH degree, normalisation or low pass than the run")
