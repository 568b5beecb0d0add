"""Compact gradients of training, once expanded, equal the full gradients of the backward pass."""

from __future__ import annotations

import numpy as np
import pytest
from reference.formulas import sh_basis as reference_basis
from reference.scenes import for_shape, random_camera, random_splats

from clsplat.device.device import Device
from clsplat.device.schedule import default_schedule
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import DeviceImage
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.splat_buffers import CompactGradients, ParameterBuffers, SplatBuffers
from clsplat.splats.harmonics import sh_basis
from clsplat.splats.splats import Splats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_basis(degree: int) -> None:
    direction = np.random.default_rng(1).standard_normal((50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    np.testing.assert_allclose(sh_basis(direction, degree), reference_basis(direction, degree), rtol=0, atol=1e-14)
    assert sh_basis(direction.astype(np.float32), degree).dtype == np.float32


@pytest.mark.parametrize("degree", [0, 3])
def test_multiplied_out_they_equal_the_full_gradients(device: Device, degree: int) -> None:
    """Colour is equal up to rounding, and the other fields bit for bit. Some colours are clamped, 36 splats hidden."""
    arrays = random_splats(3, 80, 3, np.float32)
    arrays["sh"][::5, 0] -= 3
    unseen = np.r_[:4, 32:64]
    arrays["mean"][unseen] += 100
    splats = Splats("gaussian", for_shape(arrays, "gaussian"))
    kernels = KernelBuild("gaussian", 3, default_schedule(device.info))
    pipeline = Pipeline(device, kernels)
    buffers = SplatBuffers.of(device, splats, kernels.dtype)
    whole, compact = (
        kind(device, splats.schema, buffers.capacity, buffers.dtype) for kind in (ParameterBuffers, CompactGradients)
    )
    frame = pipeline.forward(buffers, random_camera(), sh_degree=degree)
    weights = np.random.default_rng(4).standard_normal((frame.layout.height, frame.layout.width, 3))
    v_color = DeviceImage(pipeline.pool, kernels.dtype, 3).write(frame.layout, weights)
    for grads in (whole, compact):
        grads.upload({name: np.ones_like(array) for name, array in grads.download(buffers.n).items()})
        pipeline.backward(frame, v_color, grads)
    expected, got = whole.download(buffers.n), compact.written_out(buffers.n)
    assert np.any(expected["sh"][:, 0] == 0)
    assert np.any(expected["sh"][:, 0] != 0)
    used = (degree + 1) ** 2
    for name, array in expected.items():
        assert not array[unseen, :used].any() if name == "sh" else not array[unseen].any(), name
    np.testing.assert_allclose(
        got["sh"][:, :used], expected["sh"][:, :used], rtol=1e-6, atol=1e-6 * np.abs(expected["sh"]).max()
    )
    for name in set(expected) - {"sh"}:
        np.testing.assert_array_equal(got[name], expected[name], err_msg=name)
