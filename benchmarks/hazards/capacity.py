"""Scenes of extreme size: 120 000 splats over a tile, and gradient records of more than 2^31 bytes in one buffer."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.rendering import pipeline
from clsplat.rendering.pipeline import isect_bytes
from clsplat.rendering.renderer import Renderer
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

from . import crafted

# Image side [px], splats that all cover the image, and isects of a band in the run for comparison.
CAPACITY: dict[str, tuple[int, int, int | None]] = {
    "120 000 splats over one tile": (16, 120_000, None),
    "records of 2.2 GB in one buffer": (320, 160_000, 4_000_000),
}
_ROOM = 3 * 2**30  # device bytes of the second case


def capacity_row(hazard: str, shape: str, device: Device, smoke: bool = False) -> dict[str, Any] | None:
    """Compare the gradient with double precision, or with a run in bands, which must give the same bits.

    Returns
    -------
    The row; None if the device has too little memory.
    """
    side, n, band = CAPACITY[hazard]
    if smoke:
        side, n, band = min(side, 32), n // 500, band and 400
    if band and device.info.global_mem_bytes < 4 * _ROOM:
        return None
    splats, camera = stack(shape, n, side)
    v_color = np.random.default_rng(1).normal(size=(side, side, 3))
    renderer = Renderer(device)
    got = gradients(renderer, splats, camera, v_color)
    assert renderer._last is not None
    line, frame = renderer._last
    kernels, n_isects, n_bands = line.kernels, frame.n_isects, len(frame.bands)
    nbytes = n_isects * kernels.v_record * kernels.dtype.itemsize
    result: dict[str, Any] = {
        "isects": n_isects,
        "record_bytes": nbytes,
        "bytes": n_isects * isect_bytes(kernels),
        "bands": n_bands,
        "message": "",
        "finite": all(bool(np.isfinite(grad).all()) for grad in got.values()),
    }
    del line, frame, renderer
    if band:
        with mock.patch.object(pipeline, "isect_limit", return_value=band):
            other = gradients(Renderer(device), splats, camera, v_color)
        error = max(float(np.abs(got[name] - other[name]).max()) for name in got)
        return result | {"gradient_error": error, "verdict": "survives" if error == 0 and result["finite"] else "fails"}
    wide = Splats(shape, {name: values.astype(np.float64) for name, values in splats.arrays.items()})
    want = gradients(Renderer(device, "float64"), wide, camera, v_color)
    error = max(
        float(np.linalg.norm(got[name] - want[name]) / max(np.linalg.norm(want[name]), 1e-30))
        for name in ("opacity_logit", "sh")
    )
    return result | {"gradient_error": error, "verdict": "survives" if error < 1e-2 and result["finite"] else "fails"}


def gradients(renderer: Renderer, splats: Splats, camera: Camera, v_color: np.ndarray) -> dict[str, np.ndarray]:
    """Return the gradients of a render."""
    renderer.render(splats, camera)
    return renderer.backward(v_color)


def stack(shape: str, n: int, side: int) -> tuple[Splats, Camera]:
    """Return n faint splats, each as wide as the image, one behind the other."""
    arrays = crafted.benign(SHAPES[shape], n)
    rng = np.random.default_rng(2)
    arrays["mean"] = np.column_stack([rng.normal(0, 0.05, (n, 2)), rng.uniform(1, 9, n)])
    arrays["log_scale"] = rng.normal(0.7, 0.1, (n, 3)) + np.log(arrays["mean"][:, 2:])
    arrays["opacity_logit"] = np.full(n, SHAPES[shape].raw_opacity(np.float64(0.02)))
    camera = Camera(side, side, 0.8 * side, 0.8 * side, side / 2, side / 2, np.eye(4))
    return Splats(shape, {name: values.astype(np.float32) for name, values in arrays.items()}), camera
