"""Splats that a run shows but does not change: what lies around the part of a scene that it learns.

They are the last ones of the model on the device. Their gradients are set to zero before each step. The moments of Adam
stay zero, too, so that it does not move them. Strategies see only the splats before them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..device.memory import to_device
from ..errors import InputError, Remedy
from ..rendering.build import KernelBuild
from ..rendering.splat_buffers import CompactGradients, SplatBuffers
from ..splats.fields import Array, Group
from ..splats.low_pass import LOW_PASS
from ..splats.splats import Splats
from .checkpoint import Checkpoint, UnusableCheckpoint
from .columns import Columns
from .config import TrainConfig
from .density.edit import DensifyEdit, Indices
from .density.table import SplatTable, Summary
from .options.density import Adc
from .programs import columns_program


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


class FrozenSplats:
    """The splats of a run that do not change, on its device.

    Parameters
    ----------
    count : their number; they are the last ones of `splats`.
    """

    def __init__(self, kernels: KernelBuild, splats: SplatBuffers, count: int) -> None:
        self.splats, self.count = splats, count
        self._columns = Columns(splats.device, columns_program(splats.device, kernels), splats.capacity, splats.dtype)
        self._marks = splats.device.alloc(max(splats.capacity, 1))
        self._marked = -1  # number of splats when the marks were written

    @property
    def n_live(self) -> int:
        """Number of splats that change."""
        return self.splats.n - self.count

    def clear(self, grads: CompactGradients) -> None:
        """Set the gradients of the frozen splats to zero."""
        n = self.splats.n
        if self._marked != n:
            marks = np.zeros(n, np.uint8)
            marks[self.n_live :] = 1
            to_device(self.splats.device, self._marks, marks)
            self._marked = n
        self._columns.zero(grads.geom, self._marks, n, self.splats.schema.rows(Group.GEOM))
        self._columns.zero(grads.sh, self._marks, n, grads.schema.rows(Group.SH))

    def with_frozen(self, edit: DensifyEdit) -> DensifyEdit:
        """Return an edit of the splats that change as one of all splats."""
        moved = edit.permuted(np.arange(len(edit.source)), self.n_live)  # now it names where all states come from
        frozen = np.arange(self.n_live, self.splats.n)
        assert moved.state_source is not None
        return replace(
            moved,
            source=np.concatenate([moved.source, frozen]),
            fresh=np.concatenate([moved.fresh, np.zeros(self.count, np.bool_)]),
            state_source=np.concatenate([moved.state_source, frozen]),
        )


class LiveSplats:
    """The first `n` splats of a table: those that a strategy may change."""

    def __init__(self, table: SplatTable, n: int) -> None:
        self.table, self.n = table, n

    def summary(self) -> Summary:
        whole = self.table.summary()
        return Summary(whole.log_size[: self.n], whole.raw_opacity[: self.n])

    def take(self, rows: Indices) -> dict[str, Array]:
        return self.table.take(rows)

    def field(self, name: str) -> Array:
        return self.table.field(name)[: self.n]
