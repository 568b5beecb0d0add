"""Shape descriptors: the properties of each splat kernel in Python. The formulas are in cl/shape/*.clh.

The skew has two forms. In the centred form (the "centred parameters" of Azzalini 1985), `skew` is m,
the vector from the location to the mean. Its unit is the splat's standard deviation, and |m| < sqrt(2 / (pi - 2)). In
the direct form, `skew` is the slant eta, which has no unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.real_path import real_path
from . import profiles
from .fields import CORE, Array, Field, Schema, make_schema
from .flops import DENSITY, EXP, LOG, LOG1P, MOMENTS, PHI, QUADRATIC

SKEW_LIMIT = math.sqrt(2.0 / (math.pi - 2.0))  # 1.3236: |m| of an infinitely skewed normal
SKEW_MAX = 0.985 * SKEW_LIMIT  # largest |m| of kernels and training, so that no difference cancels in float32
SLANT_MAX = 10.0  # largest |eta|; its peak is 95 % of the half-Gaussian's
BETA_BOUNDS = (0.5, 8.0)
NU_BOUNDS = (1.0, 1e4)  # SSS: Hardtanh(1, 10000)
NORMALISATIONS = ("peak", "pdf", "none")
_LINE = np.linspace(-4.0, 4.0, 81)  # where profiles are compared with the Gaussian [standard deviations]
_GAUSSIAN_TOLERANCE = 1e-4  # the profile of student-t at the largest nu is off by 4e-5


@dataclass(frozen=True, slots=True)
class Shape:
    """One splat kernel.

    Parameters
    ----------
    name : name in files and on the command line.
    source : kernel file in cl/shape/. lower : files in cl/shape/ that are compiled before it.
    fields : learnable fields, without the core fields and the colour.
    record : number of reals of the screen record (SHAPE_N). moments : number of gradient accumulators (SHAPE_V).
    profile : the kernel along one line (profiles.py).
    flops : operations per pixel (flops.py) of `shape_alpha`, and the additional ones of `shape_alpha_vjp`.
    skew_form : "centred" (skew is m), "direct" (skew is eta) or None (no field `skew`).
    normalised : whether the option `normalisation` changes the kernel.
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
        """Return the fields of this shape at one SH degree."""
        return make_schema(self.fields, sh_degree)

    def opacity(self, raw: Array) -> Array:
        """Return the opacity of raw values of `opacity_logit` or `opacity_minus_logit`."""
        opacity: Array = np.tanh(raw if self.signed else 0.5 * raw)
        if not self.signed:  # in place: new memory for all splats takes as long as the exponentials
            opacity += 1.0
            opacity *= 0.5
        return opacity

    def raw_opacity(self, opacity: Array) -> Array:
        """Return the raw value of an opacity."""
        if self.signed:
            return np.arctanh(opacity)
        return np.log(opacity) - np.log1p(-opacity)

    def holds_gaussian(self) -> bool:
        """Return whether neutral fields make this kernel a Gaussian, by its profile."""
        fields = {field.name: np.array([field.neutral]) for field in self.schema(0)}
        fields = {name: values[:, 0] if values.shape[1] == 1 else values for name, values in fields.items()}
        alpha = np.asarray(self.profile(_LINE, fields), np.float64).sum(axis=1)
        return bool(np.abs(alpha - np.exp(-0.5 * _LINE**2)).max() <= _GAUSSIAN_TOLERANCE)

    def strength(self, arrays: Mapping[str, Array]) -> NDArray[np.float64]:
        """Return the largest |opacity| of each splat, (N,)."""
        raw = arrays["opacity_logit"].astype(np.float64)
        strength: NDArray[np.float64] = np.abs(self.opacity(raw))
        if "opacity_minus_logit" in arrays:
            other = np.abs(self.opacity(arrays["opacity_minus_logit"].astype(np.float64)))
            strength = np.maximum(strength, other)
        return strength


_SKEW_COLUMNS = ("skew_0", "skew_1", "skew_2")
# Training starts from |m| = 0.1, because m = 0 is a stationary point of the centred form. The skewness index is then
# 4e-4, which no 8-bit image shows.
SKEW = Field("skew", 3, _SKEW_COLUMNS, (0.0, 0.0, 0.0), 2.5e-3, 0.5, limit=SKEW_LIMIT, start=0.1)
SLANT = Field("skew", 3, _SKEW_COLUMNS, (0.0, 0.0, 0.0), 1.25e-2, 0.5, limit=SLANT_MAX, start=0.1)
OPACITY_MINUS = Field("opacity_minus_logit", 1, ("opacity_minus",), (0.0,), 5e-2, neutral_from="opacity_logit")
# 3D-HGS has the same rate, but the first normal (0.6, 0.6, 0.6) for all splats. Here each has a random direction.
NORMAL = Field("normal", 3, ("normal_0", "normal_1", "normal_2"), (0.0, 0.0, 1.0), 3e-3, 0.5, nonzero=True, start=1.0)
BETA = Field("beta", 1, ("beta",), (2.0,), 1e-3, 0.5, bounds=BETA_BOUNDS)  # GES: rate 1e-3
NU = Field("nu", 1, ("nu",), (NU_BOUNDS[1],), 1e-2, 0.5, bounds=NU_BOUNDS, start=100.0)  # SSS starts at 100

