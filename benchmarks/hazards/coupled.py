"""Recovery of known skewed splats with each parameterisation of the slant: is the coupled one the only one to fail?

The true splats have the direct form, slants of one length, and one long axis. Training starts from them with turned
axes, changed scales and opacities, and a small slant; no splat is added or removed. The result is the PSNR of the final
fit to the photos. "vanilla" is the textbook form: the coupled slant without a bound and without the normalisation by
the peak. The library bounds every slant; only this file removes the bound. Vanilla differs from the decoupled forms in
three ways, so the forms between them are measured too. The radial map of STABILITY.md is in the commit with the tag
`before-diet`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import clsplat
from clsplat.device.device import Device
from clsplat.errors import ClsplatError
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering import build as kernels
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.colmap import Points
from clsplat.scenes.demo.scene import RING_TARGET, ring_cameras
from clsplat.scenes.scene import Scene, View
from clsplat.splats import shapes
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.optim import skew_map

from .training import finite_file

DIRECT = "skew-normal-direct"
WIDTH, HEIGHT, VIEWS, COUNT, ITERATIONS = 64, 48, 12, 40, 300
UNBOUNDED = 1e4
FORMS: dict[str, dict[str, Any]] = {
    "gaussian": {"shape": "gaussian"},
    "centred": {"shape": "skew-normal"},
    "polar": {"shape": DIRECT, "skew_map": "polar"},
    "coupled": {"shape": DIRECT, "skew_map": "coupled"},
    "coupled, no bound": {"shape": DIRECT, "skew_map": "coupled"},
    "vanilla": {"shape": DIRECT, "skew_map": "coupled", "normalisation": "none"},  # no bound either
}
WITHOUT_BOUND = ("coupled, no bound", "vanilla")
SLANTS, ASPECTS, TURN, SKEW_LR = (2.0, 9.0), (1.0, 10.0, 100.0), 30.0, 1.25e-2


def cases() -> list[dict[str, float]]:
    """Return slants and aspects; then the strong slant with 10 and 100 times the rate of the skew."""
    usual = [{"slant": slant, "aspect": aspect, "skew_lr": SKEW_LR} for slant in SLANTS for aspect in ASPECTS]
    return usual + [{"slant": SLANTS[-1], "aspect": ASPECTS[1], "skew_lr": factor * SKEW_LR} for factor in (10, 100)]


def recovered(
    device: Device, form: str, case: dict[str, float], seed: int = 0, iterations: int = ITERATIONS
) -> dict[str, Any]:
    """Train once; return the PSNR over all photos, and whether the file is finite."""
    rng = np.random.default_rng(seed)
    truth = true_splats(case["slant"], case["aspect"], rng)
    renderer = Renderer(device)
    views = []
    for index, camera in enumerate(ring_cameras(WIDTH, HEIGHT, VIEWS)):
        image = np.clip(renderer.render(truth, camera).color, 0, 1)
        views.append(View(f"view_{index:03d}.png", camera, np.rint(255 * image).astype(np.uint8)))
    nothing = Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))
    scene = Scene("recovery", Path("recovery"), views, nothing)
    options = FORMS[form] | ({"skew_lr": case["skew_lr"]} if FORMS[form]["shape"] != "gaussian" else {})
    with tempfile.TemporaryDirectory() as folder, unbounded(form in WITHOUT_BOUND):
        file = Path(folder) / "start.ply"
        start = disturbed(truth, rng)
        if options["shape"] != DIRECT:
            del start["skew"]
        Splats(options["shape"], start, options.get("normalisation", "peak")).save(file)
        config = TrainConfig(
            **(
                options
                | {
                    "iterations": iterations,
                    "cap_max": COUNT,
                    "sh_degree": 0,
                    "init": str(file),
                    "densify_until": 0.0,
                    "coarse_to_fine": False,
                    "seed": seed,
                    "device": device.info.index,
                }
            )
        )
        try:
            model = clsplat.train(scene, config, output=Path(folder) / "model")
        except ClsplatError as error:
            return {"psnr": None, "finite": True, "message": str(error)}
        longest = float(np.linalg.norm(model.splats.skew, axis=1).max())
        finite = all(finite_file(path) for path in (Path(folder) / "model").rglob("*.ply"))
        psnr = evaluate(Renderer(device), model.splats, views).psnr
    return {"psnr": psnr, "finite": finite, "message": "", "longest": longest, "splats": len(model.splats)}


def true_splats(slant: float, aspect: float, rng: np.random.Generator) -> Splats:
    """Return splats around the middle of the ring, long in their first axis and slanted in random directions."""
    direction = rng.normal(size=(COUNT, 3))
    short = 0.22 / np.sqrt(aspect)
    arrays = {
        "mean": RING_TARGET + rng.uniform(-0.8, 0.8, (COUNT, 3)),
        "quat": rng.normal(size=(COUNT, 4)),
        "log_scale": np.log(np.column_stack([np.full(COUNT, short * aspect), np.full((COUNT, 2), short)])),
        "opacity_logit": rng.uniform(0, 3, COUNT),
        "sh": rng.normal(0, 1.0, (COUNT, 1, 3)),
        "skew": 0.999 * slant * direction / np.linalg.norm(direction, axis=1, keepdims=True),
    }
    return Splats(DIRECT, {name: values.astype(np.float32) for name, values in arrays.items()})


def disturbed(truth: Splats, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Return the start of training: axes turned about a random one, other scales and opacities, a small slant."""
    arrays = truth.to_numpy()
    axis = rng.normal(size=(COUNT, 3))
    turn = Rotation.from_rotvec(np.radians(TURN) * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    quat = (turn * Rotation.from_quat(arrays["quat"], scalar_first=True)).as_quat(scalar_first=True)
    arrays["quat"] = quat.astype(np.float32)
    arrays["log_scale"] += rng.normal(0, 0.3, (COUNT, 3)).astype(np.float32)
    arrays["opacity_logit"] = np.zeros(COUNT, np.float32)
    arrays["skew"] *= np.float32(0.1) / np.linalg.norm(arrays["skew"], axis=1, keepdims=True)
    return arrays


@contextmanager
def unbounded(lift: bool) -> Iterator[None]:
    """Remove the bound of the slant for a while, because the textbook form has no bound."""
    if not lift:
        yield
        return
    shape = shapes.SHAPES[DIRECT]
    free = replace(shape, fields=tuple(replace(field, limit=UNBOUNDED) for field in shape.fields))
    with (
        mock.patch.dict(shapes.SHAPES, {DIRECT: free}),
        mock.patch.object(kernels, "SLANT_MAX", UNBOUNDED),
        mock.patch.object(skew_map, "SLANT_MAX", UNBOUNDED),
    ):
        yield
