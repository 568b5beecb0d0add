"""An independent float64 renderer, slow and simple. Tests compare the OpenCL kernels with it.

It avoids the methods of the kernels. Skewed splats are in the direct form (location, scale matrix, slope), and every
pixel evaluates every splat. Bisection finds the peak. Gradients come from the complex step instead of adjoints. The
formulas of the shapes are in reference/skewed.py and reference/radial.py.

All functions accept complex arrays; reference/formulas.py has the closed forms and the complex step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.cameras.camera import Camera
from clsplat.splats.color import BLACK
from reference.formulas import determinant, inverse_2x2, jacobian, normal_cdf, rotation, sh_basis
from reference.radial import RADIAL
from reference.shape import Array, Geometry, Kernel
from reference.skewed import SKEWED

NEAR_PLANE = 0.01  # splats with a camera z below this are skipped, unless a model names another depth
REFERENCES = SKEWED | RADIAL
FIELDS = {name: ("mean", "quat", "log_scale", "opacity_logit", *own.fields, "sh") for name, own in REFERENCES.items()}
STEP = 1e-20  # the complex step; its square must vanish compared with 1


class Rendered(NamedTuple):
    """Images of one view: color (H, W, 3), alpha (H, W), depth (H, W) = sum of weight * camera z."""

    color: Array
    alpha: Array
    depth: Array


@dataclass(frozen=True)
class Screen:
    """B projected splats.

    Attributes
    ----------
    kernel : the splats' kernels on the screen.
    mean_px : (B, 2) images of the projected points [px].
    color : (B, 3), at least 0.
    depth : (B,) camera z of the projected points.
    """

    kernel: Kernel
    mean_px: Array
    color: Array
    depth: Array


def projected_point(arrays: Mapping[str, Array], shape: str) -> Array:
    """Return the (B, 3) world positions of the points that are projected."""
    centre = REFERENCES[shape].centre
    if centre is None:
        return arrays["mean"]
    return arrays["mean"] + np.einsum("bij,bj->bi", axes_of(arrays), centre(arrays))


def axes_of(arrays: Mapping[str, Array]) -> Array:
    """Return R S (B, 3, 3), which maps the splat's unit frame to the world."""
    return rotation(arrays["quat"]) * np.exp(arrays["log_scale"])[:, None, :]


def plain_kernel(arrays: Mapping[str, Array], geometry: Geometry, shape: str, normalisation: str) -> Kernel:
    return REFERENCES[shape].kernel(arrays, geometry, normalisation)


def antialiased_kernel(arrays: Mapping[str, Array], geometry: Geometry, shape: str, normalisation: str) -> Kernel:
    """Return the kernel with the same volume as without the low-pass: its height times the root of the determinant."""
    make = REFERENCES[shape].kernel
    kernel, own = (make(arrays, each, normalisation) for each in (geometry, replace(geometry, low_pass=0.0)))
    factor = np.sqrt(determinant(own.scale2d) / determinant(kernel.scale2d))
    minus = None if own.amplitude_minus is None else factor * own.amplitude_minus
    return kernel._replace(amplitude=factor * own.amplitude, amplitude_minus=minus)


