"""Adam's moments of all parameters on the device, those of colours in 32 or in 16 bits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...device.device import Device
from ...device.opencl import Buffer
from ...device.pending_arrays import PendingArrays
from ...rendering.splat_buffers import ParameterBuffers
from ...splats.fields import Array, Group, Schema

Words = NDArray[np.uint32]


def packed(first: Array, second: Array) -> Words:
    """Return words with the first moment in the upper half and the second in the lower half, as cl/train/adam.clh.

    Each is rounded to the nearest bfloat16. What `unpacked` returns is packed to the same words.
    """
    upper, lower = (array.astype(np.float32).view(np.uint32) + np.uint32(0x8000) for array in (first, second))
    return (upper & np.uint32(0xFFFF0000)) | (lower >> np.uint32(16))


def unpacked(words: Words) -> tuple[Array, Array]:
    """Return the first and the second moments of words."""
    return (words & np.uint32(0xFFFF0000)).view(np.float32), (words << np.uint32(16)).view(np.float32)


class AdamMoments:
    """Both moments of every parameter, in buffers [rows, capacity]; zero at first.

    Parameters
    ----------
    half : whether the moments of colours have 16 bits. Then a word of the buffer holds both of a coefficient.
    """

    def __init__(
        self, device: Device, schema: Schema, capacity: int, dtype: np.dtype[np.floating], half: bool = False
    ) -> None:
        self.half = half
        self.first = ParameterBuffers(device, schema, capacity, dtype)
        full = Schema(schema.group(Group.GEOM)) if half else schema
        self.second = ParameterBuffers(device, full, capacity, dtype)

    def of(self, group: Group) -> tuple[ParameterBuffers, ...]:
        """Return what holds the moments of a group in its buffer of this group."""
        return (self.first,) if self.half and group is Group.SH else (self.first, self.second)

    def color_arguments(self, seed: int, step: int) -> dict[str, Buffer | int]:
        """Return arguments of the kernels that change the moments of colours.

        seed, step : what the rounding of 16 bits depends on, besides the splat.
        """
        if not self.half:
            return {"sh_m": self.first.sh, "sh_v": self.second.sh}
        return {"sh_moments": self.first.sh, "seed_lo": seed & 0xFFFFFFFF, "seed_hi": seed >> 32, "step": step}

    def state(self, n: int, names: tuple[str, ...]) -> PendingArrays:
        """Return the moments of n splats by "first.NAME" and "second.NAME", as 32-bit numbers."""

        def read(order: int, name: str) -> Array:
            if self.half and name == "sh":
                return unpacked(self.first.download(n, (name,))[name].view(np.uint32))[order]
            return (self.first, self.second)[order].download(n, (name,))[name]

        orders = enumerate(("first", "second"))
        return PendingArrays({f"{key}.{name}": partial(read, order, name) for order, key in orders for name in names})

    def load_state(self, state: Mapping[str, NDArray[Any]], names: Iterable[str]) -> None:
        """Continue from moments by name."""
        for name in names:  # one at a time: the state may be in a file
            if self.half and name == "sh":
                self.first.upload({name: packed(state["first.sh"], state["second.sh"]).view(np.float32)})
            else:
                self.first.upload({name: state[f"first.{name}"]})
                self.second.upload({name: state[f"second.{name}"]})

    def reset(self, n: int, names: Iterable[str]) -> None:
        """Set the moments of some fields of n splats to zero."""
        for name in names:
            for moments in self.of(self.first.schema[name].group):
                moments.upload({name: np.zeros((n, self.first.schema[name].width))})
