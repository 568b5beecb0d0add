"""Models to write to a file, and whether they came back from it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from model_arrays import random_model

from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats


def model(shape: str = "skew-normal", degree: int = 2, n: int = 30, **options: Any) -> Splats:
    return Splats(shape, random_model(SHAPES[shape], n, 5, sh_degree=degree, dead=0), **options)


def same(found: Splats, wanted: Splats, tolerance: float = 1e-6) -> None:
    """Assert that two models are equal up to rounding; quaternions may differ in norm and sign."""
    assert (found.shape, found.normalisation, found.antialiased) == (
        wanted.shape,
        wanted.normalisation,
        wanted.antialiased,
    )
    assert found.near_plane == pytest.approx(wanted.near_plane)
    assert found.low_pass == wanted.low_pass
    for name in set(wanted.arrays) - {"quat"}:
        np.testing.assert_allclose(
            found.arrays[name], wanted.arrays[name], rtol=tolerance, atol=tolerance, err_msg=name
        )
    turns = [rotations(splats.quat.astype(np.float64)) for splats in (found, wanted)]
    np.testing.assert_allclose(*turns, atol=tolerance)
