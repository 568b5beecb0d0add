"""Image files: reading, writing PNG, resizing. The only module that knows Pillow.

Images are stored pixels: an EXIF orientation is not applied, because COLMAP and 3DGS do not apply it and
camera poses refer to the pixels as stored.
"""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

# At the top on purpose: Pillow must be loaded before pycolmap, or writing PNG corrupts the heap.
from PIL import Image

from .atomic import atomic_writer
from .errors import InputError, OutputError

ImageU8 = NDArray[np.uint8]

_ALPHA_MODES = ("RGBA", "RGBa", "LA", "La", "PA")
_SIXTEEN_BIT_MODES = ("I", "I;16", "I;16B", "I;16L", "I;16N")


def read_image(path: str | os.PathLike[str]) -> ImageU8:
    """Pixels of an image file.

    Grey and palette images become RGB; 16-bit grey is rounded to 8 bits.

    Returns
    -------
    (H, W, 3), or (H, W, 4) with straight alpha where the file has transparency; uint8, 0..255.

    Raises
    ------
    InputError : the file is missing, damaged, or no image of a known kind.
    """
    with _open(path) as image:
        try:
            if image.mode in _SIXTEEN_BIT_MODES:
                grey = (np.clip(np.asarray(image), 0, 65535).astype(np.uint32) + 128) // 257
                return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
            if image.mode != "F":
                has_alpha = image.mode in _ALPHA_MODES or "transparency" in image.info
                return np.array(image.convert("RGBA" if has_alpha else "RGB"), dtype=np.uint8)
        except Exception as error:  # decoders of damaged files raise nearly anything
            raise _unreadable(path, error) from error
    raise InputError(f"{path}: float pixels are not supported; convert it to 8-bit PNG or JPEG")


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(width, height) [px] from the file's header alone.

    Raises
    ------
    InputError : the file is missing or no image of a known kind.
    """
    with _open(path) as image:
        return image.size


def write_png(path: str | os.PathLike[str], array: NDArray[np.floating] | ImageU8) -> None:
    """Write an image as 8-bit PNG, atomically.

    Parameters
    ----------
    array : (H, W), (H, W, 3) or (H, W, 4); uint8, or real numbers that are clipped to 0..1 and rounded.

    Raises
    ------
    OutputError : not an image array, NaN in it, or the file cannot be written.
    """
    pixels = np.asarray(array)
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,), (4,)) or pixels.size == 0:
        raise OutputError(f"{path}: shape {pixels.shape} is no image; expected (H, W) or (H, W, 3 or 4)")
    if pixels.dtype != np.uint8:
        if np.isnan(pixels).any():
            raise OutputError(f"{path}: the image holds NaN; the render that made it went wrong")
        pixels = np.rint(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)
    with atomic_writer(path) as stream:
        Image.fromarray(np.ascontiguousarray(pixels)).save(stream, format="PNG")


def encode_jpeg(pixels: ImageU8, quality: int = 88) -> bytes:
    """(H, W, 3) as a JPEG file with colours at full resolution, for pages that hold their images themselves."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, format="JPEG", quality=quality, subsampling=0,
                                                       optimize=True)
    return stream.getvalue()


def write_grey16(path: str | os.PathLike[str], array: NDArray[np.uint16]) -> None:
    """Write (H, W) as 16-bit grey PNG, atomically.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    with atomic_writer(path) as stream:
        Image.fromarray(np.ascontiguousarray(array, np.uint16)).save(stream, format="PNG")


def resize_area(image: ImageU8, width: int, height: int) -> ImageU8:
    """The image at another size [px], (height, width, 3 or 4); alpha weighs the colours.

    Whole-number reductions take the mean of each block of pixels; all other sizes use Pillow's bicubic
    filter, which widens when it reduces (3DGS's choice).

    Raises
    ------
    InputError : a size below 1.
    """
    if width < 1 or height < 1:
        raise InputError(f"resize: width x height is {width}x{height}; both must be at least 1")
    old_height, old_width = image.shape[:2]
    if (width, height) == (old_width, old_height):
        return image.copy()
    pillow = Image.fromarray(image)
    if old_width % width == 0 and old_height % height == 0:
        return np.array(pillow.reduce((old_width // width, old_height // height)), dtype=np.uint8)
    return np.array(pillow.resize((width, height), Image.Resampling.BICUBIC), dtype=np.uint8)


def _open(path: str | os.PathLike[str]) -> Image.Image:
    if not Path(path).exists():
        raise InputError(f"{path}: no such image file; check the name and the folder")
    try:
        return Image.open(path)
    except Exception as error:  # header parsers of damaged files raise nearly anything
        raise _unreadable(path, error) from error


def _unreadable(path: str | os.PathLike[str], error: Exception) -> InputError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    if "cannot identify" in reason:  # Pillow's message then repeats the path
        reason = "not an image of a known kind"
    return InputError(f"{path}: cannot be read as an image ({reason}); replace or remove the file")
