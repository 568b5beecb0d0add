"""Shape descriptors: everything Python knows about a splat kernel. The formulas are in cl/shape/*.clh.

Constants of the skew-normal's centred form (DESIGN in ARCHITECTURE.md; "centred parameters" of the
skew-normal literature, Azzalini 1985): `skew` is m, the shift from location to mean in the splat's own
standard deviations; |m| < sqrt(2 / (pi - 2)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .errors import InputError
from .schema import Field, Schema, make_schema

SKEW_LIMIT = math.sqrt(2.0 / (math.pi - 2.0))  # 1.3236: |m| of an infinitely skewed normal
SKEW_MAX = 0.985 * SKEW_LIMIT  # kernels and training stay below: nothing cancels in float32 then
NORMALISATIONS = ("peak", "pdf", "none")


@dataclass(frozen=True, slots=True)
class Shape:
    """One splat kernel.

    Parameters
    ----------
    name : as in files and on the command line.
    source : its file in cl/shape/.
    fields : learnable fields beside the core ones and colour.
    record : reals of its screen record (SHAPE_N); moments : its gradient accumulators (SHAPE_V).
    """

    name: str
    source: str
    fields: tuple[Field, ...]
    record: int
    moments: int

    def schema(self, sh_degree: int) -> Schema:
        """Fields of this shape at one SH degree."""
        return make_schema(self.fields, sh_degree)


# Adam's rate of the trainable skew vector s (m = s/|s| * SKEW_MAX * tanh(|s|)^(1/3)); measured, see
# benchmarks.
SKEW = Field("skew", 3, ("skew_0", "skew_1", "skew_2"), (0.0, 0.0, 0.0), 2.5e-3, limit=SKEW_LIMIT)

GAUSSIAN = Shape("gaussian", "shape/gaussian.clh", (), record=4, moments=6)
SKEW_NORMAL = Shape("skew-normal", "shape/skew_normal.clh", (SKEW,), record=9, moments=9)

SHAPES = {shape.name: shape for shape in (GAUSSIAN, SKEW_NORMAL)}
DEFAULT_SHAPE = SKEW_NORMAL.name


def shape_named(name: str) -> Shape:
    """Descriptor of `name`; raises InputError listing the known names."""
    try:
        return SHAPES[name]
    except KeyError:
        raise InputError(f"unknown shape {name!r}: choose one of {', '.join(SHAPES)}") from None


def check_normalisation(name: str) -> str:
    """`name` if it is a known normalisation; raises InputError otherwise."""
    if name not in NORMALISATIONS:
        raise InputError(f"unknown normalisation {name!r}: choose one of {', '.join(NORMALISATIONS)}")
    return name
