"""An independent float64 renderer, slow and obvious, that the OpenCL kernels are held against.

It goes another way than the kernels wherever there is one: skewed splats are converted to the direct
(location, scale matrix, slope) form in 3D and projected there, every pixel meets every splat, the peak
is found by bisection, and gradients come by complex step instead of hand-written adjoints.

All of it accepts complex arrays; see reference_formulas.py for the closed forms and the complex step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from reference_formulas import (
    bounded,
    direct_form,
    inverse_2x2,
    jacobian,
    normal_cdf,
    peak,
    rotation,
    sh_basis,
    slope_of,
)

from clsplat.camera import Camera

Array = NDArray[Any]

LOW_PASS = 0.3  # added to the screen covariance [px²]
NEAR_PLANE = 0.01  # splats with a camera z below this are skipped
FIELDS = {
    "gaussian": ("mean", "quat", "log_scale", "opacity_logit", "sh"),
    "skew-normal": ("mean", "quat", "log_scale", "opacity_logit", "sh", "skew"),
}
STEP = 1e-20  # of the complex step; its square must vanish beside 1


class Rendered(NamedTuple):
    """Images of one view: color (H, W, 3), alpha (H, W), depth (H, W) = sum of weight * camera z."""

    color: Array
    alpha: Array
    depth: Array


@dataclass(frozen=True)
class Screen:
    """B projected splats: alpha = amplitude exp(-d' inverse(scale2d) d / 2) Phi(slope' d), d from location.

    Parameters
    ----------
    mean_px : (B, 2), where the mean falls [px]; location : (B, 2), where the kernel is centred [px].
    scale2d : (B, 2, 2), scale matrix, low-pass included [px²]; the covariance where the slope is 0.
    slope : (B, 2) [1/px], or None for shapes without skew (no Phi then).
    amplitude : (B,), factor before the exponential: opacity and normalisation.
    color : (B, 3), >= 0; depth : (B,), camera z.
    """

    mean_px: Array
    location: Array
    scale2d: Array
    slope: Array | None
    amplitude: Array
    color: Array
    depth: Array


def project(arrays: Mapping[str, Array], camera: Camera, shape: str = "gaussian", normalisation: str = "peak",
            sh_degree: int | None = None) -> Screen:
    """Raw splats (fields as stored, real or complex) to the screen; `sh_degree` None means all stored."""
    point = arrays["mean"] @ camera.rotation.T + camera.translation
    z = point[:, 2]
    tangent = point[:, :2] / z[:, None]
    mean_px = tangent * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    axes = rotation(arrays["quat"]) * np.exp(arrays["log_scale"])[:, None, :]  # R S, world from splat frame
    affine = jacobian(point, camera) @ camera.rotation
    opacity = 1.0 / (1.0 + np.exp(-arrays["opacity_logit"]))

    scale3d = axes @ np.swapaxes(axes, 1, 2)
    location, slope, amplitude = mean_px, None, opacity
    if shape == "skew-normal":
        scale3d, delta3d = direct_form(scale3d, np.einsum("bij,bj->bi", axes, bounded(arrays["skew"])))
        delta = np.einsum("bij,bj->bi", affine, delta3d)
        location = mean_px - np.sqrt(2.0 / np.pi) * delta
    elif shape != "gaussian":
        raise ValueError(f"unknown shape {shape!r}")
    scale2d = affine @ scale3d @ np.swapaxes(affine, 1, 2) + LOW_PASS * np.eye(2)
    if shape == "skew-normal":
        slope, c = slope_of(scale2d, delta)
        amplitude = opacity * {"peak": 1.0 / peak(c), "pdf": 2.0, "none": 1.0}[normalisation]

    stored = int(np.sqrt(arrays["sh"].shape[1])) - 1
    degree = stored if sh_degree is None else sh_degree
    ray = arrays["mean"] - camera.position
    basis = sh_basis(ray / np.sqrt((ray * ray).sum(-1, keepdims=True)), degree)
    color = np.einsum("bk,bkc->bc", basis, arrays["sh"][:, : (degree + 1) ** 2]) + 0.5
    color = np.where(color.real > 0.0, color, 0.0)
    return Screen(mean_px, location, scale2d, slope, amplitude, color, z)


def alpha_maps(screen: Screen, camera: Camera, alpha_min: float = 1 / 255, alpha_max: float = 0.99) -> Array:
    """(B, H W) alphas at the pixel centres, clamped to alpha_max and 0 below alpha_min."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    d = np.stack([x.ravel(), y.ravel()]) - screen.location[:, :, None]
    conic = inverse_2x2(screen.scale2d)
    q = conic[:, 0, 0, None] * d[:, 0] ** 2 + conic[:, 1, 1, None] * d[:, 1] ** 2
    q = q + 2.0 * conic[:, 0, 1, None] * d[:, 0] * d[:, 1]
    alpha = screen.amplitude[:, None] * np.exp(-0.5 * q)
    if screen.slope is not None:
        alpha = alpha * normal_cdf((screen.slope[:, :, None] * d).sum(1))
    alpha = np.where(alpha.real > alpha_max, alpha_max, alpha)
    return np.where(alpha.real < alpha_min, 0.0, alpha)


