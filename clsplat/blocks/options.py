"""Options of the run of a block: its share of the cap, and the values that all blocks and the polish have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..training.config import TrainConfig
from ..training.options.density import Adc

# A block goes on from a model: no random points, no penalties, images at full size.
_COARSE_ONLY = {
    "strategy": Adc.strategy,
    "lr_factor": 1.0,
    "opacity_reg": 0.0,
    "scale_reg": 0.0,
    "noise_lr": 0.0,
    "visible_adam": False,
    "coarse_to_fine": False,
    "sh_interval": 1,  # the coarse model has all bands
    "opacity_reset": 0,
    "bisect_reg": 0.0,
    "position_optimizer": "adam",
    "optimizer": "fused",
}
_OF_THE_START = {"random_points": 0.0, "outlier_check": False}  # the coarse run has them for all


def block_config(config: TrainConfig, start: Path, cap: int) -> TrainConfig:
    """Return the options of a run that goes on from a model.

    Parameters
    ----------
    config : complete options of the whole training. start : file of the model. cap : largest number of splats.
    """
    return TrainConfig(**config.to_json() | _COARSE_ONLY | _OF_THE_START | {"init": str(start), "cap_max": cap})


def of_coarse_run(config: TrainConfig) -> list[str]:
    """Return the options that the caller named and that only the coarse run has, in the order of their names."""
    return sorted(name for name, value in _COARSE_ONLY.items() if config.named_options.get(name, value) != value)


def shares_of_cap(cap: int, counts: Sequence[int]) -> list[int]:
    """Return the cap of each block. Together they are at most `cap`, and equal, but for blocks that begin with more.

    Parameters
    ----------
    cap : at least the sum of `counts`. counts : first splats of each block, which it keeps.
    """
    equal, rest, left = 0, cap, len(counts)
    for count in sorted(counts, reverse=True):  # the largest keep what they have, until the others can have as much
        equal = rest // left
        if count <= equal:
            break
        rest, left = rest - count, left - 1
    return [max(count, equal) for count in counts]
