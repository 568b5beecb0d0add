"""Profiles of shapes, which relocation integrates, are the reference's kernels along a line through the location."""

from __future__ import annotations

import numpy as np
import pytest
from reference.renderer import REFERENCES, kernel_values
from reference.shape import Geometry

from clsplat.splats.shapes import SHAPES

OWN = {"nu": [1.0, 4.0, 1e4], "beta": [0.5, 1.7, 8.0]}  # of three splats
LENGTHS = np.array([0.0, 0.3, 1.2])  # of their skews
THIN = 1e-12  # a low-pass that leaves planes almost sharp [px^2]


@pytest.mark.parametrize("shape", SHAPES)
def test_profiles_are_the_kernels_along_the_skew(shape: str) -> None:
    reference, line = REFERENCES[shape], np.linspace(-6, 6, 41)
    along_x = np.array([1.0, 0.0, 0.0])
    arrays = {
        "opacity_logit": np.full(3, 0.4),
        "opacity_minus_logit": np.full(3, -0.7),
        "skew": LENGTHS[:, None] * along_x,
        "normal": np.tile(2 * along_x, (3, 1)),
        **{name: np.array(values) for name, values in OWN.items()},
    }
    geometry = Geometry(np.zeros((3, 2)), np.tile(np.eye(2, 3), (3, 1, 1)), np.tile(np.eye(3), (3, 1, 1)), THIN)
    kernel = reference.kernel(arrays, geometry, "peak")
    profile = SHAPES[shape].profile(line, {name: arrays[name] for name in ("opacity_logit", *reference.fields)})
    own = [SHAPES[shape].opacity(arrays[name]) for name in ("opacity_logit", "opacity_minus_logit")[: profile.shape[1]]]
    # The unit of a profile is the deviation of the scale matrix, and its origin the location.
    pixels = np.zeros((3, 2, len(line)))
    pixels[:, 0] = line * np.sqrt(kernel.scale2d[:, 0, 0])[:, None] + kernel.location[:, :1]
    alpha = np.einsum("nsk,sn->nk", profile, np.array(own))
    np.testing.assert_allclose(alpha, kernel_values(kernel, pixels), rtol=1e-6, atol=1e-9)
