"""Comparison of the kernels with the reference. Cases are computed once."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from reference.renderer import (
    Rendered,
    alpha_maps,
    prepared,
    project,
    reference_gradients,
    render_reference,
    visible_order,
)
from reference.scenes import for_shape
from reference.tolerances import relative_error

from clsplat.cameras.camera import Camera
from clsplat.rendering import renderer as render
from clsplat.rendering.build import ALPHA_MAX, ALPHA_MIN, T_MIN
from clsplat.splats.low_pass import LOW_PASS
from clsplat.splats.near_plane import NEAR_PLANE
from clsplat.splats.shapes import NORMALISATIONS, SHAPES
from clsplat.splats.splats import Splats

Arrays = dict[str, NDArray[np.floating]]

# (shape, normalisation) of every kernel.
KERNELS = [
    (shape.name, normalisation)
    for shape in SHAPES.values()
    for normalisation in (NORMALISATIONS if shape.normalised else NORMALISATIONS[:1])
]
BACKGROUND = (0.2, 0.5, 0.9)
SMOOTH = {"alpha_min": 0.0, "alpha_max": 1.0, "t_min": 0.0}

STEP = 1e-3  # for the five-point rule: truncation STEP^4 f'''''/30, rounding 1e-16 |f| / STEP
FIVE_POINTS = ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))
TWO_POINTS = ((1, 0.5), (-1, -0.5))  # exact if the image is linear, as in the colour


@dataclass(frozen=True, eq=False)
class Case:
    """One scene, one view, one loss, and the reference's results. `arrays` may omit fields of the shape.

    `reference.scenes.for_shape` adds the omitted fields. The values are rounded to `dtype` first, so that both sides
    get the same values. A pixel is *decided* if float32 cannot move any of its alphas and transmittances across a
    threshold. The loss ignores the other pixels, and comparisons exclude them.
    """

    arrays: Arrays
    camera: Camera
    shape: str
    normalisation: str = "peak"
    dtype: type = np.float32
    fields: tuple[str, ...] | None = None  # fields whose gradients are compared; None = all
    seed: int = 0
    thresholds: dict[str, float] = field(default_factory=dict)
    antialiased: bool = False
    near_plane: float = NEAR_PLANE
    low_pass: float = LOW_PASS

    @cached_property
    def values(self) -> Arrays:
        return {name: value.astype(self.dtype) for name, value in for_shape(self.arrays, self.shape).items()}

    @cached_property
    def splats(self) -> Splats:
        return Splats(self.shape, self.values, self.normalisation, self.antialiased, self.near_plane, self.low_pass)

    @cached_property
    def image(self) -> Rendered:
        return render_reference(
            self.values,
            self.camera,
            self.shape,
            self.normalisation,
            BACKGROUND,
            antialiased=self.antialiased,
            near_plane=self.near_plane,
            low_pass=self.low_pass,
            **self.thresholds,
        )

    @cached_property
    def gradients(self) -> Arrays:
        return reference_gradients(
            self.values,
            self.camera,
            *self.weights,
            self.shape,
            self.normalisation,
            BACKGROUND,
            fields=self.fields,
            antialiased=self.antialiased,
            near_plane=self.near_plane,
            low_pass=self.low_pass,
            **self.thresholds,
        )

    @cached_property
    def decided(self) -> NDArray[np.bool_]:
        """Return (height, width)."""
        shape = (self.camera.height, self.camera.width)
        values = prepared(self.values, self.shape)
        order = visible_order(values, self.camera, self.shape, self.near_plane)
        if self.thresholds or not len(order):
            return np.ones(shape, bool)
        ordered = {name: value[order] for name, value in values.items()}
        filters = {"antialiased": self.antialiased, "low_pass": self.low_pass}
        screen = project(ordered, self.camera, self.shape, self.normalisation, **filters)
        raw = alpha_maps(screen, self.camera, 0.0, np.inf)
        behind = np.cumprod(1.0 - alpha_maps(screen, self.camera), axis=0)
        size = np.abs(raw)
        close = (np.abs(size / ALPHA_MIN - 1.0) < 3e-4) | (np.abs(size - ALPHA_MAX) < 1e-5)
        close |= np.abs(behind / T_MIN - 1.0) < 2e-3
        return ~close.any(axis=0).reshape(shape)

    @cached_property
    def weights(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return random v_color (H, W, 3) and v_alpha (H, W)."""
        rng = np.random.default_rng(self.seed)
        v_color, v_alpha = rng.normal(size=(*self.decided.shape, 3)), rng.normal(size=self.decided.shape)
        return v_color * self.decided[..., None], v_alpha * self.decided

    def render(self, renderer: render.Renderer) -> render.Rendered:
        return renderer.render(self.splats, self.camera, BACKGROUND)

    def backward(self, renderer: render.Renderer) -> Arrays:
        return renderer.backward(*self.weights)

    def check(self, renderer: render.Renderer, image_tolerance: float, gradient_tolerance: float) -> None:
        """Render and differentiate, and assert that both results agree with the reference.

        Images: the largest absolute difference (depth: relative to the largest camera z). Gradients: the largest
        difference in a field, relative to the field's largest entry. That entry counts as at least 1e-3 of the
        largest entry of all fields. A smaller field only contains the rounding of others (rotation of a ball, skew of
        m = 0).
        """
        got = self.render(renderer)
        self.check_image(got, image_tolerance)
        gradients = self.backward(renderer)
        floor = 1e-3 * max(np.abs(value).max(initial=0.0) for value in gradients.values())
        for name, want in self.gradients.items():
            assert gradients[name].shape == want.shape, name
            error = relative_error(gradients[name], want, floor)
            assert error <= gradient_tolerance, f"gradient of {name}: off by {error:.1e}"

    def check_image(self, got: render.Rendered, tolerance: float) -> None:
        reach = float(np.abs(self.values["mean"]).sum(1).max(initial=0.0))
        furthest = max(1.0, self.camera.translation[2] + reach)
        assert self.decided.mean() > 0.8, "too few pixels left to compare"
        for name, scale in (("color", 1.0), ("alpha", 1.0), ("depth", furthest)):
            ours, reference = getattr(got, name), getattr(self.image, name)
            assert ours.shape == reference.shape, name
            assert np.isfinite(ours).all(), name
            error = float(np.abs(ours - reference)[self.decided].max(initial=0.0)) / scale
            assert error <= tolerance, f"{name}: off by {error:.1e}"


def differences(renderer: render.Renderer, case: Case, field: str) -> np.ndarray:
    """Return central differences of the loss for every entry of a field."""
    v_color, v_alpha = case.weights
    gradient = np.zeros_like(case.values[field])
    for index in np.ndindex(gradient.shape):
        for multiple, factor in TWO_POINTS if field == "sh" else FIVE_POINTS:
            bumped = case.values[field].copy()
            bumped[index] += multiple * STEP
            splats = case.splats.with_arrays({**case.values, field: bumped})
            image = renderer.render(splats, case.camera, BACKGROUND)
            loss = (v_color * image.color).sum() + (v_alpha * image.alpha).sum()
            gradient[index] += factor * loss / STEP
    return gradient
