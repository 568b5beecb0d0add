"""Image quality: PSNR and SSIM, and the protocol that defines how they are computed.

"PSNR" and "SSIM" differ between tools by rounding and by padding, enough to change a ranking. Therefore every table
names its `MetricProtocol`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Padding = Literal["valid", "zero"]

# Wang, Bovik, Sheikh, Simoncelli 2004: 11x11 Gaussian window, sigma 1.5, K1 = 0.01, K2 = 0.03, range 1.
SSIM_RADIUS = 5
MIN_SIDE = 2 * SSIM_RADIUS + 1  # smallest side of an image that a window fits into [px]
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


@dataclass(frozen=True, slots=True)
class MetricProtocol:
    """How metrics are computed.

    Parameters
    ----------
    name : as on the command line.
    rounded : round both images to 8 bits first.
    padding : "valid" computes SSIM over windows inside the image only; "zero" pads the image with zeros and takes one
        window per pixel.
    corrected : bring the first image to the exposure of the second before, by `color_corrected`.
    """

    name: str
    rounded: bool
    padding: Padding
    corrected: bool = False

    def measure(self, a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> dict[str, float]:
        """Return `{"PSNR": dB, "SSIM": -1..1}` for one pair of images.

        Parameters
        ----------
        a, b : (H, W) or (H, W, C), such as a render and its photo.
        mask : (H, W), True where a pixel counts; None counts all pixels.
        """
        if self.corrected:
            a = color_corrected(a, b, mask)
        return {"PSNR": psnr(a, b, self.rounded, mask), "SSIM": ssim(a, b, self.padding, self.rounded, mask)}

    def psnr(self, a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
        """Return the PSNR of `measure` [dB] alone, which takes a fraction of the time; infinite for equal images."""
        return psnr(color_corrected(a, b, mask) if self.corrected else a, b, self.rounded, mask)

    def describe(self) -> dict[str, str]:
        """Texts on how each metric is computed, by metric; and the protocol's name."""
        images = "rounded to 8 bits" if self.rounded else "real-valued, clipped to 0..1"
        if self.corrected:
            images = f"render in the photo's exposure (affine, least squares), {images}"
        area = "windows inside the image" if self.padding == "valid" else "zero padding"
        window = f"11x11, sigma 1.5, {area}"
        name = f"{self.name}, colour-corrected" if self.corrected else self.name
        return {"name": name, "PSNR": f"per image, {images}", "SSIM": f"{window}, {images}"}


PROTOCOLS = {p.name: p for p in (MetricProtocol("clsplat", True, "valid"), MetricProtocol("3dgs", True, "zero"))}
DEFAULT_PROTOCOL = PROTOCOLS["clsplat"]


def protocol_named(name: str) -> MetricProtocol:
    """Return the protocol of that name; raise InputError, which lists the known names, for another."""
    try:
        return PROTOCOLS[name]
    except KeyError:
        raise InputError(f"unknown metrics protocol {name!r}: choose one of {', '.join(PROTOCOLS)}") from None


def color_corrected(a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """Return image `a` (H, W, 3), 0..1, after the affine map of colours that brings it nearest to `b` in least squares.

    This is for photos of unknown exposure: the error of the exposure would hide all other errors.

    Parameters
    ----------
    mask : (H, W), True where a pixel counts; None counts all pixels.

    Raises
    ------
    InputError : different or empty shapes, or not three channels.
    """
    x, y = _pair(a, b, rounded=False)
    if x.shape[2:] != (3,):
        raise InputError(f"colour correction: an image of shape {x.shape}; expected (H, W, 3)")
    inputs = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=2)
    counts = np.ones(x.shape[:2], bool) if mask is None else mask
    colour_map = np.linalg.lstsq(inputs[counts], y[counts], rcond=None)[0]
    return np.clip(inputs @ colour_map, 0.0, 1.0)


def psnr(a: NDArray[Any], b: NDArray[Any], rounded: bool = True, mask: NDArray[np.bool_] | None = None) -> float:
    """Return the peak signal-to-noise ratio [dB] over channels and pixels that count.

    It is infinite for equal images, and if no pixel counts.

    Parameters
    ----------
    a, b : (H, W) or (H, W, C), uint8 or real numbers that are clipped to 0..1.
    rounded : round both to 8 bits first, as an image file does.
    mask : (H, W), True where a pixel counts; None counts all pixels.

    Raises
    ------
    InputError : different or empty shapes.
    """
    x, y = _pair(a, b, rounded)
    squares = ((x - y) ** 2)[... if mask is None else mask]
    error = float(np.mean(squares)) if squares.size else 0.0
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


