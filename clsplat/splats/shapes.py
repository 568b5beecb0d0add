"""Shape descriptors: everything Python knows about a splat kernel. The formulas are in cl/shape/*.clh.

Constants of the skew-normal's centred form (ARCHITECTURE.md; "centred parameters" of the skew-normal literature,
Azzalini 1985): `skew` is m, the shift from location to mean in the splat's own standard deviations;
|m| < sqrt(2 / (pi - 2)). In the direct form `skew` is the slant eta, without a unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import profiles
from .fields import CORE, Array, Field, Schema, make_schema
from .flops import DENSITY, EXP, LOG, LOG1P, MOMENTS, PHI, QUADRATIC

SKEW_LIMIT = math.sqrt(2.0 / (math.pi - 2.0))  # 1.3236: |m| of an infinitely skewed normal
SKEW_MAX = 0.985 * SKEW_LIMIT  # kernels and training stay below: nothing cancels in float32 then
SLANT_MAX = 10.0  # |eta|: 95 % of the half-Gaussian's peak
BETA_BOUNDS = (0.5, 8.0)
NU_BOUNDS = (1.0, 1e4)  # SSS: Hardtanh(1, 10000)
NORMALISATIONS = ("peak", "pdf", "none")


@dataclass(frozen=True, slots=True)
class Shape:
    """One splat kernel.

    Parameters
    ----------
    name : as in files and on the command line.
    source : its file in cl/shape/; lower : files in cl/shape/ that it builds upon.
    fields : learnable fields beside the core ones and colour.
    record : reals of its screen record (SHAPE_N); moments : its gradient accumulators (SHAPE_V).
    profile : alpha along the axis on which copies are stacked (see profiles.py).
    flops : of one pixel's `shape_alpha` and, beyond it, `shape_alpha_vjp`, counted as flops.py says.
    skew_form : "centred" (skew is m), "direct" (skew is eta) or None (no field `skew`).
    normalised : whether `normalisation` means anything to it.
    signed : whether the opacity is tanh of its raw value, in (-1, 1), instead of the logistic function.
    """

    name: str
    source: str
    fields: tuple[Field, ...]
    record: int
    moments: int
    profile: Callable[..., Array]
    flops: tuple[int, int]
    skew_form: str | None = None
    normalised: bool = False
    signed: bool = False
    lower: tuple[str, ...] = ()

    def schema(self, sh_degree: int) -> Schema:
        """Fields of this shape at one SH degree."""
        return make_schema(self.fields, sh_degree)

    def opacity(self, raw: Array) -> Array:
        """Opacity of the raw values of `opacity_logit` (or `opacity_minus_logit`)."""
        opacity: Array = np.tanh(raw) if self.signed else 0.5 * (1.0 + np.tanh(0.5 * raw))
        return opacity

    def raw_opacity(self, opacity: Array) -> Array:
        """The raw value that gives `opacity`."""
        if self.signed:
            return np.arctanh(opacity)
        return np.log(opacity) - np.log1p(-opacity)

    def strength(self, arrays: Mapping[str, Array]) -> NDArray[np.float64]:
        """(N,) the largest |opacity| of each splat: by it splats are alive, drawn and quiet."""
        raw = arrays["opacity_logit"].astype(np.float64)
        strength: NDArray[np.float64] = np.abs(self.opacity(raw))
        if "opacity_minus_logit" in arrays:
            other = np.abs(self.opacity(arrays["opacity_minus_logit"].astype(np.float64)))
            strength = np.maximum(strength, other)
        return strength


_SKEW_COLUMNS = ("skew_0", "skew_1", "skew_2")
# m = 0 is a stationary point of the centred form; at 0.1 the skewness index is 4e-4, far below one 8-bit step.
SKEW = Field("skew", 3, _SKEW_COLUMNS, (0.0, 0.0, 0.0), 2.5e-3, 0.5, limit=SKEW_LIMIT, start=0.1)
SLANT = Field("skew", 3, _SKEW_COLUMNS, (0.0, 0.0, 0.0), 1.25e-2, 0.5, limit=SLANT_MAX, start=0.1)
OPACITY_MINUS = Field("opacity_minus_logit", 1, ("opacity_minus",), (0.0,), 5e-2, neutral_from="opacity_logit")
# 3D-HGS: rate 3e-3; it starts all normals at (0.6, 0.6, 0.6), here each has a random direction.
NORMAL = Field("normal", 3, ("normal_0", "normal_1", "normal_2"), (0.0, 0.0, 1.0), 3e-3, 0.5, nonzero=True, start=1.0)
BETA = Field("beta", 1, ("beta",), (2.0,), 1e-3, 0.5, bounds=BETA_BOUNDS)  # GES: rate 1e-3
NU = Field("nu", 1, ("nu",), (NU_BOUNDS[1],), 1e-2, 0.5, bounds=NU_BOUNDS, start=100.0)  # SSS starts at 100

# Flops, term by term as the pixel formulas of cl/shape/ have them.
_GAUSSIAN_FLOPS = (QUADRATIC + EXP + 1, 1 + 1 + MOMENTS)  # times opacity; w, its sum
# Argument of Phi 2; w and z 2, the sums of w and z 2, moments of z 4.
_SKEW_FLOPS = (QUADRATIC + EXP + 1 + 2 + PHI + 1, DENSITY + 1 + 2 + 2 + MOMENTS + 4)
# above 1, alpha 3; below 1, density 2, w and z 2, both opacities 4, sum and moments of z 5.
_TWO_SIDED_FLOPS = (QUADRATIC + EXP + 2 + PHI + 1 + 3, 1 + DENSITY + 2 + 2 + 4 + MOMENTS + 5)

GAUSSIAN = Shape(
    "gaussian",
    "shape/gaussian.clh",
    (),
    record=5,
    moments=6,
    profile=profiles.gaussian,
    flops=_GAUSSIAN_FLOPS,
    lower=("shape/gaussian_pixel.clh",),
)
SKEW_NORMAL = Shape(
    "skew-normal",
    "shape/skew_normal.clh",
    (SKEW,),
    record=12,
    moments=9,
    profile=profiles.skew_normal,
    flops=_SKEW_FLOPS,
    skew_form="centred",
    normalised=True,
    lower=("shape/skew_pixel.clh",),
)

# As skew-normal splatting was published: (x, y, z) is the location, R S S R' the scale matrix.
SKEW_NORMAL_DIRECT = Shape(
    "skew-normal-direct",
    "shape/skew_normal_direct.clh",
    (SLANT,),
    record=12,
    moments=9,
    profile=profiles.skew_normal_direct,
    flops=_SKEW_FLOPS,
    skew_form="direct",
    normalised=True,
    lower=("shape/skew_pixel.clh", "shape/displacement.clh"),
)
# A plane through the location, one opacity a side, projected exactly.
HALF_GAUSSIAN = Shape(
    "half-gaussian",
    "shape/half_gaussian.clh",
    (OPACITY_MINUS, NORMAL),
    record=10,
    moments=10,
    profile=profiles.half_gaussian,
    flops=_TWO_SIDED_FLOPS,
    lower=("shape/displacement.clh", "shape/two_sided.clh"),
)
# The same divided by a finite skew: gaussian (equal opacities), skew-normal-direct (one of them 0), half-gaussian
# (infinite skew) are its limits.
BISECTED_SKEW = Shape(
    "bisected-skew",
    "shape/bisected_skew.clh",
    (OPACITY_MINUS, SLANT),
    record=10,
    moments=10,
    profile=profiles.bisected_skew,
    flops=_TWO_SIDED_FLOPS,
    skew_form="direct",
    lower=("shape/displacement.clh", "shape/two_sided.clh"),
)
GENERALISED_EXPONENTIAL = Shape(
    "generalised-exponential",
    "shape/generalised_exponential.clh",
    (BETA,),
    record=6,
    moments=7,
    profile=profiles.generalised_exponential,
    # times beta, times opacity; w, its power, quotient 3, sums
    flops=(QUADRATIC + LOG + 1 + EXP + EXP + 1, 3 + 1 + MOMENTS + 2),
)
# GES as released: beta only scales the Gaussian, by 2 / (1 + exp(-0.1 (beta - 2))).
GES_MODULATION = Shape(
    "ges-modulation",
    "shape/ges_modulation.clh",
    (BETA,),
    record=5,
    moments=6,
    profile=profiles.gaussian,
    flops=_GAUSSIAN_FLOPS,
    lower=("shape/gaussian_pixel.clh",),
)
STUDENT_T = Shape(
    "student-t",
    "shape/student_t.clh",
    (NU,),
    record=6,
    moments=7,
    profile=profiles.student_t,
    # times nu, times opacity; inverse, share, e, g 5, gap 9, sums
    flops=(QUADRATIC + LOG1P + 1 + EXP + 1, 5 + 9 + 1 + MOMENTS + 4),
    signed=True,
)

# In the order in which a file without clsplat's comment is matched by its columns.
SHAPES = {
    shape.name: shape
    for shape in (
        GAUSSIAN,
        SKEW_NORMAL,
        SKEW_NORMAL_DIRECT,
        HALF_GAUSSIAN,
        BISECTED_SKEW,
        GENERALISED_EXPONENTIAL,
        GES_MODULATION,
        STUDENT_T,
    )
}
DEFAULT_SHAPE = SKEW_NORMAL.name


def register_shape(shape: Shape, sources: str | Path | None = None) -> Shape:
    """Add a shape to those that models, commands and charts know.

    Parameters
    ----------
    shape : its descriptor. `source` and `lower` name files of cl/shape/ ("shape/gaussian_pixel.clh"), or of `sources`.
    sources : folder with the shape's own kernel files.

    Returns
    -------
    The descriptor with absolute paths of the files in `sources`.

    Raises
    ------
    InputError : the name is taken, `sources` has no file `source`, or two shapes disagree about a field.
    """
    if shape.name in SHAPES:
        raise InputError(f"shape {shape.name!r}: this name is taken: choose another")
    known = {field.name: (field.width, field.ply) for field in known_fields()}
    for field in shape.fields:
        if known.get(field.name, (field.width, field.ply)) != (field.width, field.ply):
            raise InputError(f"shape {shape.name!r}: another shape has a field {field.name!r}: choose another name")
    if sources is not None:
        folder = Path(sources).resolve()
        if not (folder / shape.source).is_file():
            raise InputError(f"{folder / shape.source}: no such kernel file: write the shape's formulas there")
        found = tuple(str(folder / name) if (folder / name).is_file() else name for name in shape.lower)
        shape = replace(shape, source=str(folder / shape.source), lower=found)
    SHAPES[shape.name] = shape
    return shape


def known_fields() -> tuple[Field, ...]:
    """Fields of all shapes, without colour."""
    return (*CORE, *(field for shape in SHAPES.values() for field in shape.fields))


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
