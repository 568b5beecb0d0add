"""Zstandard compression: of the standard library from Python 3.14 on, before that of the package zstandard."""

from __future__ import annotations

import io
import sys

from ..errors import ClsplatError, InputError

_LEVEL = 12
_CHUNK = 1 << 22
_MISSING = "needs Zstandard: pip install 'clsplat[spz]'"


class ZstdMissingError(ClsplatError):
    """Zstandard is not installed. The message says how to install it."""


def compress(data: bytes) -> bytes:
    """Return one frame that contains the data and its length.

    Raises
    ------
    ZstdMissingError : Zstandard is not installed.
    """
    if sys.version_info >= (3, 14):
        from compression import zstd

        return zstd.compress(data, level=_LEVEL)
    try:
        import zstandard
    except ImportError:
        raise ZstdMissingError(_MISSING) from None
    return zstandard.ZstdCompressor(level=_LEVEL).compress(data)


def decompress(data: bytes, size: int) -> bytes:
    """Return the content of the first frame, which must have `size` bytes. Memory for more is never allocated.

    Raises
    ------
    ZstdMissingError : Zstandard is not installed.
    InputError : the data are damaged, or their content has another size. The message names no file.
    """
    if sys.version_info >= (3, 14):
        from compression import zstd

        failure: type[Exception] = zstd.ZstdError
        stream: io.BufferedIOBase = zstd.ZstdFile(io.BytesIO(data))
    else:
        try:
            import zstandard
        except ImportError:
            raise ZstdMissingError(_MISSING) from None
        failure = zstandard.ZstdError
        stream = zstandard.ZstdDecompressor().stream_reader(data)
    content = bytearray()
    try:
        while len(content) <= size and (chunk := stream.read(min(_CHUNK, size + 1 - len(content)))):
            content += chunk
    except (failure, EOFError, MemoryError) as error:
        raise InputError(f"compressed data are damaged ({error})") from None
    if len(content) != size:
        held = "more" if len(content) > size else str(len(content))
        raise InputError(f"compressed data hold {held} instead of {size} bytes")
    return bytes(content)
