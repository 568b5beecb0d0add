"""What a page of measurements shows of a view: the photo, the render and their difference, small enough to be sent."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...files.images import encode_jpeg, resize_area
from ...rendering.colormaps import Picture, colour_map, to_bytes

LEVELS = 256  # errors are counted in steps of 8 bits
LONGEST = 800  # px of a shown image's longer side
_FULL_SCALES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # for pages to agree in where they can
_QUANTILE = 0.99  # of errors below full scale
_SAMPLES = 20_000  # pixels a view that are enough for it
_STRIPE, _VEIL = 6, 0.7  # width of the stripes over masked pixels [px], and how much of the image they hide


@dataclass(frozen=True, eq=False)
class ComparedImage:
    """One view of one model, reduced to `LONGEST`; its counts are of the whole.

    Parameters
    ----------
    photo, render : (h, w, 3) bytes.
    error : (h, w) bytes, absolute difference, mean over the channels.
    hidden : (h, w), True where a mask hides the pixel; None where none does.
    counts : (LEVELS,) values of the image, all channels, by their absolute difference in steps of 8 bits.
    flip : (h, w) bytes, FLIP's map; None where it was not asked for.
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
    """A view's photo and render for the page.

    Parameters
    ----------
    photo : (H, W, 3) bytes. color : (H, W, 3) reals. mask : (H, W), True where a pixel counts; None: all do.
    flip : (H, W), 0 to 1.
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
    """The error (0..1) at the bright end of all maps: the next round one that 99 % of the pixels stay below."""
    errors = [shot.error if shot.hidden is None else shot.error[~shot.hidden] for shot in images]
    some = np.concatenate([error.ravel()[:: max(error.size // _SAMPLES, 1)] for error in errors])
    most = float(np.quantile(some, _QUANTILE)) / (LEVELS - 1) if len(some) else 0.0
    return next(scale for scale in _FULL_SCALES if scale >= most)


def map_of(values: Picture, full: float, hidden: NDArray[np.bool_] | None) -> Picture:
    """(h, w) bytes by the colour map, `full` (0..1) at its bright end; hidden pixels are striped grey."""
    coloured = colour_map(values.astype(np.float32) / (255.0 * full))
    return coloured if hidden is None else np.where(hidden[..., None], _stripes(*values.shape), coloured)


def veiled(picture: Picture, hidden: NDArray[np.bool_] | None) -> Picture:
    """The picture, its hidden pixels mostly under grey stripes."""
    if hidden is None:
        return picture
    veil = np.rint((1.0 - _VEIL) * picture + _VEIL * _stripes(*hidden.shape)).astype(np.uint8)
    return np.where(hidden[..., None], veil, picture)


def data_uri(picture: Picture) -> str:
    """The picture inside a page."""
    return "data:image/jpeg;base64," + b64encode(encode_jpeg(picture)).decode()


def colour_stops(n: int = 17) -> str:
    """The colour map as the stops of a CSS gradient."""
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