# Operations of the pixel formulas in cl/shape/. The comments give the terms that have no name.
# Alpha: the product with the opacity 1. Gradient: w 1, its sum 1.
_GAUSSIAN_FLOPS = (QUADRATIC + EXP + 1, 1 + 1 + MOMENTS)
# Alpha: argument of Phi 2. Gradient: w and z 2, their sums 2, moments of z 4.
_SKEW_FLOPS = (QUADRATIC + EXP + 1 + 2 + PHI + 1, DENSITY + 1 + 2 + 2 + MOMENTS + 4)
# Alpha: `above` 1, the sum of both sides 3. Gradient: `below` 1, density 2, w and z 2, gradients of both opacities 4,
# sum and moments of z 5.
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

# The form of the publication (SNS, 2026): (x, y, z) is the location, R S S R' the scale matrix.
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
# A Gaussian divided by a plane through its location, with one opacity on each side. The projection is exact.
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
# A Gaussian divided by a skew instead of a plane. Its limits are gaussian (equal opacities), skew-normal-direct (one
# opacity is 0) and half-gaussian (infinite skew).
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
    # alpha: product with beta 1, with the opacity 1; gradient: w, its power and a quotient 3, sums 1 and 2
    flops=(QUADRATIC + LOG + 1 + EXP + EXP + 1, 3 + 1 + MOMENTS + 2),
)
# The released form of GES: beta only scales the Gaussian, by 2 / (1 + exp(-0.1 (beta - 2))).
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
    # alpha: product with nu 1, with the opacity 1; gradient: inverse, share, e and g 5, gap 9, sums 1 and 4
    flops=(QUADRATIC + LOG1P + 1 + EXP + 1, 5 + 9 + 1 + MOMENTS + 4),
    signed=True,
)

# All shapes by name. The columns of a file without clsplat's comment are compared with the shapes in this order.
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
PACKAGE_SHAPES = frozenset(SHAPES)  # without those of `register_shape`
DEFAULT_SHAPE = SKEW_NORMAL.name
PLAIN_SHAPE = GAUSSIAN.name  # the one that the others generalise


def register_shape(shape: Shape, sources: str | Path | None = None) -> Shape:
    """Add a shape to those of models, commands and charts, and return it with its files resolved.

    Parameters
    ----------
    shape : the descriptor. `source` and `lower` name files in `sources` or in cl/ ("shape/gaussian_pixel.clh").
    sources : folder with the shape's own kernel files.

    Returns
    -------
    The descriptor with absolute paths of the files in `sources`.

    Raises
    ------
    InputError : the name is taken, `sources` has no file `source`, or another shape has a different field of this name.
    """
    if shape.name in SHAPES:
        raise InputError(f"shape {shape.name!r}: this name is taken: choose another")
    known = {field.name: (field.width, field.ply) for field in known_fields()}
    for field in shape.fields:
        if known.get(field.name, (field.width, field.ply)) != (field.width, field.ply):
            raise InputError(f"shape {shape.name!r}: another shape has a field {field.name!r}: choose another name")
    if sources is not None:
        folder = real_path(sources)
        if not (folder / shape.source).is_file():
            raise InputError(f"{folder / shape.source}: no such kernel file: write the shape's formulas there")
        found = tuple(str(folder / name) if (folder / name).is_file() else name for name in shape.lower)
        shape = replace(shape, source=str(folder / shape.source), lower=found)
    SHAPES[shape.name] = shape
    return shape


def known_fields() -> tuple[Field, ...]:
    """Return the fields of all shapes, without colour."""
    return (*CORE, *(field for shape in SHAPES.values() for field in shape.fields))


def shape_named(name: str) -> Shape:
    """Return the shape of this name. An unknown name raises InputError, which lists the known ones."""
    try:
        return SHAPES[name]
    except KeyError:
        raise InputError(f"unknown shape {name!r}: choose one of {', '.join(SHAPES)}") from None


def check_normalisation(name: str) -> str:
    """Return `name`. Raise InputError if it is not a normalisation."""
    if name not in NORMALISATIONS:
        raise InputError(f"unknown normalisation {name!r}: choose one of {', '.join(NORMALISATIONS)}")
    return name
