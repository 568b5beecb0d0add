"""The splats of a run as a strategy reads them, without copying all of their parameters to the host."""

from __future__ import annotations

import numpy as np

from ...device.memory import to_host
from ...device.program import Program
from ...rendering.splat_buffers import SplatBuffers
from ...splats.fields import Array, Group, public_shape
from ..columns import Columns
from .edit import Indices
from .table import Summary


class DeviceSplats:
    """The splats on the device that a run changes, as a `SplatTable`. It equals `HostSplats` to the bit.

    program : programs.columns_program.
    """

    def __init__(self, splats: SplatBuffers, program: Program) -> None:
        self.splats, self.program = splats, program
        self.columns = Columns(splats.device, program, splats.capacity, splats.dtype)

    def summary(self) -> Summary:
        splats, n = self.splats, self.splats.n_live
        rows: Array = np.empty((2, n), splats.dtype)
        if n:
            buffer = splats.device.alloc(rows.nbytes)
            self.program.summarise_splats.over(
                n, geom=splats.geom, sh=splats.sh, summary=buffer, capacity=splats.capacity, n=n
            )
            to_host(splats.device, buffer, rows)
        return Summary(*rows)

    def take(self, rows: Indices) -> dict[str, Array]:
        schema, n = self.splats.schema, len(rows)
        geometry = self.columns.take(
            self.splats.geom, self.columns.indices(rows), n, first=0, rows=schema.rows(Group.GEOM)
        )
        return {
            field.name: np.ascontiguousarray(
                geometry[:, schema.offset(field.name) : schema.offset(field.name) + field.width]
            ).reshape(public_shape(field, n))
            for field in schema.group(Group.GEOM)
        }

    def field(self, name: str) -> Array:
        return self.splats.download(self.splats.n_live, (name,))[name]
