"""Changes of the splats after optimizer steps: densification, and the exploration noise of 3DGS-MCMC."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...device.program import lane_group
from ...errors import TrainingError
from ...rendering.build import KernelBuild
from ...rendering.splat_buffers import SplatBuffers, SplatStatistics
from ..config import TrainConfig
from ..methods.sns import learning_groups
from ..optim.noise import noise_amount, noise_reach
from ..optim.optimizer import Optimizer
from ..programs import columns_program, optim_program
from ..schedules import RunSchedule
from .edit import DensifyEdit
from .on_device import DeviceSplats
from .strategy import StepInfo, next_edit


class DensityControl:
    """The densification strategy of a run, applied to its splats.

    Parameters
    ----------
    statistics : gradient statistics of the splats since the last densification.
    rng : generator of the run.
    extent : extent of the scene [world units].
    photos : number of training photos.
    """

    def __init__(
        self,
        config: TrainConfig,
        kernels: KernelBuild,
        schedule: RunSchedule,
        splats: SplatBuffers,
        optimizer: Optimizer,
        statistics: SplatStatistics,
        rng: np.random.Generator,
        extent: float,
        photos: int,
    ) -> None:
        self.config, self.schedule, self.splats, self.optimizer = config, schedule, splats, optimizer
        self.statistics, self.rng, self.extent = statistics, rng, extent
        self.kernels, self.photos = kernels, photos
        self._empty = 0  # photos in a row that showed no splat, up to the last densification

    def is_due(self, iteration: int) -> bool:
        """Whether the strategy densifies after this iteration."""
        first, last = self.schedule.densify_first, self.schedule.densify_last
        return first <= iteration <= last and iteration % self.config.densify_every == 0

    def densify(self, iteration: int) -> None:
        """Add, move and remove splats, and set the statistics to zero. Without a visible splat, nothing is done.

        Raises
        ------
        TrainingError : no photo of all of them showed a splat, or no splat is finite.
        """
        info = StepInfo(iteration, self.schedule.densify_last, self.schedule.growth, self.extent)
        self.optimizer.settle()
        statistics = self.statistics.read(self.splats.n)
        if self.splats.n and not statistics[SplatStatistics.TIMES_SEEN].any():
            self._empty += self.config.densify_every * self.config.schedule.batch
            if self._empty < self.photos:
                return
            raise TrainingError(
                f"iteration {iteration}: no image shows any splat (transparent, or outside of all images): "
                "check the start (init) and the learning rates"
            )
        self._empty = 0
        table = DeviceSplats(self.splats, columns_program(self.splats.device, self.kernels))
        edit = next_edit(self.config, table, statistics[:, : self.splats.n_live], self.rng, info)
        self.optimizer.apply(self.optimizer.arranged(edit))
        self.statistics.reset()

    def remove(self, gone: NDArray[np.bool_]) -> None:
        """Remove splats. gone : (N,). The statistics of the others stay. Frozen splats are never removed."""
        frozen = np.arange(self.splats.n_live, self.splats.n)
        gone = gone[: self.splats.n_live]
        if not gone.any() or gone.all():
            return
        self.optimizer.settle()
        kept, statistics = np.flatnonzero(~gone), self.statistics.read(self.splats.n)
        fresh = np.zeros(len(kept), np.bool_)
        edit = self.optimizer.arranged(DensifyEdit(kept, {}, fresh, state_source=kept, removed=int(gone.sum())))
        self.optimizer.apply(edit)
        self.statistics.write(statistics[:, np.concatenate([edit.source, frozen])], self.splats.capacity)


class ExplorationNoise:
    """The noise of 3DGS-MCMC: random moves of nearly transparent splats after each step of the base parameters."""

    def __init__(self, config: TrainConfig, kernels: KernelBuild, splats: SplatBuffers, extent: float) -> None:
        self.config, self.kernels, self.splats, self.extent = config, kernels, splats, extent
        self.program = optim_program(splats.device, kernels)

    def add(self, iteration: int, mean_lr: float) -> None:
        """Add the noise of one iteration. mean_lr : rate of the positions, with the scene extent [world units]."""
        config = self.config
        if not config.density.noise_lr or not learning_groups(iteration, config).base:
            return
        self.program.mcmc_noise.over(
            -(-self.splats.n // self.kernels.lanes),
            lane_group(self.splats.device),
            geom=self.splats.geom,
            capacity=self.splats.capacity,
            n_splats=self.splats.n,
            seed_lo=config.seed & 0xFFFFFFFF,
            seed_hi=config.seed >> 32,
            iteration=iteration,
            amount=noise_amount(config.density.noise_lr, mean_lr, self.extent),
            reach=noise_reach(self.extent),
        )
