"""The mean of the parameters over the last part of a run (Izmailov et al. 2018, stochastic weight averaging).

Each step follows one photo, so the parameters never come to rest. Their mean is nearer to the optimum of all photos
than the last step is. The mean begins after the last densification, because only then the splats stay the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import InputError
from ..splats.fields import Array
from .config import TrainConfig

SAMPLES = 20  # smallest number of iterations whose parameters are averaged, at equal distances, in long windows


class ParameterAverage:
    """Running mean of the public arrays of the splats.

    Parameters
    ----------
    config : options of the run; `average_last` is the fraction of the run that counts.
    densify_last : last iteration at which the strategy may densify.

    Attributes
    ----------
    count : number of samples so far.
    begin : the iteration after which samples may come. From then on the splats must stay the same ones.
    """

    def __init__(self, config: TrainConfig, densify_last: int) -> None:
        self._last = config.iterations
        window = min(round(config.optim.average_last * self._last), self._last - densify_last)
        self.begin = self._last - window
        self._every = max(window // SAMPLES, 1)
        self._mean: dict[str, Array] = {}
        self.count = 0

    def is_due(self, iteration: int) -> bool:
        """Return whether the parameters after an iteration (from 1) are a sample. Those of the last iteration are."""
        return self.begin < iteration <= self._last and (self._last - iteration) % self._every == 0

    def add(self, arrays: Mapping[str, Array]) -> None:
        """Add a sample. It has the splats of the samples before.

        The arrays belong to the mean afterwards: those of a large model are most of the memory.
        """
        self.count += 1
        for name in arrays:
            values, mean = arrays[name], self._mean.get(name)
            if mean is not None:
                values -= mean
                values /= np.float32(self.count)
                values += mean
            self._mean[name] = values

    def result(self) -> dict[str, Array]:
        """Return the mean of the samples."""
        return dict(self._mean)

    def state(self) -> dict[str, Any]:
        """Return the arrays of a checkpoint, by key; empty without a sample."""
        return {**self._mean, "count": np.array([self.count])} if self.count else {}

    def load_state(self, state: Mapping[str, Any], n: int) -> None:
        """Continue from the arrays of a checkpoint of a run with n splats that change.

        Raises
        ------
        InputError : the arrays are of fewer splats.
        """
        # Earlier versions had means of the splats that do not change, too.
        self._mean = {name: values[:n] for name, values in state.items() if name != "count"}
        if any(len(values) != n for values in self._mean.values()):
            raise InputError("checkpoint: its average is not of the same splats: start with --overwrite")
        self.count = int(state["count"][0]) if state else 0
