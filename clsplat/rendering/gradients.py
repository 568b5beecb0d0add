"""Gradients on the device as training wants them: those of SH coefficients not written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..device.buffers import ParameterBuffers
from ..device.device import Device
from ..splats.harmonics import sh_basis
from ..splats.schema import Array, Schema

COMPACT_ROWS = 6  # of colour: its gradient, and a direction


class CompactGradients(ParameterBuffers):
    """Gradients of all parameters, those of SH coefficients by the two things that they are the product of.

    `sh` is [6, capacity], (N, 2, 3) on the host: the gradient of the colour, and the unit direction from the camera,
    in which the basis is taken. Written out, the gradients would be 3 K reals a splat, and most of what the backward
    writes.
    """

    def __init__(self, device: Device, schema: Schema, capacity: int, dtype: np.dtype[np.floating]) -> None:
        self.sh_degree = schema.sh_degree
        fields = (replace(field, width=COMPACT_ROWS) if field.name == "sh" else field for field in schema)
        super().__init__(device, Schema(tuple(fields)), capacity, dtype)

    def written_out(self, n: int) -> dict[str, Array]:
        """Public arrays of the gradients of the first n splats' parameters, `sh` as (N, K, 3)."""
        arrays = self.download(n)
        v_rgb, direction = arrays["sh"][:, :1], arrays["sh"][:, 1]
        return arrays | {"sh": sh_basis(direction, self.sh_degree)[:, :, None] * v_rgb}
