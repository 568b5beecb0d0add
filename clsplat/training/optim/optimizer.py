"""Optimizers over splats on the device: the fused kernels, and the NumPy reference with the same interface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from numpy.typing import NDArray

from ...device.device import Device
from ...rendering.build import KernelBuild
from ...rendering.splat_buffers import CompactGradients, SplatBuffers
from ...splats.fields import Array
from ..config import TrainConfig
from ..density.edit import DensifyEdit
from .fused import FusedOptimizer
from .lazy import VisibleOptimizer
from .lazy_reference import VisibleReferenceOptimizer
from .reference import ReferenceOptimizer
from .rules import Rules


class Optimizer(Protocol):
    """The optimizer of the splats. It holds their moments, their momentum and the trainable skew s.

    Positions move by Adam or SGHMC (sghmc.py). Fields with bounds move by Adam in log space. The skew moves by Adam on
    s; the splats hold the skew of the kernel, which follows from s (skew_map.py). All other fields move by Adam. A
    frozen parameter group keeps its values, moments and step count.
    """

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        """Step all splats, or with `visible_adam` the visible ones (lazy.py). The regularisers are included.

        Parameters
        ----------
        grads : gradients of the stored parameters; the optimizer may change them.
        mean_lr : Adam's rate of the means at this iteration, with scene extent and rate factor [world units].
        sh_degree : highest SH band that changes.
        iteration : counts from 1. The parameter groups that learn and the noise depend on it.
        depth_key : depth keys of the image that the gradients belong to (cl/render/project.cl); required with
            `visible_adam`.
        """

    def settle(self) -> None:
        """Do all skipped steps, so that the buffers hold the values that `read` returns."""

    def arranged(self, edit: DensifyEdit) -> DensifyEdit:
        """Return the edit with its rows in the best order for this optimizer. Call `settle` before."""

    def read(self) -> Mapping[str, Array]:
        """Return the public arrays of the splats that change, with all skipped steps done; the state does not change.

        They are copies. Those on the device are read when they are asked for, which must be before the next step.
        """

    def apply(self, edit: DensifyEdit) -> None:
        """Settle, then move, add, remove and reset splats. The edit is one of those that change."""

    def state(self) -> Mapping[str, NDArray[Any]]:
        """Return the state for a checkpoint, without the splats. Both optimizers use the same keys.

        Arrays on the device are read when they are asked for, which must be before the next step.
        """

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from `state`. Raise InputError if an entry is missing, unknown, or of another shape."""


def make_optimizer(
    device: Device, kernels: KernelBuild, splats: SplatBuffers, config: TrainConfig, extent: float
) -> Optimizer:
    """Return the optimizer that the config names. extent : extent of the scene [world units]."""
    rules = Rules(config, extent)
    if config.optim.optimizer == "fused":
        return (VisibleOptimizer if config.optim.visible_adam else FusedOptimizer)(device, kernels, splats, rules)
    if config.optim.visible_adam:
        return VisibleReferenceOptimizer(splats, rules, kernels.lanes)
    return ReferenceOptimizer(splats, rules)
