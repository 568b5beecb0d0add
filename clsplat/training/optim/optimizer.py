"""Optimizers over splats on the device: the fused kernels, and NumPy's reference behind the same face."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from ...device.device import Device
from ...rendering.build import KernelBuild
from ...rendering.splat_buffers import CompactGradients, SplatBuffers
from ...splats.fields import Array
from ..config import TrainConfig
from ..density.edit import DensifyEdit
from .fused import FusedOptimizer
from .reference import HostOptimizer
from .rules import Rules


class Optimizer(Protocol):
    """Steps the splats; owns moments, momentum and the trainable skew s, of which the splats hold the kernel's.

    Positions move by Adam or SGHMC (sghmc.py), fields with bounds by Adam on their logarithm, the skew by Adam on s
    (skew_map.py), all else by Adam. A block that does not learn (blocks.py) keeps values, moments and step count.
    """

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        """One step on all splats, or with `visible_adam` on those seen (optim_lazy.py); regularisers included.

        Parameters
        ----------
        grads : of the stored parameters; the optimizer may change them.
        mean_lr : Adam's rate of the means at this iteration, scene extent and rate factor included [world units].
        sh_degree : SH bands above it stay.
        iteration : from 1; decides which blocks learn, and the noise.
        depth_key : buffer (cl/render/project.cl) of the image that the gradients belong to; with `visible_adam` only.
        """

    def settle(self) -> None:
        """Do all steps that splats sat out, so that the buffers hold what `read` returns."""

    def read(self) -> dict[str, Array]:
        """Public arrays of the splats, without anything pending; what is pending stays so."""

    def apply(self, edit: DensifyEdit) -> None:
        """Move, add, remove and reset splats as edited, from what they are once settled."""

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything but the buffers' splats, for a checkpoint; the same keys from both optimizers."""

    def load_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from `state`; raises InputError when an entry is missing or unknown."""


def make_optimizer(
    device: Device, kernels: KernelBuild, splats: SplatBuffers, config: TrainConfig, extent: float
) -> Optimizer:
    """The optimizer that the config names; `extent` of the scene [world units]."""
    rules = Rules(config, extent)
    if config.optim.optimizer == "fused":
        return FusedOptimizer(device, kernels, splats, rules)
    return HostOptimizer(splats, rules, kernels.lanes)