def project(
    arrays: Mapping[str, Array],
    camera: Camera,
    shape: str = "gaussian",
    normalisation: str = "peak",
    sh_degree: int | None = None,
    antialiased: bool = False,
    low_pass: float | None = None,
) -> Screen:
    """Project raw splats (fields as stored, real or complex) to the screen.

    `sh_degree` None means all degrees, and `low_pass` None LOW_PASS.
    """
    world = projected_point(arrays, shape)
    point = world @ camera.rotation.T + camera.translation
    z = point[:, 2]
    mean_px = point[:, :2] / z[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    geometry = Geometry(mean_px, jacobian(point, camera) @ camera.rotation, axes_of(arrays))
    if low_pass is not None:
        geometry = replace(geometry, low_pass=low_pass)
    make = antialiased_kernel if antialiased else plain_kernel
    kernel = make(arrays, geometry, shape, normalisation)

    stored = int(np.sqrt(arrays["sh"].shape[1])) - 1
    degree = stored if sh_degree is None else sh_degree
    ray = world - camera.position
    basis = sh_basis(ray / np.sqrt((ray * ray).sum(-1, keepdims=True)), degree)
    color = np.einsum("bk,bkc->bc", basis, arrays["sh"][:, : (degree + 1) ** 2]) + 0.5
    color = np.where(color.real > 0.0, color, 0.0)
    return Screen(kernel, mean_px, color, z)


def kernel_values(kernel: Kernel, pixels: Array) -> Array:
    """Return (B, P) alphas before clamp and cutoff, at the points `pixels` (2, P) or (B, 2, P) [px]."""
    d = pixels - kernel.location[:, :, None]
    conic = inverse_2x2(kernel.scale2d)
    q = conic[:, 0, 0, None] * d[:, 0] ** 2 + conic[:, 1, 1, None] * d[:, 1] ** 2
    q = q + 2.0 * conic[:, 0, 1, None] * d[:, 0] * d[:, 1]
    opacity = kernel.amplitude[:, None]
    if kernel.slope is not None:
        above = normal_cdf((kernel.slope[:, :, None] * d).sum(1))
        minus = 0.0 if kernel.amplitude_minus is None else kernel.amplitude_minus[:, None]
        opacity = minus + (opacity - minus) * above
    return kernel.falloff(q) * opacity


def alpha_maps(screen: Screen, camera: Camera, alpha_min: float = 1 / 255, alpha_max: float = 0.99) -> Array:
    """Return (B, H W) alphas at the pixel centres. |alpha| is clamped to alpha_max, and is 0 below alpha_min."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    alpha = kernel_values(screen.kernel, np.stack([x.ravel(), y.ravel()]))
    alpha = np.where(np.abs(alpha.real) > alpha_max, np.copysign(alpha_max, alpha.real), alpha)
    return np.where(np.abs(alpha.real) < alpha_min, 0.0, alpha)


def blend(
    alphas: Sequence[Array], colors: Sequence[Array], depths: Sequence[Array], background: ArrayLike, t_min: float
) -> Rendered:
    """Blend B variants front to back, given alphas (B, P), colors (B, 3) and depths (B,) for each splat.

    A pixel is finished if the next splat would reduce its transmittance to t_min or less. That splat and later ones are
    not blended. B may be 1 for splats that are equal in all variants. Returns (B, P, ...) images.
    """
    pixels = alphas[0].shape[-1]
    transmittance: Array = np.ones((1, pixels))
    finished = np.zeros((1, pixels), dtype=bool)
    color: Array = np.zeros((1, pixels, 3))
    depth: Array = np.zeros((1, pixels))
    for alpha, rgb, z in zip(alphas, colors, depths, strict=True):
        after = transmittance * (1.0 - alpha)
        finished = finished | (after.real <= t_min)
        weight = np.where(finished, 0.0, transmittance * alpha)
        color = color + weight[..., None] * rgb[:, None, :]
        depth = depth + weight * z[:, None]
        transmittance = np.where(finished, transmittance, after)
    color = color + transmittance[..., None] * np.asarray(background, dtype=np.float64)
    return Rendered(color, 1.0 - transmittance, depth)


def prepared(arrays: Mapping[str, ArrayLike], shape: str) -> dict[str, Array]:
    """Return the shape's fields as float64 arrays."""
    return {name: np.asarray(arrays[name], dtype=np.float64) for name in FIELDS[shape]}


def visible_order(
    values: Mapping[str, Array], camera: Camera, shape: str, near_plane: float = NEAR_PLANE
) -> NDArray[np.intp]:
    """Return the indices of splats at or beyond the near plane, nearest first. Equal depths keep their order."""
    z = projected_point(values, shape) @ camera.rotation[2] + camera.translation[2]
    order = np.argsort(z, kind="stable")
    return order[z[order] >= near_plane]


def render_reference(
    arrays: Mapping[str, ArrayLike],
    camera: Camera,
    shape: str = "gaussian",
    normalisation: str = "peak",
    background: ArrayLike = BLACK,
    alpha_min: float = 1 / 255,
    alpha_max: float = 0.99,
    t_min: float = 1e-4,
    sh_degree: int | None = None,
    antialiased: bool = False,
    near_plane: float = NEAR_PLANE,
    low_pass: float | None = None,
) -> Rendered:
    """Render raw splats.

    `arrays` holds mean (N, 3), quat (N, 4), log_scale (N, 3), opacity_logit (N,), sh (N, K, 3) and the additional
    fields of the shape.
    """
    values = prepared(arrays, shape)
    order = visible_order(values, camera, shape, near_plane)
    size = (camera.height, camera.width)
    if len(order) == 0:
        color = np.broadcast_to(np.asarray(background, dtype=np.float64), (*size, 3)).copy()
        return Rendered(color, np.zeros(size), np.zeros(size))
    options = (camera, shape, normalisation, sh_degree, antialiased, low_pass)
    screen = project({k: v[order] for k, v in values.items()}, *options)
    alphas = alpha_maps(screen, camera, alpha_min, alpha_max)
    image = blend(alphas[:, None], screen.color[:, None], screen.depth[:, None], background, t_min)
    return Rendered(image.color.reshape(*size, 3), image.alpha.reshape(size), image.depth.reshape(size))


def reference_gradients(
    arrays: Mapping[str, ArrayLike],
    camera: Camera,
    v_color: ArrayLike,
    v_alpha: ArrayLike | None = None,
    shape: str = "gaussian",
    normalisation: str = "peak",
    background: ArrayLike = BLACK,
    alpha_min: float = 1 / 255,
    alpha_max: float = 0.99,
    t_min: float = 1e-4,
    sh_degree: int | None = None,
    fields: Sequence[str] | None = None,
    antialiased: bool = False,
    near_plane: float = NEAR_PLANE,
    low_pass: float | None = None,
) -> dict[str, Array]:
    """Return the gradient of sum(v_color * color) + sum(v_alpha * alpha) with respect to the raw values.

    Active clamps and thresholds count as constant. `v_color` is (H, W, 3), `v_alpha` (H, W) or None. `fields` None
    means all fields of the shape. Returned arrays have the shapes of the inputs. The method treats one splat at a time:
    it recomputes only that splat's alpha map, in one batch with one complex step per parameter.
    """
    values = prepared(arrays, shape)
    names = FIELDS[shape] if fields is None else tuple(fields)
    gradients = {name: np.zeros_like(values[name]) for name in names}
    order = visible_order(values, camera, shape, near_plane)
    if len(order) == 0:
        return gradients
    options = (camera, shape, normalisation, sh_degree, antialiased, low_pass)
    scene = _Blended(
        project({k: v[order] for k, v in values.items()}, *options),
        camera,
        (alpha_min, alpha_max, t_min),
        background,
        v_color,
        v_alpha,
    )
    for place, splat in enumerate(order):
        slopes = scene.slopes(place, project(one_step_each(values, splat, names), *options))
        start = 0
        for name in names:
            entry = gradients[name][splat]
            gradients[name][splat] = slopes[start : start + entry.size].reshape(entry.shape)
            start += entry.size
    return gradients


def reference_screen_gradients(
    arrays: Mapping[str, ArrayLike],
    camera: Camera,
    v_color: ArrayLike,
    v_alpha: ArrayLike | None = None,
    shape: str = "gaussian",
    background: ArrayLike = BLACK,
    alpha_min: float = 1 / 255,
    alpha_max: float = 0.99,
    t_min: float = 1e-4,
) -> Array:
    """Return the gradient of `reference_gradients`' loss with respect to mean_px, (N, 2) [1/px].

    The kernel on the screen moves as a whole, and the colour of the splat stays. Splats behind the camera have zeros.
    """
    values = prepared(arrays, shape)
    gradients = np.zeros((len(values["mean"]), 2))
    order = visible_order(values, camera, shape)
    screen = project({k: v[order] for k, v in values.items()}, camera, shape)
    scene = _Blended(screen, camera, (alpha_min, alpha_max, t_min), background, v_color, v_alpha)
    for place, splat in enumerate(order):
        twice = project({name: array[[splat, splat]] for name, array in values.items()}, camera, shape)
        moved = twice.kernel._replace(location=twice.kernel.location + 1j * STEP * np.eye(2))
        gradients[splat] = scene.slopes(place, replace(twice, kernel=moved))
    return gradients


class _Blended:
    """A projected scene and a loss, sum(v_color * color) + sum(v_alpha * alpha), for derivatives by the complex step.

    Only the alpha map of one splat is computed anew for each set of bumped copies of that splat.
    """

    def __init__(
        self,
        screen: Screen,
        camera: Camera,
        thresholds: tuple[float, float, float],
        background: ArrayLike,
        v_color: ArrayLike,
        v_alpha: ArrayLike | None,
    ) -> None:
        self.camera, (self.alpha_min, self.alpha_max, self.t_min) = camera, thresholds
        self.background = background
        self.weights = np.asarray(v_color, dtype=np.float64).reshape(-1, 3)
        self.weights_alpha = np.zeros(len(self.weights))
        if v_alpha is not None:
            self.weights_alpha = np.asarray(v_alpha, dtype=np.float64).ravel()
        self.alphas = list(self.alphas_of(screen)[:, None])
        self.colors, self.depths = list(screen.color[:, None]), list(screen.depth[:, None])

    def alphas_of(self, screen: Screen) -> Array:
        return alpha_maps(screen, self.camera, self.alpha_min, self.alpha_max)

    def slopes(self, place: int, bumped: Screen) -> Array:
        """Return the slope of the loss for each of the bumped copies (B,) of the splat at `place` in the order."""
        replaced = [
            [*values_of[:place], new, *values_of[place + 1 :]]
            for values_of, new in (
                (self.alphas, self.alphas_of(bumped)),
                (self.colors, bumped.color),
                (self.depths, bumped.depth),
            )
        ]
        image = blend(*replaced, background=self.background, t_min=self.t_min)
        loss = np.einsum("bpc,pc->b", image.color, self.weights) + np.einsum("bp,p->b", image.alpha, self.weights_alpha)
        return loss.imag / STEP


def one_step_each(values: Mapping[str, Array], splat: int, names: Sequence[str]) -> dict[str, Array]:
    """Copy one splat once for each parameter in `names`. Each copy has the imaginary step on a different parameter."""
    count = sum(values[name][splat].size for name in names)
    one = [splat] * count
    copies = {name: array[one].astype(np.complex128) for name, array in values.items()}
    start = 0
    for name in names:
        flat = copies[name].reshape(count, -1)
        width = flat.shape[1]
        flat[start + np.arange(width), np.arange(width)] += 1j * STEP
        start += width
    return copies
