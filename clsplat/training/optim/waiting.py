"""Which vectors of splats wait for a step, on the device (cl/train/lazy.cl)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...device.memory import send_to_device, to_device, to_host
from ...device.program import GROUP_ITEMS
from ...rendering.build import KernelBuild
from ...rendering.splat_buffers import SplatBuffers
from ..alternation import Blocks
from ..programs import optim_program
from .lazy import Drifts, Steps


class Waiting:
    """The counts of steps that each vector was last brought up to, and the tables that bring it further.

    Attributes
    ----------
    ages, table : buffers of the last `wake`: `ages` and `waits` of cl/train/optim.cl.
    """

    def __init__(self, splats: SplatBuffers, kernels: KernelBuild) -> None:
        self.splats, self.lanes = splats, kernels.lanes
        self.device, self.program = splats.device, optim_program(splats.device, kernels)
        self.drifts = Drifts()
        self._capacity = splats.capacity // kernels.lanes
        self.ages, self._last = (self.device.alloc(8 * self._capacity) for _ in range(2))
        self.table = self.device.alloc(self._table().nbytes)
        self.none_waits((0, 0))

    def wake(self, steps: Steps, blocks: Blocks | None = None, depth_key: Any = None, peeks: bool = False) -> None:
        """Find the vectors that step now: they count as stepped once more in the blocks that learn.

        Parameters
        ----------
        steps : before this step.
        blocks : that learn; None: no step follows, and all are woken.
        depth_key : of the image that the gradients belong to (cl/render/project.cl).
        peeks : they count as waiting still.
        """
        everyone, blocks = blocks is None, blocks or Blocks(False, False)
        self._sent = send_to_device(self.device, self.table, self._table())  # kept: letting go waits
        self.program.wake_vectors(
            (-(-self._capacity // GROUP_ITEMS) * GROUP_ITEMS,),
            (GROUP_ITEMS,),
            last=self._last,
            ages=self.ages,
            depth_key=self._last if everyone else depth_key,
            vectors=self._capacity,
            n_splats=self.splats.n,
            base_steps=steps[0],
            skew_steps=steps[1],
            base_learns=int(blocks.base),
            skew_learns=int(blocks.skew),
            all=int(everyone),
            peeks=int(peeks),
        )

    def none_waits(self, steps: Steps) -> None:
        """All vectors are up to date, whatever splats they now hold."""
        to_device(self.device, self._last, np.repeat(np.array(steps, np.uint32), self._capacity))

    def state(self) -> dict[str, NDArray[Any]]:
        """For a checkpoint: (2, V) counts of the vectors in use, and the sums of drifts."""
        last = to_host(self.device, self._last, np.empty((2, self._capacity), np.uint32))
        return {"waiting.last": last[:, : self._used].copy(), "waiting.drifts": self.drifts.sums.copy()}

    def load_state(self, state: dict[str, NDArray[Any]], steps: Steps) -> None:
        """Go on from `state`, to which these counts of steps belong."""
        self.drifts.sums = state["waiting.drifts"].copy()
        last = np.repeat(np.array(steps, np.uint32)[:, None], self._capacity, axis=1)
        last[:, : self._used] = state["waiting.last"]
        to_device(self.device, self._last, last)

    @property
    def _used(self) -> int:
        return -(-self.splats.n // self.lanes)

    def _table(self) -> NDArray[np.floating]:
        return self.drifts.table.astype(self.splats.dtype)
