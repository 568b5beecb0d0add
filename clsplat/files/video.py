"""Video files: H.264 in MP4, frame by frame. The only module that knows imageio."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, OutputError
from .atomic import atomic_path

SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv")
_QUALITY = "18"  # x264's rate factor: hardly told from the frames
# Colours by BT.709 and said so, as players otherwise guess by the size of the image.
_COLOURS = (
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv"
)
_OUTPUT = ["-crf", _QUALITY, "-vf", _COLOURS, "-movflags", "+faststart"]


class VideoWriter:
    """A video that becomes `path` when the `with` block ends well, and leaves nothing when it does not.

    Frames go to the encoder one by one. H.264 in yuv420p wants even sizes: an odd last column or row is repeated.

    Parameters
    ----------
    path : ends in one of SUFFIXES. fps : frames a second, above 0.

    Raises
    ------
    InputError : another ending, or no encoder installed. OutputError : the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float) -> None:
        self.path, self.fps = Path(path), float(fps)
        if self.path.suffix.lower() not in SUFFIXES:
            raise InputError(f"{self.path}: no video of a known kind; end its name in {', '.join(SUFFIXES)}")
        require_encoder()
        self.frames = 0
        self._writer: Any = None
        self._whole = contextlib.ExitStack()

    def __enter__(self) -> VideoWriter:
        self._temporary = self._whole.enter_context(atomic_path(self.path))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._finish(complete=kind is None)
        except OutputError as failure:
            if kind is None:  # else the first error is the one to tell
                self._whole.__exit__(OutputError, failure, failure.__traceback__)
                raise
        self._whole.__exit__(kind, error, trace)

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Add a frame, (H, W, 3) bytes, of the first one's size.

        Raises
        ------
        OutputError : another size, or the encoder failed.
        """
        height, width = frame.shape[:2]
        if self._writer is None:
            self._size = (height, width)
            self._open()
        if (height, width) != self._size:
            raise OutputError(
                f"{self.path}: frame {self.frames} is {width}x{height} px, the first {self._size[1]}x"
                f"{self._size[0]}; a video has one size: give --size"
            )
        even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        try:
            self._writer.append_data(even)
        except OSError as error:
            raise self._failed(error) from error
        self.frames += 1

    def _open(self) -> None:
        import imageio.v2 as imageio

        self._writer = imageio.get_writer(
            self._temporary,
            format="FFMPEG",
            mode="I",
            fps=self.fps,
            codec="libx264",
            pixelformat="yuv420p",
            macro_block_size=2,
            quality=None,
            output_params=_OUTPUT,
            ffmpeg_log_level="error",
        )

    def _finish(self, complete: bool) -> None:
        """Close the file and count its frames; raises OutputError."""
        import imageio_ffmpeg

        try:
            if self._writer is not None:
                self._writer.close()
            if not complete:
                return
            if not self.frames:
                raise OutputError(f"{self.path}: has no frames; render at least one")
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(self._temporary))
        except (OSError, RuntimeError) as error:
            raise self._failed(error) from error
        if written != self.frames:  # the encoder's exit code is not passed on
            raise OutputError(f"{self.path}: holds {written} of {self.frames} frames; check the disk's free space")

    def _failed(self, error: Exception) -> OutputError:
        reason = next((line for line in reversed(str(error).splitlines()) if line.strip()), type(error).__name__)
        return OutputError(f"{self.path}: the encoder failed ({reason.strip()[:200]}); check the disk's free space")


def require_encoder() -> None:
    """Raises InputError where the extra `video` is not installed."""
    try:
        import imageio.v2  # noqa: F401
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise InputError(f'video: needs {error.name}; pip install "clsplat[video]"') from None
