"""Image files: reading, writing and resizing. This is the only module that uses Pillow.

Images are read as stored: the EXIF orientation is not applied. COLMAP and 3DGS do not apply it either, and camera poses
refer to the stored pixels. Photos without poses are read upright, and those whose cameras fit in no other way.
"""

from __future__ import annotations

import io
import os
import threading
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

# Pillow must be loaded before pycolmap, or writing PNG corrupts the heap. So this import stays at the top.
from PIL import ExifTags, Image, ImageOps, PngImagePlugin, features

from ..errors import InputError, OutputError
from .atomic import atomic_writer
from .image_names import CONVERTERS, HEIC_REMEDY, JPEG_SUFFIXES, READS_HEIC

ImageU8 = NDArray[np.uint8]

_MARK = ("Software", "clsplat render")  # text in the PNG of a render
_MARK_BYTES = 256  # the mark is before the pixels, within this number of bytes
# Formats that photos have. Pillow starts other programs for some of the others, such as Ghostscript for EPS.
_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "DIB", "GIF", "PPM", "AVIF", "JPEG2000", "HEIF")
MAX_PIXELS = 400_000_000  # larger than the photo of any camera; a file that claims more is damaged or an attack
_HEIC = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1")  # brands of ISO/IEC 23008-12
_PHOTO_QUALITY = 97  # of a JPEG made from another JPEG: the second compression adds little error to the first
_WEBP_METHOD, _WEBP_EFFORT = 2, 80  # of lossless WebP: more effort takes many times longer and saves less than 1 %
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"  # the last chunk: its length, its name and its checksum
_ALPHA_MODES = ("RGBA", "RGBa", "LA", "La", "PA")
_SIXTEEN_BIT_MODES = ("I", "I;16", "I;16B", "I;16L", "I;16N")


@dataclass(frozen=True)
class PhotoHeader:
    """The header of a photo.

    Parameters
    ----------
    width, height : size of the upright photo [px].
    plain : True for 8-bit RGB or grey in JPEG or PNG, stored upright; every program reads such photos alike.
    camera : maker, model and focal lengths from EXIF; photos with equal sizes and cameras share one lens.
    exif : EXIF data without the orientation, for a copy of the photo.
    """

    width: int
    height: int
    plain: bool
    camera: tuple[str, ...]
    exif: bytes


def read_image(
    path: str | os.PathLike[str], upright: bool = False, opaque_size: tuple[int, int] | None = None
) -> ImageU8:
    """Return the pixels of an image file.

    Grey, palette and CMYK images become RGB; 16-bit grey is rounded to 8 bits, 16-bit colour keeps its high byte.

    Parameters
    ----------
    upright : whether to turn the image by its EXIF orientation.
    opaque_size : (width, height) to resize an image without transparency to, with the result of `resize_area` but
        without an array of the full size [px]. An image with transparency keeps its size.

    Returns
    -------
    (H, W, 3), or (H, W, 4) with straight alpha if the file has transparency; uint8, 0..255.

    Raises
    ------
    InputError : the file is missing, damaged, or not an image of a supported format.
    """
    with _open(path) as stored:
        try:
            image = ImageOps.exif_transpose(stored) if upright else stored
            if image.mode in _SIXTEEN_BIT_MODES:
                grey = (np.clip(np.asarray(image), 0, 65535).astype(np.uint32) + 128) // 257
                pixels = np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
                return pixels if opaque_size is None else resize_area(pixels, *opaque_size)
            if image.mode != "F":
                transparent = _is_transparent(image)
                mode = "RGBA" if transparent else "RGB"
                pillow = image if image.mode == mode else image.convert(mode)
                if opaque_size is not None and not transparent:
                    pillow = _resized(pillow, *opaque_size)
                return np.array(pillow, dtype=np.uint8)
        except Exception as error:  # decoders of damaged files raise nearly anything
            raise _unreadable(path, error) from error
    raise InputError(f"{path}: float pixels are not supported; convert it to 8-bit PNG or JPEG")


def decode_pixels(data: bytes, name: str, max_pixels: int) -> ImageU8:
    """Return the pixels (H, W, 4) of an image in memory.

    max_pixels : largest number of its pixels. A few bytes can be a huge image.

    Raises
    ------
    InputError : the data are not an image, or one that is too large. The message names it `name`.
    """
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
            width, height = image.size
            if width * height <= max_pixels:
                return np.array(image.convert("RGBA"), dtype=np.uint8)
    except Exception:  # decoders of damaged files raise nearly anything
        raise InputError(f"{name}: cannot be read as an image; export it again") from None
    raise InputError(f"{name}: is {width}x{height} px, far more than its splats need; export it again")


