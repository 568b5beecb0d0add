"""Hypothesis strategies for splat models, which the tests of files and of `Splats` share."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from clsplat.splats.fields import public_shape
from clsplat.splats.shapes import SHAPES

Arrays = dict[str, np.ndarray]


def random_arrays(shape: str, n: int, degree: int, seed: int, dtype: type = np.float32) -> Arrays:
    """A valid model of any size, with a wide range of values."""
    rng = np.random.default_rng(seed)
    arrays = {}
    for field in SHAPES[shape].schema(degree):
        values = rng.normal(size=public_shape(field, n)) * 10.0 ** rng.integers(-6, 6)
        if field.limit is not None:
            values *= field.limit * rng.random((n, 1)) / np.linalg.norm(values, axis=1, keepdims=True)
        if field.bounds is not None:
            values = rng.uniform(*field.bounds, values.shape)
        arrays[field.name] = values.astype(dtype)
    return arrays


@st.composite
def models(draw: st.DrawFn) -> tuple[str, str, Arrays]:
    """(shape, normalisation, arrays) with 0 to 6 splats and any SH degree."""
    shape = draw(st.sampled_from(sorted(SHAPES)))
    normalisation = draw(st.sampled_from(["peak", "pdf", "none"]))
    n, degree, seed = draw(st.integers(0, 6)), draw(st.integers(0, 3)), draw(st.integers(0, 2**32 - 1))
    return shape, normalisation, random_arrays(shape, n, degree, seed)
