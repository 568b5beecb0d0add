"""The public renderer: splats and a camera in, NumPy images and gradients out."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cameras.camera import Camera
from ..device.device import Device, open_device
from ..device.memory import Pool
from ..device.program import Real
from ..device.schedule import Schedule
from ..errors import OTHER_DEVICE, DeviceError, InputError, Remedy
from ..splats.color import BLACK
from ..splats.fields import Array
from ..splats.splats import Splats
from .build import ALPHA_MAX, ALPHA_MIN, T_MIN, KernelBuild
from .frame import DeviceImage, Frame
from .overdraw import splats_per_pixel
from .pipeline import Pipeline
from .splat_buffers import ParameterBuffers, SplatBuffers
from .tuning import schedule_for

_BUILDS = 4  # builds whose buffers are kept: a page or a comparison has a few shapes at most
_SOLID = 0.5  # alpha from which a pixel belongs to a surface
PRECISIONS: dict[str, Real] = {"float32": "float", "float64": "double"}


@dataclass(frozen=True, eq=False)
class Rendered:
    """A rendered image.

    Attributes
    ----------
    color : (H, W, 3), 0 = black, 1 = white; values may exceed 1.
    alpha : (H, W), 1 - final transmittance.
    depth : (H, W), sum of weight * camera z [world units]; divide by alpha for a mean depth.
    """

    color: Array
    alpha: Array
    depth: Array

    @property
    def median_depth(self) -> float | None:
        """Median of the mean depth of the pixels that are more than half opaque [world units]; None without any."""
        solid = self.alpha > _SOLID
        return float(np.median(self.depth[solid].astype(np.float64) / self.alpha[solid])) if solid.any() else None


class RendersSplats(Protocol):
    """What draws splats from a camera: a `Renderer`, or one with levels of detail."""

    def render(
        self, splats: Splats, camera: Camera, background: ArrayLike = BLACK, sh_degree: int | None = None
    ) -> Rendered:
        """Return the image. background : R, G, B. sh_degree : highest band of spherical harmonics in use."""
        ...


class Renderer:
    """Renders splats of any shape on one device. Several threads may use it, one after the other.

    `count_splats` and `backward` are about the last render, of whichever thread.

    Parameters
    ----------
    device : None (the best one), a `--device` string ("cpu", "gpu", "0:1", part of a name), or an open Device.
    precision : "float32" or "float64".
    schedule : distribution of a tile's pixels over work-items; None for the fastest one of the device.
    alpha_min, alpha_max, t_min : blending thresholds; (0, 1, 0) makes the image smooth, for gradient checks.
    keep : number of models that stay on the device; the least recently rendered one is removed first.

    Raises
    ------
    DeviceError : there is no such device, or it has no double precision. InputError : unknown precision.
    """

    def __init__(
        self,
        device: str | Device | None = None,
        precision: str = "float32",
        *,
        schedule: Schedule | None = None,
        alpha_min: float = ALPHA_MIN,
        alpha_max: float = ALPHA_MAX,
        t_min: float = T_MIN,
        keep: int = 1,
    ) -> None:
        if precision not in PRECISIONS:
            raise InputError(f"precision {precision!r}: choose float32 or float64")
        self.device = device if isinstance(device, Device) else open_device(device)
        self.precision = precision
        if precision == "float64" and not self.device.has_fp64:
            raise DeviceError(f"device {self.device.info} has no double precision", Remedy("use float32"), OTHER_DEVICE)
        self.schedule = schedule
        self._thresholds = (alpha_min, alpha_max, t_min)
        self._pipelines: dict[KernelBuild, Pipeline] = {}
        self._keep = keep
        self._uploaded: list[tuple[Splats, SplatBuffers]] = []  # in order of the last render
        pool, dtype = Pool(self.device), np.dtype(precision)
        self._v_color, self._v_alpha = DeviceImage(pool, dtype, 3), DeviceImage(pool, dtype, 1)
        self._last: tuple[Pipeline, Frame] | None = None
        self._lock = threading.Lock()  # pyopencl ends the process if two threads set arguments of one kernel

    def render(
        self, splats: Splats, camera: Camera, background: ArrayLike = BLACK, sh_degree: int | None = None
    ) -> Rendered:
        """Render the splats, with the semantics of gsplat (docs/kernels.md).

        Parameters
        ----------
        background : R, G, B behind the splats.
        sh_degree : highest band of spherical harmonics in use; None for all.

        Raises
        ------
        InputError : `splats` or `camera` is something else, `background` is not three finite numbers, or `sh_degree`
            is not a whole number of at least 0.
        DeviceError : the device does not have the memory.
        """
        _check_scene(splats, camera, sh_degree)
        try:
            rgb = np.asarray(background, np.float64)
        except (TypeError, ValueError):
            rgb = np.full(3, np.nan)
        if rgb.shape != (3,) or not np.all(np.isfinite(rgb)):
            raise InputError(f"background {background!r}: expected three finite numbers R, G, B")
        with self._lock:
            self._last = None  # releases the splats of the last frame: memory may be short
            pipeline = self._pipeline(splats)
            buffers = self._upload(splats, pipeline)
            frame = pipeline.forward(
                buffers,
                camera,
                (float(rgb[0]), float(rgb[1]), float(rgb[2])),
                sh_degree,
                near_plane=splats.near_plane,
            )
            self._last = (pipeline, frame)
            return read_frame(frame)

    def count_splats(self) -> NDArray[np.float32]:
        """Return how many splats each pixel of the last render needs, (H, W) (`overdraw.splats_per_pixel`).

        Raises
        ------
        InputError : nothing is rendered yet.
        """
        with self._lock:
            if self._last is None:
                raise InputError("count_splats: render an image first")
            return splats_per_pixel(*self._last)

    def backward(
        self, v_color: ArrayLike, v_alpha: ArrayLike | None = None, names: Sequence[str] | None = None
    ) -> dict[str, Array]:
        """Return the gradients of a loss of the last render with respect to the raw parameters.

        Parameters
        ----------
        v_color : (H, W, 3), gradient of the loss with respect to `color`.
        v_alpha : (H, W), gradient of the loss with respect to `alpha`; None for zero.
        names : the fields to return; None for all. Colours are most of what a device sends.

        Returns
        -------
        mean (N, 3), quat (N, 4), log_scale (N, 3), opacity_logit (N,), sh (N, K, 3) and the fields of the shape.

        Raises
        ------
        InputError : nothing is rendered yet, the arrays have another size than the image, or a field is unknown.
        """
        with self._lock:
            if self._last is None:
                raise InputError("backward: render an image first")
            pipeline, frame = self._last
            unknown = [name for name in names or () if name not in frame.splats.schema.names]
            if unknown:
                raise InputError(
                    f"names: {unknown[0]!r} is no field; choose from {', '.join(frame.splats.schema.names)}"
                )
            size = (frame.layout.height, frame.layout.width)
            color = self._v_color.write(frame.layout, _checked("v_color", v_color, (*size, 3)))
            alpha = self._v_alpha.write(
                frame.layout, np.zeros(size) if v_alpha is None else _checked("v_alpha", v_alpha, size)
            )
            splats = frame.splats
            grads = ParameterBuffers(self.device, splats.schema, splats.capacity, splats.dtype)
            pipeline.backward(frame, color, grads, alpha)
            return grads.download(splats.n, names)

    def _pipeline(self, splats: Splats) -> Pipeline:
        real = PRECISIONS[self.precision]
        schedule = self.schedule or schedule_for(self.device)
        alpha_min, alpha_max, t_min = self._thresholds
        kernels = KernelBuild(
            splats.shape,
            splats.sh_degree,
            schedule,
            splats.normalisation,
            real,
            alpha_min=alpha_min,
            alpha_max=alpha_max,
            t_min=t_min,
            antialiased=splats.antialiased,
            low_pass=splats.low_pass,
        ).for_rendering()
        found = self._pipelines.pop(kernels, None)
        if found is None:
            while len(self._pipelines) >= _BUILDS:
                self._pipelines.pop(next(iter(self._pipelines)))
            found = Pipeline(self.device, kernels)
        self._pipelines[kernels] = found  # the last one is the one used last
        return found

    def _upload(self, splats: Splats, pipeline: Pipeline) -> SplatBuffers:
        """Return the splats on the device. Splats are immutable, so one object is copied once."""
        known = next((item for item in self._uploaded if item[0] is splats), None)
        if known is None:
            del self._uploaded[: max(len(self._uploaded) + 1 - self._keep, 0)]  # before the upload: memory may be short
            kernels = pipeline.kernels
            known = (splats, SplatBuffers.of(self.device, splats, kernels.dtype))
        else:
            self._uploaded.remove(known)
        self._uploaded.append(known)
        return known[1]


def read_frame(frame: Frame) -> Rendered:
    """Copy the images of a frame to the host. The frame's kernels must be built with depth."""
    images = frame.images
    if images.depth is None:
        raise ValueError("the frame has no depth: build its kernels `for_rendering`")
    alpha = 1 - images.transmittance.read()[..., 0]
    return Rendered(images.color.read(), alpha, images.depth.read()[..., 0])


def _check_scene(splats: object, camera: object, sh_degree: object) -> None:
    """Raise InputError if an argument of `render` has another type than it needs."""
    if not isinstance(splats, Splats):
        raise InputError(f"splats is a {type(splats).__name__}: expected Splats: clsplat.Splats.load reads a file")
    if not isinstance(camera, Camera):
        remedy = "pass its .camera" if hasattr(camera, "camera") else "make one with clsplat.Camera(...)"
        raise InputError(f"camera is a {type(camera).__name__}: expected a Camera: {remedy}")
    if sh_degree is not None and (
        isinstance(sh_degree, bool) or not isinstance(sh_degree, int | np.integer) or sh_degree < 0
    ):
        raise InputError(f"sh_degree {sh_degree!r}: expected a whole number of at least 0, or None for all bands")


def _checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64)
    if array.shape != shape:
        raise InputError(f"{name}: shape {array.shape}, expected {shape}, that of the rendered image")
    return array
