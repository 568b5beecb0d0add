"""What a kernel build depends on, and the programs of the renderer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..device.device import Device
from ..device.program import GROUP_ITEMS, Define, Program, Real, build
from ..device.schedule import SUM_PART, TILE, Schedule
from ..splats.fields import Group, Schema
from ..splats.low_pass import LOW_PASS
from ..splats.near_plane import NEAR_PLANE
from ..splats.shapes import NORMALISATIONS, SKEW_MAX, SLANT_MAX, Shape, shape_named
from .camera_block import CAMERA_MEMBERS
from .splat_buffers import COMPACT_ROWS

MARGIN_X, MARGIN_Y = 16, 8  # zero margin of every image plane: the SSIM window reaches 5 pixels out
BATCH, GROUP_BATCH = 64, 32  # isects of a tile that are looked at together; a group has little local memory
SUM_ROWS = 24  # sums that a small group of work-items takes at once (cl/render/group.clh)

ALPHA_MIN, ALPHA_MAX, T_MIN = 1.0 / 255.0, 0.99, 1e-4  # of gsplat and 3DGS
CULLED_KEY = 0xFFFFFFFF  # depth key of a splat that the image does not show

# First slots of a screen record: mean_px [px], colour, camera z, and the first and last pixel row and column that the
# splat can reach. Kernels have them as HEAD_X and so on. The slots of the shape follow.
RECORD_HEAD = ("x", "y", "red", "green", "blue", "depth", "top", "bottom", "left", "right")

_BELOW_SHAPE = (
    "math/lanes.clh",
    "math/approx.clh",
    "render/group.clh",
    "math/algebra.clh",
    "math/opacity.clh",
    "math/harmonics.clh",
    "camera/pinhole.clh",
    "render/blend.clh",
    "shape/forms.clh",
    "shape/contract.clh",
    "shape/rectangle.clh",
    "render/record.clh",
)
_PROJECTION = ("render/antialias.clh", "render/project.cl")
_PIXELS = ("render/batch.clh", "render/blocks.clh", "render/rasterize.cl", "render/gather.cl")


@dataclass(frozen=True)
class KernelBuild:
    """One combination of shape, precision, schedule and thresholds.

    `with_depth` adds the depth image, and `with_v_alpha` a gradient of the loss with respect to alpha. Training needs
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
    low_pass: float = LOW_PASS
    near_plane: float = NEAR_PLANE  # no constant of the kernels: a member of the camera

    @cached_property
    def schema(self) -> Schema:
        """Fields of the shape at this build's SH degree."""
        return shape_named(self.shape).schema(self.sh_degree)

    @property
    def dtype(self) -> np.dtype[np.floating]:
        return np.dtype(np.float32 if self.real == "float" else np.float64)

    @property
    def record(self) -> int:
        """Length of a screen record [reals]."""
        used = len(RECORD_HEAD) + shape_named(self.shape).record
        return -(-used // 4) * 4 if self.record_in_fours else used

    @property
    def record_in_fours(self) -> bool:
        """Whether a screen record is a whole number of vectors of four (cl/render/record.clh)."""
        return self.lanes == 1

    @property
    def v_record(self) -> int:
        """Reals of an isect's gradient record: the moments of the shape and three of the colour."""
        return shape_named(self.shape).moments + 3

    @property
    def batch(self) -> int:
        """Isects of a tile that are looked at together (cl/render/batch.clh)."""
        return BATCH if self.schedule.group == 1 else GROUP_BATCH

    @property
    def culls_blocks(self) -> bool:
        """Whether an isect has a set of blocks, a bit each (cl/render/blocks.clh)."""
        return self.schedule.group == 1 and self.schedule.lanes > 1

    @property
    def culls_strips(self) -> bool:
        """Whether a group of work-items leaves out strips of a tile (cl/render/strips.clh)."""
        return self.schedule.group > 1 and self.schedule.lanes == 1

    @property
    def lanes(self) -> int:
        return self.schedule.lanes

    def projection_program(self, device: Device) -> Program:
        """Projection and its gradient. Options of the pixels do not change it, so their builds share one program."""
        schedule = Schedule(1, TILE * TILE // self.lanes, self.lanes)
        shared = replace(
            self, schedule=schedule, with_depth=False, with_v_alpha=False, alpha_max=ALPHA_MAX, t_min=T_MIN
        )
        return shared._shape_program(device, *_PROJECTION)

    def pixel_program(self, device: Device) -> Program:
        """Rasterisation and its gradient. All SH degrees share one program, because colours are projected before."""
        return replace(self, sh_degree=0)._shape_program(device, *_PIXELS)

    def binning_program(self, device: Device, files: tuple[str, ...], defines: Mapping[str, Define]) -> Program:
        """A program that lists isects, with the strips that each reaches if `culls_strips`."""
        if not self.culls_strips:
            return build(device, files, {"CULLS_STRIPS": 0, **defines})
        flat = replace(self, sh_degree=0, with_depth=False, with_v_alpha=False)
        return flat._shape_program(device, "render/strips.clh", *files, more=defines)

    def count_program(self, device: Device) -> Program:
        """Count of the useful pairs of a frame (rendering/overdraw.py)."""
        alone = replace(self, schedule=Schedule(1, TILE * TILE // self.lanes, self.lanes))
        return alone._shape_program(device, "measure/count.cl")

    def for_rendering(self) -> KernelBuild:
        """The same build with depth and with a gradient through alpha."""
        return replace(self, with_depth=True, with_v_alpha=True)

    def _shape_program(self, device: Device, *files: str, more: Mapping[str, Define] | None = None) -> Program:
        """Program of these files above those of the shape, with more defines."""
        shape = shape_named(self.shape)
        all_files = (*_BELOW_SHAPE, *shape.lower, shape.source, *files)
        return build(device, all_files, {**self.defines(), **(more or {})}, self.real)

    def defines(self) -> dict[str, Define]:
        """Constants of the kernels, by name."""
        shape = shape_named(self.shape)
        heads = {f"HEAD_{name.upper()}": place for place, name in enumerate(RECORD_HEAD)}
        return (
            layout_defines(shape, self.schema)
            | heads
            | {
                "HEAD": len(RECORD_HEAD),
                "SHAPE_N": shape.record,
                "SHAPE_V": shape.moments,
                "CAMERA_MEMBERS": ", ".join(CAMERA_MEMBERS),
                "CULLED_KEY": f"{CULLED_KEY:#x}u",
                "COMPACT_ROWS": COMPACT_ROWS,
                "TILE": TILE,
                "BATCH": self.batch,
                "SUM_ROWS": SUM_ROWS,
                "SUM_PART": SUM_PART,
                "MARGIN_X": MARGIN_X,
                "MARGIN_Y": MARGIN_Y,
                "GROUP": self.schedule.group,
                "VECS": self.schedule.vecs,
                "LANES": self.lanes,
                "RECORD_IN_FOURS": int(self.record_in_fours),
                "CULLS_BLOCKS": int(self.culls_blocks),
                "CULLS_STRIPS": int(self.culls_strips),
                "COLUMNS": int(self.culls_strips),
                "GATHER_ITEMS": GROUP_ITEMS,
                "WITH_DEPTH": int(self.with_depth),
                "WITH_V_ALPHA": int(self.with_v_alpha),
                "ANTIALIASED": int(self.antialiased),
                "NORMALISATION": NORMALISATIONS.index(self.normalisation),
                "PEAK_STEPS": 2 if self.real == "float" else 4,  # relative errors of r: 6e-6 and rounding
                "LOW_PASS": self.low_pass,
                "ALPHA_MIN": self.alpha_min,
                "ALPHA_MAX": self.alpha_max,
                "T_MIN": self.t_min,
            }
        )


def layout_defines(shape: Shape, schema: Schema) -> dict[str, Define]:
    """Rows of the parameter buffers and limits of raw values, which the renderer and the optimizer share.

    ROW_<FIELD> is the first row of a field in geom. SHAPE_FIRST_ROW and SHAPE_ROWS are the rows of the fields that only
    this shape has; RAW_<FIELD> counts from the first of these.
    """
    geom = schema.group(Group.GEOM)
    first = schema.offset(shape.fields[0].name) if shape.fields else schema.rows(Group.GEOM)
    rows: dict[str, Define] = {f"ROW_{field.name.upper()}": schema.offset(field.name) for field in geom}
    rows |= {f"RAW_{field.name.upper()}": schema.offset(field.name) - first for field in shape.fields}
    return rows | {
        "GEOM_ROWS": schema.rows(Group.GEOM),
        "SHAPE_FIRST_ROW": first,
        "SHAPE_ROWS": schema.rows(Group.GEOM) - first,
        "SH_DEGREE": schema.sh_degree,
        "SKEW_MAX": SKEW_MAX,
        "SLANT_MAX": SLANT_MAX,
        "OPACITY_SIGNED": int(shape.signed),
    }
