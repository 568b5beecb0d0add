"""Images of one view in a report: the photo, the render and their difference, reduced to a size that can be sent."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...files.images import encode_jpeg, resize_area
from ...rendering.colormaps import Picture, colour_map, to_bytes

LEVELS = 256  # errors are counted in steps of 8 bits
LONGEST = 800  # longer side of an image in the report [px]
_FULL_SCALES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # a few values, so that most reports have the same scale
_QUANTILE = 0.99  # share of the errors below full scale
_SAMPLES = 20_000  # pixels of a view that determine the scale
_STRIPE, _VEIL = 6, 0.7  # width of the stripes over masked pixels [px], and their opacity


@dataclass(frozen=True, eq=False)
class ComparedImage:
    """A photo and its render by one model, reduced to LONGEST.

    Parameters
    ----------
    photo, render : (h, w, 3) bytes.
    error : (h, w) bytes, absolute difference, mean over the channels.
    hidden : (h, w), True where a mask hides the pixel; None without a mask.
    counts : (LEVELS,) number of values by their absolute difference in steps of 8 bits. It counts all channels of the
        image before the reduction.
    flip : (h, w) bytes, FLIP's map; None if FLIP was not measured.
    """

    photo: Picture
    render: Picture
    error: Picture
    hidden: NDArray[np.bool_] | None
    counts: NDArray[np.int64]
    flip: Picture | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.photo.shape[1], self.photo.shape[0]


def compare_images(
    photo: Picture, color: NDArray[Any], mask: NDArray[np.bool_] | None = None, flip: NDArray[np.float32] | None = None
) -> ComparedImage:
    """Compare a view's photo with its render.

    Parameters
    ----------
    photo : (H, W, 3) bytes.
    color : (H, W, 3) reals, the render.
    mask : (H, W), True where a pixel counts; None counts all pixels.
    flip : (H, W) map, 0 to 1.
    """
    render = to_bytes(color)
    difference = np.abs(render.astype(np.int16) - photo)
    counts = np.bincount((difference if mask is None else difference[mask]).ravel(), minlength=LEVELS)
    mean = np.rint(difference.mean(axis=2)).astype(np.uint8)
    hidden = None if mask is None else _reduced(np.where(mask, np.uint8(0), np.uint8(255))) >= 128
    return ComparedImage(
        _reduced(photo),
        _reduced(render),
        _reduced(mean),
        hidden,
        counts,
        None if flip is None else _reduced(to_bytes(flip)),
    )


def full_scale(images: list[ComparedImage]) -> float:
    """Return the error (0..1) at the bright end of all maps: a round value that nearly all pixels stay below."""
    errors = [image.error if image.hidden is None else image.error[~image.hidden] for image in images]
    samples = np.concatenate([error.ravel()[:: max(error.size // _SAMPLES, 1)] for error in errors])
    high = float(np.quantile(samples, _QUANTILE)) / (LEVELS - 1) if len(samples) else 0.0
    return next(scale for scale in _FULL_SCALES if scale >= high)


def map_of(values: Picture, full: float, hidden: NDArray[np.bool_] | None) -> Picture:
    """Return values (h, w) as colours, with `full` (0..1) at the bright end; hidden pixels are striped."""
    coloured = colour_map(values.astype(np.float32) / (255.0 * full))
    return coloured if hidden is None else np.where(hidden[..., None], _stripes(*values.shape), coloured)


def veiled(picture: Picture, hidden: NDArray[np.bool_] | None) -> Picture:
    """Return the picture with grey stripes over its hidden pixels."""
    if hidden is None:
        return picture
    veil = np.rint((1.0 - _VEIL) * picture + _VEIL * _stripes(*hidden.shape)).astype(np.uint8)
    return np.where(hidden[..., None], veil, picture)


def data_uri(picture: Picture) -> str:
    """Return the picture as a URI that contains it."""
    return "data:image/jpeg;base64," + b64encode(encode_jpeg(picture)).decode()


def colour_stops(n: int = 17) -> str:
    """Return the colour map as the stops of a CSS gradient."""
    return ", ".join(f"#{bytes(colour).hex()}" for colour in colour_map(np.linspace(0.0, 1.0, n)))


def _reduced(image: Picture) -> Picture:
    height, width = image.shape[:2]
    share = min(LONGEST / max(height, width), 1.0)
    return resize_area(image, max(round(width * share), 1), max(round(height * share), 1))


def _stripes(height: int, width: int) -> Picture:
    """(height, width, 3) diagonal stripes in two greys."""
    rows, columns = np.ogrid[:height, :width]
    light = (rows + columns) // _STRIPE % 2 == 0
    return np.where(light, np.uint8(150), np.uint8(110))[..., None].repeat(3, axis=2)