def blend(alphas: Sequence[Array], colors: Sequence[Array], depths: Sequence[Array], background: ArrayLike,
          t_min: float) -> Rendered:
    """Front-to-back blending of B variants at once: per splat alphas (B, P), colors (B, 3), depths (B,).

    A pixel is finished for good by the splat that would take its transmittance to <= t_min; that splat
    is not blended. B may be 1 for splats that are alike in all variants. Returns (B, P, ...) images.
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
    """The shape's fields as float64 arrays; a missing skew is zero."""
    given = dict(arrays)
    given.setdefault("skew", np.zeros((len(np.asarray(given["mean"])), 3)))
    return {name: np.asarray(given[name], dtype=np.float64) for name in FIELDS[shape]}


def visible_order(values: Mapping[str, Array], camera: Camera) -> NDArray[np.intp]:
    """Indices of the splats not in front of the near plane, nearest first; equal depths keep their order."""
    z = values["mean"] @ camera.rotation[2] + camera.translation[2]
    order = np.argsort(z, kind="stable")
    return order[z[order] >= NEAR_PLANE]


def render_reference(arrays: Mapping[str, ArrayLike], camera: Camera, shape: str = "gaussian",
                     normalisation: str = "peak", background: ArrayLike = (0.0, 0.0, 0.0),
                     alpha_min: float = 1 / 255, alpha_max: float = 0.99, t_min: float = 1e-4,
                     sh_degree: int | None = None) -> Rendered:
    """Render raw splats: `arrays` holds mean (N, 3), quat (N, 4), log_scale (N, 3), opacity_logit (N,),
    sh (N, K, 3) and, for skewed shapes, skew (N, 3).
    """
    values = prepared(arrays, shape)
    order = visible_order(values, camera)
    size = (camera.height, camera.width)
    if len(order) == 0:
        color = np.broadcast_to(np.asarray(background, dtype=np.float64), (*size, 3)).copy()
        return Rendered(color, np.zeros(size), np.zeros(size))
    screen = project({k: v[order] for k, v in values.items()}, camera, shape, normalisation, sh_degree)
    alphas = alpha_maps(screen, camera, alpha_min, alpha_max)
    image = blend(alphas[:, None], screen.color[:, None], screen.depth[:, None], background, t_min)
    return Rendered(image.color.reshape(*size, 3), image.alpha.reshape(size), image.depth.reshape(size))


def reference_gradients(arrays: Mapping[str, ArrayLike], camera: Camera, v_color: ArrayLike,
                        v_alpha: ArrayLike | None = None, shape: str = "gaussian",
                        normalisation: str = "peak", background: ArrayLike = (0.0, 0.0, 0.0),
                        alpha_min: float = 1 / 255, alpha_max: float = 0.99, t_min: float = 1e-4,
                        sh_degree: int | None = None, fields: Sequence[str] | None = None
                        ) -> dict[str, Array]:
    """Gradient of sum(v_color * color) + sum(v_alpha * alpha) with respect to the raw values.

    Clamps and thresholds count as constant where they act. `v_color` is (H, W, 3), `v_alpha` (H, W) or
    None; `fields` None means all of the shape's. Returns arrays shaped like the inputs. One splat at a
    time: only its own alpha map is computed anew, in one batch with one complex step per parameter.
    """
    values = prepared(arrays, shape)
    names = FIELDS[shape] if fields is None else tuple(fields)
    gradients = {name: np.zeros_like(values[name]) for name in names}
    order = visible_order(values, camera)
    if len(order) == 0:
        return gradients
    weights = np.asarray(v_color, dtype=np.float64).reshape(-1, 3)
    weights_alpha = np.zeros(len(weights))
    if v_alpha is not None:
        weights_alpha = np.asarray(v_alpha, dtype=np.float64).ravel()
    screen = project({k: v[order] for k, v in values.items()}, camera, shape, normalisation, sh_degree)
    alphas = list(alpha_maps(screen, camera, alpha_min, alpha_max)[:, None])
    colors, depths = list(screen.color[:, None]), list(screen.depth[:, None])

    for place, splat in enumerate(order):
        bumped = project(one_step_each(values, splat, names), camera, shape, normalisation, sh_degree)
        replaced = [
            [*values_of[:place], new, *values_of[place + 1 :]]
            for values_of, new in (
                (alphas, alpha_maps(bumped, camera, alpha_min, alpha_max)), (colors, bumped.color),
                (depths, bumped.depth),
            )
        ]  # fmt: skip
        image = blend(*replaced, background=background, t_min=t_min)
        loss = np.einsum("bpc,pc->b", image.color, weights) + np.einsum("bp,p->b", image.alpha, weights_alpha)
        start = 0
        for name in names:
            entry = gradients[name][splat]
            part = loss.imag[start : start + entry.size] / STEP
            gradients[name][splat] = part.reshape(entry.shape)
            start += entry.size
    return gradients


def one_step_each(values: Mapping[str, Array], splat: int, names: Sequence[str]) -> dict[str, Array]:
    """As many copies of one splat as `names` have parameters, each with the imaginary step on another one."""
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