def encode_pixels(pixels: ImageU8) -> bytes:
    """Return (H, W, 4) as the bytes of a lossless WebP file, which keeps the colours of transparent pixels as well.

    Raises
    ------
    OutputError : this Pillow cannot write WebP.
    """
    if not features.check("webp"):
        raise OutputError("this Pillow cannot write WebP images: install it anew with `pip install pillow`")
    stream = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(pixels))
    image.save(stream, format="WEBP", lossless=True, exact=True, method=_WEBP_METHOD, quality=_WEBP_EFFORT)
    return stream.getvalue()


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Return (width, height) [px], read from the file's header alone.

    Raises
    ------
    InputError : the file is missing or not an image of a supported format.
    """
    with _open(path) as image:
        return image.size


def has_alpha(path: str | os.PathLike[str]) -> bool:
    """Return whether an image has transparency, read from the file's header alone. Raises as `image_size`."""
    with _open(path) as image:
        return _is_transparent(image)


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in _ALPHA_MODES or "transparency" in image.info


def read_photo_header(path: str | os.PathLike[str]) -> PhotoHeader:
    """Return a photo's size, format and camera without decoding its pixels.

    Only a PNG is read to its end, because its EXIF data may follow the pixels.

    Raises
    ------
    InputError : the file is missing or not an image of a supported format.
    """
    with _open(path) as image:
        # Pillow reports 16-bit colour PNG as RGB. Before decoding, the tile's raw mode shows the true depth.
        deep = any(";16" in str(tile[-1]) for tile in getattr(image, "tile", ()))
        try:
            exif = image.getexif()
            orientation = exif.pop(ExifTags.Base.Orientation, 1)
            details = exif.get_ifd(ExifTags.IFD.Exif)
            camera = [
                exif.get(ExifTags.Base.Make),
                exif.get(ExifTags.Base.Model),
                details.get(ExifTags.Base.FocalLength),
                details.get(ExifTags.Base.FocalLengthIn35mmFilm),
            ]
            exif_bytes = exif.tobytes()
        except Exception:  # a damaged EXIF block raises nearly anything; the pixels may be sound
            orientation, camera, exif_bytes = 1, [], b""
        width, height = image.size[::-1] if orientation in (5, 6, 7, 8) else image.size
        plain = orientation == 1 and image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L") and not deep
        plain = plain and "transparency" not in image.info
        return PhotoHeader(width, height, plain, tuple(str(value) for value in camera if value), exif_bytes)


def is_whole(path: str | os.PathLike[str]) -> bool:
    """Return whether a JPEG or PNG ends as it should. Other files count as not whole: decode them to be sure."""
    try:
        with open(path, "rb") as stream:
            start = stream.read(2)
            stream.seek(-len(_PNG_END), os.SEEK_END)
            end = stream.read()
    except OSError:
        return False
    return end == _PNG_END if start == b"\x89P" else start == _JPEG_START and end.endswith(_JPEG_END)


def is_render(path: Path) -> bool:
    """Return whether a file is a PNG that `write_png` or `write_grey16` wrote as a render."""
    if not path.is_file():  # opening a pipe would wait for ever
        return False
    try:
        with path.open("rb") as stream:
            return "\0".join(_MARK).encode() in stream.read(_MARK_BYTES)
    except OSError:
        return False


def write_png(path: str | os.PathLike[str], array: NDArray[np.floating] | ImageU8, render: bool = False) -> None:
    """Write an image as 8-bit PNG, atomically.

    Parameters
    ----------
    array : (H, W), (H, W, 3) or (H, W, 4), uint8 or real; real numbers are clipped to 0..1 and rounded.
    render : mark the file as a render, so that it is never taken for a photo.

    Raises
    ------
    OutputError : the array is not an image or contains NaN, or the file cannot be written.
    """
    pixels = np.asarray(array)
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,), (4,)) or pixels.size == 0:
        raise OutputError(f"{path}: shape {pixels.shape} is not an image; expected (H, W) or (H, W, 3 or 4)")
    if pixels.dtype != np.uint8:
        if np.isnan(pixels).any():
            raise OutputError(f"{path}: the image contains NaN; the render that made it failed")
        pixels = np.rint(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)
    with atomic_writer(path) as stream:
        _save_png(stream, pixels, render)


def encode_render(pixels: ImageU8) -> bytes:
    """Return (H, W, 3) as the bytes of the file that `write_png` writes for a render."""
    stream = io.BytesIO()
    _save_png(stream, pixels, render=True)
    return stream.getvalue()


def _save_png(stream: BinaryIO, pixels: ImageU8, render: bool) -> None:
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, format="PNG", pnginfo=_mark() if render else None)


