"""Video files: H.264 in MP4, written frame by frame. This is the only module that uses imageio."""

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

LONGEST_SIDE = 16384  # of a frame [px], for x264
SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv")
_QUALITY = "18"  # x264's constant rate factor: hardly different from the frames by eye
# Colours follow BT.709, and the file says so. Players would otherwise guess from the size of the image.
_COLOURS = (
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv"
)
_OUTPUT = ["-crf", _QUALITY, "-vf", _COLOURS, "-movflags", "+faststart"]


class VideoWriter:
    """A video that becomes `path` if the `with` block succeeds, and leaves no file if it fails.

    Frames go to the encoder one by one. H.264 in yuv420p needs even sizes, so an odd last column or row is repeated.

    Parameters
    ----------
    path : file to write; its suffix is one of SUFFIXES.
    fps : frames per second, above 0.

    Raises
    ------
    InputError : another suffix, or no encoder is installed.
    OutputError : the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float) -> None:
        self.path, self.fps = Path(path), float(fps)
        if self.path.suffix.lower() not in SUFFIXES:
            raise InputError(
                f"{self.path}: not a supported video format; use one of the suffixes {', '.join(SUFFIXES)}"
            )
        require_encoder()
        self.frames = 0
        self._writer: Any = None
        self._is_finished = False
        self._whole = contextlib.ExitStack()

    def __enter__(self) -> VideoWriter:
        self._temporary = self._whole.enter_context(atomic_path(self.path))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if not self._is_finished:
                self._finish(complete=kind is None)
        except OutputError as failure:
            if kind is None:  # otherwise the first error is raised
                self._whole.__exit__(OutputError, failure, failure.__traceback__)
                raise
        self._whole.__exit__(kind, error, trace)

    def finish(self) -> None:
        """Complete the file under its temporary name, so that the end of the block has only to rename it.

        Raises
        ------
        OutputError : frames are missing, or the encoder failed.
        """
        self._finish(complete=True)
        self._is_finished = True

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Add a frame, (H, W, 3), of the first frame's size.

        Raises
        ------
        OutputError : the frame has another size, or the encoder failed.
        """
        height, width = frame.shape[:2]
        if self._writer is None:
            check_frame_size(self.path, width, height)
            self._size = (height, width)
            self._open()
        if (height, width) != self._size:
            raise OutputError(
                f"{self.path}: frame {self.frames} is {width}x{height} px, the first {self._size[1]}x"
                f"{self._size[0]}; all frames of a video have one size: set --size"
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
            ffmpeg_log_level="quiet",  # a failure is found below, and becomes one line
        )

    def _finish(self, complete: bool) -> None:
        """Close the file and count its frames; raises OutputError if frames are missing."""
        import imageio_ffmpeg

        try:
            if self._writer is not None:
                self._writer.close()
            if not complete:
                return
            if not self.frames:
                raise OutputError(f"{self.path}: the video has no frames; render at least one")
        except (OSError, RuntimeError) as error:
            raise self._failed(error) from error
        try:
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(self._temporary))
        except (OSError, RuntimeError):
            raise OutputError(f"{self.path}: the encoder wrote no whole video; check the disk's free space") from None
        if written != self.frames:  # imageio does not report the encoder's exit code
            raise OutputError(f"{self.path}: holds {written} of {self.frames} frames; check the disk's free space")

    def _failed(self, error: Exception) -> OutputError:
        reason = next((line for line in reversed(str(error).splitlines()) if line.strip()), type(error).__name__)
        return OutputError(f"{self.path}: the encoder failed ({reason.strip()[:200]}); check the disk's free space")


def check_frame_size(path: object, width: int, height: int) -> None:
    """Raise InputError if the encoder cannot write frames of a size [px]."""
    if max(width, height) > LONGEST_SIDE:
        raise InputError(
            f"{path}: frames of {width}x{height} px; a video has at most {LONGEST_SIDE} px a side: choose a smaller "
            "size, or write images"
        )


def require_encoder() -> None:
    """Check that the extra `video` is installed; raises InputError if not."""
    try:
        import imageio.v2  # noqa: F401
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise InputError(f'video: needs {error.name}; pip install "clsplat[video]"') from None
