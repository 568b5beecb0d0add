"""Signs of axes (splats/axes.py) against a rotation of the whole model, and mirrored axes against a reference."""

from __future__ import annotations

import numpy as np
import pytest
from model_arrays import ALL_SHAPES, random_model

from clsplat.splats.axes import LUF, RUB, Signs, flipped
from clsplat.splats.harmonics import sh_basis
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import Shape
from clsplat.splats.splats import Splats
from clsplat.splats.transform import transformed

SIGNS = [LUF, RUB, (-1, 1, 1), (-1, -1, -1)]


def in_world(arrays: dict[str, np.ndarray], field: str) -> np.ndarray:
    """Vectors R S v of a field of the splats' frames."""
    frame = rotations(arrays["quat"].astype(np.float64)) * np.exp(arrays["log_scale"].astype(np.float64))[:, None]
    return np.einsum("nij,nj->ni", frame, arrays[field])


@pytest.mark.parametrize("signs", SIGNS)
@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda shape: shape.name)
def test_everything_in_space_is_mirrored(shape: Shape, signs: Signs) -> None:
    before = random_model(shape, 30, 1, sh_degree=3)
    after, factors = flipped(before, signs), np.array(signs)
    np.testing.assert_array_equal(after["mean"], before["mean"] * factors)
    frames = [rotations(arrays["quat"].astype(np.float64)) for arrays in (before, after)]
    scales = np.exp(before["log_scale"].astype(np.float64))
    covariances = [np.einsum("nij,nj,nkj->nik", frame, scales**2, frame) for frame in frames]
    np.testing.assert_allclose(covariances[1], covariances[0] * factors[:, None] * factors, rtol=1e-6, atol=1e-9)
    assert (np.linalg.det(frames[1]) > 0).all()
    for field in ("skew", "normal"):
        if field in before:
            np.testing.assert_allclose(in_world(after, field), in_world(before, field) * factors, atol=1e-6)
    directions = np.random.default_rng(2).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colours = [
        np.einsum("dk,nkc->ndc", sh_basis(towards, 3), arrays["sh"].astype(np.float64))
        for towards, arrays in ((directions, before), (directions * factors, after))
    ]
    np.testing.assert_allclose(colours[1], colours[0], atol=1e-6)
    again = flipped(after, signs)
    assert all(np.array_equal(again[name], before[name]) for name in before)


@pytest.mark.parametrize("signs", [LUF, RUB])
def test_two_flips_are_a_half_turn(signs: Signs) -> None:
    splats = Splats("skew-normal", random_model(ALL_SHAPES[1], 30, 1, sh_degree=3))
    turned = transformed(splats, np.diag([*signs, 1]))
    other = flipped(splats.arrays, signs)
    np.testing.assert_allclose(other["sh"], turned.sh, atol=1e-5)
    # A turn leaves the frame's own vectors and turns the frame. A flip turns both round: R F instead of R.
    np.testing.assert_allclose(in_world(other, "skew"), in_world(dict(turned.arrays), "skew"), atol=1e-5)
    np.testing.assert_allclose(other["mean"], turned.mean, atol=1e-6)