def check_sizes(sizes: Iterable[tuple[str, int, int]], source: object) -> None:
    """Raise InputError if an image is too small to be measured, before any work is done for it.

    Parameters
    ----------
    sizes : name, width and height of each image [px]. source : where they come from, for the message.
    """
    for name, width, height in sizes:
        if min(width, height) < MIN_SIDE:
            raise InputError(
                f"{source}: test view {name!r} has {width}x{height} px; SSIM needs at least {MIN_SIDE}x{MIN_SIDE}: "
                "use larger photos, or no test views"
            )


def ssim(
    a: NDArray[Any],
    b: NDArray[Any],
    padding: Padding = "valid",
    rounded: bool = True,
    mask: NDArray[np.bool_] | None = None,
) -> float:
    """Return the structural similarity (Wang et al. 2004): the mean of its map over pixels and channels.

    Parameters
    ----------
    a, b : (H, W) or (H, W, C), uint8 or real numbers that are clipped to 0..1.
    padding : "valid" uses windows inside the image only; "zero" sets zeros around it (3DGS).
    rounded : round both to 8 bits first, as an image file does.
    mask : (H, W), True where a pixel counts; None counts all pixels. Hidden pixels of `a` are set to those of `b`, and
        windows around them do not count.

    Raises
    ------
    InputError : different or empty shapes, an unknown padding, or "valid" on an image below 11 px.
    """
    if padding not in ("valid", "zero"):
        raise InputError(f"unknown SSIM padding {padding!r}: choose one of valid, zero")
    x, y = _pair(a, b, rounded)
    if padding == "valid" and min(x.shape[:2]) < MIN_SIDE:
        size = f"{x.shape[1]}x{x.shape[0]} px"
        raise InputError(f"SSIM: an image of {size} is below its 11x11 window; use zero padding (3dgs)")
    if mask is not None:
        x = np.where(mask.reshape(*mask.shape, *[1] * (x.ndim - 2)), x, y)
    similarity = np.empty_like(x)
    channels = [(..., channel) for channel in range(x.shape[2])] if x.ndim == 3 else [...]
    for channel in channels:  # one at a time, because the maps of all channels take much memory
        similarity[channel] = _similarity(x[channel], y[channel])
    if padding == "valid":
        inside = slice(SSIM_RADIUS, -SSIM_RADIUS)
        similarity, mask = similarity[inside, inside], None if mask is None else mask[inside, inside]
    # A mask can hide everything inside the border; no difference is then visible.
    counted = similarity if mask is None else similarity[mask]
    return float(np.mean(counted)) if counted.size else 1.0


def _similarity(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the map of the structural similarity of one channel, (H, W)."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 5)) as pool:  # SciPy's filters release the interpreter lock
        mean_x, mean_y, mean_xx, mean_yy, mean_xy = pool.map(_blur, (x, y, x * x, y * y, x * y))
    var_x, var_y, cov = mean_xx - mean_x * mean_x, mean_yy - mean_y * mean_y, mean_xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    structure = (2 * cov + SSIM_C2) / (var_x + var_y + SSIM_C2)
    return np.asarray(luminance * structure)


def _blur(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over SSIM's window, with zeros outside the image."""
    from scipy.ndimage import correlate1d  # slow to import

    offsets = np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
    window = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    window /= window.sum()
    for axis in (0, 1):
        image = correlate1d(image, window, axis=axis, mode="constant", cval=0.0)
    return image


def _pair(a: NDArray[Any], b: NDArray[Any], rounded: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.asarray(a), np.asarray(b)
    if x.shape != y.shape or x.ndim not in (2, 3) or x.size == 0:
        shapes = f"{x.shape} and {y.shape}"
        raise InputError(f"metrics: images of shapes {shapes}; both must be the same (H, W) or (H, W, C)")
    return _unit(x, rounded), _unit(y, rounded)


def _unit(image: NDArray[Any], rounded: bool) -> NDArray[np.float64]:
    """The image as float64 in 0..1."""
    if image.dtype == np.uint8:
        return image.astype(np.float64) / 255.0
    unit = np.clip(image.astype(np.float64), 0.0, 1.0)
    return np.rint(unit * 255.0) / 255.0 if rounded else unit
