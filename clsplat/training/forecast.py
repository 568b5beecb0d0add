"""Time that the rest of a run takes.

Three things change the time of an iteration: the size of the images, the number of splats and the SH degree. The
forecast knows their schedules. It fits the time of an iteration as a sum of four parts with weights that are not
negative: a constant, the pixels, the splats, and the splats' coefficients. The size of the images changes late in a
run, so its effect is measured before: a forward pass at each size, a few times in a run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .schedules import RunSchedule, downscale_for, sh_degree_at

# Weights before anything is measured. The constant is the host's time [s]; of the others only the ratios count.
USUAL_CONSTANT = 1e-3
USUAL_WEIGHTS = np.array([0.0, 1.0, 2.0, 0.04])
TRUST = 0.001  # weight of the usual weights in the fit; all measurements together have 1
FORWARD_SHARE = 3.0  # time of an iteration over the time of its forward pass
FORWARD_TRUST = 0.5  # weight of a forward pass in the fit; a block of iterations has 1
HORIZON = 0.5  # share of the iterations so far over which the weight of a block falls by a factor of e
FIRST_GROWTH = 1.2  # factor of the number of splats per densification before the first one was seen
PROBES = 20  # forward passes at all sizes are measured this often in a run
_MOST_GROWTH = 50.0  # natural logarithm; far above any cap, and far below the largest number
_BLOCKS = 200  # parts of a run whose mean times are kept, and parts of its rest that are added up

Row = NDArray[np.float64]  # the four parts of an iteration


@dataclass(frozen=True)
class RunShape:
    """What is known about a run before it begins.

    Attributes
    ----------
    iterations : length of the run.
    stages : (first iteration, downscale) of the image sizes; see `resolution_schedule`.
    pixels : median of the pixels of the training images at full size.
    cap : largest number of splats.
    max_degree : highest SH degree.
    schedule : schedules of the run.
    densify_interval : iterations between two densifications.
    """

    iterations: int
    stages: list[tuple[int, int]]
    pixels: float
    cap: int
    max_degree: int
    schedule: RunSchedule
    densify_interval: int

    def downscale(self, iteration: int, n_splats: float) -> int:
        """Return the image downscale of an iteration (from 1)."""
        return downscale_for(self.stages, iteration - 1, max(int(n_splats), 1), self.pixels)

    def densifications(self, first: int, last: int) -> int:
        """Return the number of densifications after iteration `first`, up to iteration `last`."""
        start = max(first, self.schedule.densify_first - 1)
        end = min(last, self.schedule.densify_last)
        every = self.densify_interval
        return max(end // every - start // every, 0)

    def parts(self, downscale: int, n_splats: float, iteration: int) -> Row:
        """Return the parts of the time of an iteration: 1, pixels, splats, coefficients of a colour channel."""
        degree = sh_degree_at(iteration, self.schedule.sh_interval, self.max_degree)
        return np.array([1.0, self.pixels / downscale**2, n_splats, n_splats * (degree + 1) ** 2])


@dataclass
class _Block:
    """Some iterations in a row with one image size: their sums of parts and of seconds."""

    downscale: int
    parts: Row
    seconds: float = 0.0
    count: int = 0
    last: int = 0


class Forecast:
    """The time left of a run, from the iterations that were observed.

    Parameters
    ----------
    n_splats : number of splats now.
    iteration : iterations done before.
    """

    def __init__(self, run: RunShape, n_splats: int, iteration: int = 0) -> None:
        self.run, self.n_splats, self.iteration = run, n_splats, iteration
        self._growth = FIRST_GROWTH if run.schedule.growth == 1 else run.schedule.growth
        self._blocks: list[_Block] = []
        self._forward: dict[int, tuple[Row, float]] = {}  # parts and seconds of a forward pass by downscale

    def is_probe_due(self, iteration: int) -> bool:
        """Return whether forward passes are to be measured before this iteration (from 1)."""
        every = max(self.run.iterations // PROBES, 1)
        return self.run.downscale(iteration, self.n_splats) > 1 and (iteration - 1) % every == 0

    def downscales(self, iteration: int) -> list[int]:
        """Return the present image downscale and the later ones."""
        now = self.run.downscale(iteration, self.n_splats)
        return [now, *sorted({downscale for _, downscale in self.run.stages if downscale < now}, reverse=True)]

    def probe(self, forward: Mapping[int, float]) -> None:
        """Take the seconds of a forward pass by image downscale."""
        for downscale, seconds in forward.items():
            parts = self.run.parts(downscale, self.n_splats, self.iteration + 1)
            if downscale in self._forward:  # one pass may take half more than the next: their mean is steadier
                before, taken = self._forward[downscale]
                parts, seconds = (before + parts) / 2, (taken + seconds) / 2
            self._forward[downscale] = parts, seconds

    def observe(self, iteration: int, n_splats: int, seconds: float) -> None:
        """Take the time of an iteration (from 1). n_splats : number of splats after it."""
        downscale = self.run.downscale(iteration, self.n_splats)
        full = max(self.run.iterations // _BLOCKS, 5)
        if not self._blocks or self._blocks[-1].count >= full or self._blocks[-1].downscale != downscale:
            self._blocks.append(_Block(downscale, np.zeros(4)))
        block = self._blocks[-1]
        block.parts += self.run.parts(downscale, self.n_splats, iteration)
        block.seconds, block.count, block.last = block.seconds + seconds, block.count + 1, iteration
        if self.run.densifications(iteration - 1, iteration):
            self._growth = max(n_splats / max(self.n_splats, 1), 1.0)
        self.iteration, self.n_splats = iteration, n_splats

    def seconds_left(self) -> float | None:
        """Return the time that the rest of the run takes [s], or None if nothing was measured yet."""
        weights = self._weights()
        if weights is None:
            return None
        run, total = self.run, 0.0
        step = max((run.iterations - self.iteration) // _BLOCKS, 1)
        n_splats, now = float(self.n_splats), self.iteration
        while now < run.iterations:
            following = min(now + step, run.iterations)
            actions = run.densifications(now, following)
            grown = n_splats * math.exp(min(actions * math.log(self._growth), _MOST_GROWTH))
            n_splats = max(min(grown, run.cap), n_splats)
            parts = run.parts(run.downscale(following, n_splats), n_splats, following)
            total += (following - now) * float(parts @ weights)
            now = following
        return total

    def _weights(self) -> Row | None:
        """Return the seconds of each part, fitted to what was measured."""
        from scipy.optimize import nnls  # imported late: slow to import

        rows: list[Row] = []
        trust: list[float] = []
        reach = max(HORIZON * self.iteration, 1.0)
        for block in self._blocks:
            rows.append(block.parts / max(block.seconds, 1e-12))
            trust.append(block.count * math.exp((block.last - self.iteration) / reach))
        passes = self._scaled_passes()
        weight = FORWARD_TRUST * (sum(trust) or 1.0)
        for parts, seconds in passes:
            rows.append(parts / max(seconds, 1e-12))
            trust.append(weight / len(passes))
        if not rows:
            return None
        # All rows say: parts @ weights = 1. The errors are relative, so that slow iterations do not hide fast ones.
        table, shares = np.array(rows), np.array(trust) / sum(trust)
        constant = min(USUAL_CONSTANT, 0.8 / table[:, 0].max())
        scale = np.average(1 - constant * table[:, 0], weights=shares) / np.average(
            table @ USUAL_WEIGHTS, weights=shares
        )
        usual = USUAL_WEIGHTS * scale
        usual[0] = constant
        root = np.sqrt(shares)[:, None]
        table = np.vstack([table * root, math.sqrt(TRUST) * np.diag(1 / usual)])
        targets = np.concatenate([root[:, 0], np.full(4, math.sqrt(TRUST))])
        # The columns are scaled to one size, because their units differ by many orders of magnitude.
        return nnls(table * usual, targets)[0] * usual

    def _scaled_passes(self) -> list[tuple[Row, float]]:
        """Return parts and seconds of iterations at image sizes that are still to come, from their forward passes."""
        if not self._blocks:
            return [(parts, FORWARD_SHARE * seconds) for parts, seconds in self._forward.values()]
        now = self._blocks[-1].downscale
        if now not in self._forward:
            return []
        recent = [block for block in self._blocks[-10:] if block.downscale == now]
        ratio = sum(block.seconds for block in recent) / sum(block.count for block in recent) / self._forward[now][1]
        return [(parts, ratio * seconds) for downscale, (parts, seconds) in self._forward.items() if downscale < now]
