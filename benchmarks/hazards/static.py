"""Crafted splats rendered by the float32 kernels, compared with the double build of the same kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.device import Device
from clsplat.device.schedule import Schedule
from clsplat.errors import ClsplatError
from clsplat.rendering.build import ALPHA_MAX, ALPHA_MIN, T_MIN
from clsplat.rendering.renderer import Rendered, Renderer
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

from . import crafted

IMAGE_TOLERANCE = 0.5 / 255  # half an 8-bit step
GRADIENT_TOLERANCE = 1e-2  # relative error of a field's gradient, in the Euclidean norm; views differ by far more
NEGLIGIBLE = 1e-3  # share of the largest field's gradient; a smaller one is the rounding of others
BACKGROUND = (0.2, 0.5, 0.9)


@dataclass
class Renderers:
    """A float32 renderer, and two double ones with every threshold a little lower and a little higher."""

    device: Device
    schedule: Schedule

    def __post_init__(self) -> None:
        def make(precision: str, shift: float = 0.0) -> Renderer:
            return Renderer(
                self.device,
                precision,
                schedule=self.schedule,
                alpha_min=ALPHA_MIN * (1 + 3 * shift),
                alpha_max=ALPHA_MAX * (1 - 0.1 * shift),
                t_min=T_MIN * (1 + 20 * shift),
            )

        self.single, self.double, self.other = make("float32"), make("float64", -1e-4), make("float64", 1e-4)


def static_row(hazard: str, shape: str, renderers: Renderers) -> dict[str, Any] | None:
    """Return the row of a hazard; None if the shape has nothing at risk."""
    arrays = crafted.STATIC[hazard](SHAPES[shape])
    return judged(shape, arrays, renderers.single, renderers.double, renderers.other) if arrays else None


def judged(shape: str, arrays: crafted.Arrays, single: Renderer, double: Renderer, other: Renderer) -> dict[str, Any]:
    """Compare the float32 renderer with the double one; pixels that differ in `other` are at a threshold: ignored."""
    try:
        splats = Splats(shape, {name: values.astype(np.float32) for name, values in arrays.items()})
    except ClsplatError as error:
        return {"verdict": "stops", "message": str(error), "finite": True}
    wide = Splats(shape, {name: values.astype(np.float64) for name, values in splats.arrays.items()})
    camera = crafted.camera()

    def render(renderer: Renderer, of: Splats) -> Rendered:
        return renderer.render(of, camera, BACKGROUND)

    # Rounding decides on which side of a threshold a pixel falls.
    shifted, exact = render(other, wide), render(double, wide)
    brightest = max(1.0, float(np.abs(exact.color).max()))
    decided = np.abs(shifted.color - exact.color).max(axis=2) < 1e-4 * brightest
    rng = np.random.default_rng(0)
    v_color = rng.normal(size=(*decided.shape, 3)) * decided[..., None]
    v_alpha = rng.normal(size=decided.shape) * decided
    want = double.backward(v_color, v_alpha)
    got = render(single, splats)
    grads = single.backward(v_color, v_alpha)
    finite = bool(
        np.isfinite(got.color).all()
        and np.isfinite(got.alpha).all()
        and all(np.isfinite(grad).all() for grad in grads.values())
    )
    image_error = float(np.abs(got.color - exact.color)[decided].max(initial=0.0)) / brightest
    worst, error = worst_field(grads, want)
    good = image_error <= IMAGE_TOLERANCE and error <= GRADIENT_TOLERANCE
    return {
        "finite": finite,
        "image_error": number(image_error),
        "gradient_error": number(error),
        "field": worst,
        "decided": float(decided.mean()),
        "message": "",
        "verdict": "fails" if not finite else "survives" if good else "loses",
    }


def worst_field(got: dict[str, NDArray[Any]], want: dict[str, NDArray[Any]]) -> tuple[str, float]:
    """Return the field with the largest gradient error, and that error relative to its norm."""
    with np.errstate(over="ignore", invalid="ignore"):
        norms = {name: float(np.linalg.norm(value.astype(np.float64))) for name, value in want.items()}
        floor = max(NEGLIGIBLE * max(norms.values()), 1e-30)
        errors = {
            name: float(np.linalg.norm(got[name].astype(np.float64) - value)) / max(norms[name], floor)
            for name, value in want.items()
        }
    name = max(errors, key=lambda field: errors[field] if np.isfinite(errors[field]) else np.inf)
    return name, errors[name]


def number(value: float) -> float | None:
    """Return a value that JSON can hold: None if it is not finite."""
    return value if np.isfinite(value) else None