def write_photo(path: str | os.PathLike[str], pixels: ImageU8, exif: bytes = b"") -> None:
    """Write a photo atomically: (H, W, 3) as JPEG of high quality or PNG by the suffix of `path`, (H, W, 4) as PNG.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    jpeg = Path(path).suffix.lower() in JPEG_SUFFIXES
    options = {"quality": _PHOTO_QUALITY, "subsampling": 0} if jpeg else {}
    with atomic_writer(path) as stream:
        Image.fromarray(np.ascontiguousarray(pixels)).save(
            stream, format="JPEG" if jpeg else "PNG", exif=exif, **options
        )


def encode_jpeg(pixels: ImageU8, quality: int = 88) -> bytes:
    """Return (H, W, 3) as the bytes of a JPEG file with colours at full resolution, for images inside HTML pages."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(
        stream, format="JPEG", quality=quality, subsampling=0, optimize=True
    )
    return stream.getvalue()


def write_grey16(path: str | os.PathLike[str], array: NDArray[np.uint16]) -> None:
    """Write (H, W) as 16-bit grey PNG, atomically, and mark it as a render.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    with atomic_writer(path) as stream:
        Image.fromarray(np.ascontiguousarray(array, np.uint16)).save(stream, format="PNG", pnginfo=_mark())


def same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes (width, height) can be one image at two scales, up to rounding to whole pixels."""
    return abs(size[0] * other[1] - size[1] * other[0]) < other[0] + other[1]


def resize_area(image: ImageU8, width: int, height: int) -> ImageU8:
    """Return the image at another size [px].

    A reduction by whole numbers takes the mean of each block of pixels. Other sizes use Pillow's bicubic filter, as
    3DGS does; Pillow widens the filter when it reduces an image. Colours are weighted by alpha.

    Parameters
    ----------
    image : (H, W), (H, W, 3) or (H, W, 4).

    Raises
    ------
    InputError : width or height below 1.
    """
    if width < 1 or height < 1:
        raise InputError(f"resize: width x height is {width}x{height}; both must be at least 1")
    old_height, old_width = image.shape[:2]
    if (width, height) == (old_width, old_height):
        return image.copy()
    return np.array(_resized(Image.fromarray(image), width, height), dtype=np.uint8)


def _resized(image: Image.Image, width: int, height: int) -> Image.Image:
    """Return an image at another size, for `resize_area`."""
    old_width, old_height = image.size
    if (width, height) == (old_width, old_height):
        return image
    if old_width % width == 0 and old_height % height == 0:
        return image.reduce((old_width // width, old_height // height))
    return image.resize((width, height), Image.Resampling.BICUBIC)


def _mark() -> PngImagePlugin.PngInfo:
    info = PngImagePlugin.PngInfo()
    info.add_text(*_MARK)
    return info


def _open(path: str | os.PathLike[str]) -> Image.Image:
    # os.path answers False for impossible names, where pathlib raises. Opening a pipe would wait for ever.
    if not os.path.isfile(path):
        if os.path.exists(path):
            kind = "a folder" if os.path.isdir(path) else "not a regular file"
            raise InputError(f"{path}: is {kind}, not an image; replace or remove it")
        raise InputError(f"{path}: no such image file; check the name and the folder")
    try:
        image = _open_unlimited(Path(path))
    except Exception as error:  # header parsers of damaged files raise nearly anything
        raise _unreadable(path, error) from error
    width, height = image.size
    if width * height > MAX_PIXELS:
        image.close()
        raise InputError(
            f"{path}: has {width}x{height} px, more than {MAX_PIXELS // 1_000_000} megapixels; replace or reduce it"
        )
    return image


_limit_lock = threading.Lock()


def _open_unlimited(file: Path) -> Image.Image:
    """Open a file without Pillow's limit of pixels, which warns at 89 megapixels. The limit is a global variable."""
    with _limit_lock:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(file, formats=_known_formats())
        finally:
            Image.MAX_IMAGE_PIXELS = limit


@cache
def _known_formats() -> tuple[str, ...]:
    """Return the formats of photos that this Pillow can read."""
    Image.init()
    if READS_HEIC:
        from pillow_heif import register_heif_opener

        register_heif_opener()
    return tuple(name for name in _FORMATS if name in Image.OPEN)


def _unreadable(path: str | os.PathLike[str], error: Exception) -> InputError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    if "cannot identify" in reason:  # Pillow's message would repeat the path
        reason = "not an image of a supported format"
        if not READS_HEIC and _is_heic(Path(path)):
            return InputError(
                f"{path}: is a HEIC image: {HEIC_REMEDY}, or convert it to JPEG with {CONVERTERS['.heic']}"
            )
    converter = CONVERTERS.get(Path(path).suffix.lower())
    remedy = f"convert it to PNG or JPEG with {converter}" if converter else "replace or remove the file"
    return InputError(f"{path}: cannot be read as an image ({reason}); {remedy}")


def _is_heic(file: Path) -> bool:
    with file.open("rb") as stream:
        head = stream.read(12)
    return head[4:8] == b"ftyp" and head[8:] in _HEIC
