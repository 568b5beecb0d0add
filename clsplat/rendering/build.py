"""What a kernel build depends on, and the programs of the renderer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..device.device import Device
from ..device.program import Define, Program, Real, build
from ..device.schedule import TILE, Schedule
from ..splats.fields import Group, Schema
from ..splats.shapes import NORMALISATIONS, SKEW_MAX, SLANT_MAX, shape_named

MARGIN_X, MARGIN_Y = 16, 8  # zero margin of every image plane: the SSIM window reaches 5 pixels out
BATCH = 64

ALPHA_MIN, ALPHA_MAX, T_MIN = 1.0 / 255.0, 0.99, 1e-4  # of gsplat and 3DGS
LOW_PASS = 0.3  # px^2
RECORD_HEAD = 10  # HEAD of cl/shape/contract.clh
NEAR = 0.01  # world units

_LOWER = (
    "math/lanes.clh",
    "math/approx.clh",
    "render/group.clh",
    "math/algebra.clh",
    "math/opacity.clh",
    "math/harmonics.clh",
    "camera/pinhole.clh",
    "render/blend.clh",
    "shape/contract.clh",
)


@dataclass(frozen=True)
class KernelBuild:
    """One combination of shape, precision, schedule and thresholds.

    `with_depth` adds the depth image, `with_v_alpha` a gradient coming in through alpha; training needs
    neither.
    """

    shape: str
    sh_degree: int
    schedule: Schedule
    normalisation: str = "peak"
    real: Real = "float"
    skew_map: str = "cube-root"
    with_depth: bool = False
    with_v_alpha: bool = False
    alpha_min: float = ALPHA_MIN
    alpha_max: float = ALPHA_MAX
    t_min: float = T_MIN
    antialiased: bool = False

    @cached_property
    def schema(self) -> Schema:
        """Fields of the shape at this build's SH degree."""
        return shape_named(self.shape).schema(self.sh_degree)

    @property
    def dtype(self) -> np.dtype[np.floating]:
        return np.dtype(np.float32 if self.real == "float" else np.float64)

    @property
    def record(self) -> int:
        """Reals of a screen record."""
        return RECORD_HEAD + shape_named(self.shape).record

    @property
    def v_record(self) -> int:
        """Reals of an isect's gradient record: the shape's moments and three of colour."""
        return shape_named(self.shape).moments + 3

    @property
    def lanes(self) -> int:
        return self.schedule.lanes

    def raster_program(self, device: Device) -> Program:
        """Projection, rasterisation, and their gradients."""
        return self._shape_program(device, "render/project.cl", "render/rasterize.cl")

    def count_program(self, device: Device) -> Program:
        """Useful pairs of a frame (pairs.py)."""
        return self._shape_program(device, "measure/count.cl")

    def for_rendering(self) -> KernelBuild:
        """The same with depth and an alpha gradient."""
        return replace(self, with_depth=True, with_v_alpha=True)

    def _shape_program(self, device: Device, *files: str) -> Program:
        """Files above the shape's own."""
        shape = shape_named(self.shape)
        return build(device, (*_LOWER, *shape.lower, shape.source, *files), self.defines(), self.real)

    def defines(self) -> dict[str, Define]:
        """Constants of the kernels, by name."""
        schema = self.schema
        rows: dict[str, Define] = {
            f"ROW_{field.name.upper()}": schema.offset(field.name) for field in schema.group(Group.GEOM)
        }
        return rows | {
            "TILE": TILE,
            "BATCH": BATCH,
            "MARGIN_X": MARGIN_X,
            "MARGIN_Y": MARGIN_Y,
            "GROUP": self.schedule.group,
            "VECS": self.schedule.vecs,
            "LANES": self.lanes,
            "SH_DEGREE": self.sh_degree,
            "GEOM_ROWS": schema.rows(Group.GEOM),
            "WITH_DEPTH": int(self.with_depth),
            "WITH_V_ALPHA": int(self.with_v_alpha),
            "ANTIALIASED": int(self.antialiased),
            "NORMALISATION": NORMALISATIONS.index(self.normalisation),
            "PEAK_STEPS": 3 if self.real == "float" else 4,
            "SKEW_MAX": SKEW_MAX,
            "SLANT_MAX": SLANT_MAX,
            "OPACITY_SIGNED": int(shape_named(self.shape).signed),
            "LOW_PASS": LOW_PASS,
            "ALPHA_MIN": self.alpha_min,
            "ALPHA_MAX": self.alpha_max,
            "T_MIN": self.t_min,
        }
