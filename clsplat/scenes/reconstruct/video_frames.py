"""The sharpest frames of a video, for structure from motion: ffmpeg decodes, through imageio's package."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files.video import require_encoder
from .options import FEWEST, FRAMES
from .photo_files import PhotoFile

_SIDE = 384  # frames are compared at this width and height [px]
# Frames one after another at a made-up steady rate, so that ffmpeg neither drops nor doubles any in either pass.
_RATE = ("-r", "25")
_STEADY = "setpts=N/25/TB"


def extract_frames(
    video: Path, folder: Path, frames: int = FRAMES, seen: Callable[[int], None] | None = None
) -> list[PhotoFile]:
    """Write the sharpest frame of each of `frames` equal stretches into `folder`, as JPEG.

    Sharpness is the variance of the Laplacian of the grey image.

    Parameters
    ----------
    seen : called with the number of frames looked at.

    Returns
    -------
    The frames, `frame_00017.jpg` for the video's 17th (from 0 on), in their order.

    Raises
    ------
    InputError : the extra `video` is not installed, or the file cannot be decoded or has too few frames.
    """
    require_encoder()
    sharpness = []
    for grey in _grey_frames(video):
        sharpness.append(_sharpness(grey))
        if seen is not None:
            seen(len(sharpness))
    if len(sharpness) < FEWEST:
        raise InputError(f"{video}: has {len(sharpness)} frames that can be decoded; give another video, or photos")
    chosen = sharpest(sharpness, frames)
    folder.mkdir(parents=True, exist_ok=True)
    wanted = "+".join(f"eq(n\\,{index})" for index in chosen)
    _run(
        [
            *_ffmpeg(video),
            "-vf",
            f"select={wanted},{_STEADY}",
            "-q:v",
            "1",
            "-qmin",
            "1",
            "-start_number",
            "0",
            str(folder / "%06d.jpg"),
        ],
        video,
    )
    files = []
    for order, index in enumerate(chosen):
        written, file = folder / f"{order:06}.jpg", folder / f"frame_{index:05}.jpg"
        if not written.is_file():
            raise InputError(f"{video}: frame {index} cannot be decoded; the file is damaged: copy it again")
        written.rename(file)
        files.append(PhotoFile(file.name, file))
    return files


def sharpest(sharpness: list[float], frames: int) -> list[int]:
    """Index of the greatest in each of `frames` equal stretches; all where there are no more."""
    edges = np.linspace(0, len(sharpness), min(frames, len(sharpness)) + 1).round().astype(int)
    return [int(start + np.argmax(sharpness[start:end])) for start, end in pairwise(edges)]


def _sharpness(grey: NDArray[np.uint8]) -> float:
    g = grey.astype(np.float32)
    laplacian = g[1:-1, :-2] + g[1:-1, 2:] + g[:-2, 1:-1] + g[2:, 1:-1] - 4.0 * g[1:-1, 1:-1]
    return float(laplacian.var())


def _ffmpeg(video: Path) -> list[str]:
    import imageio_ffmpeg

    return [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", *_RATE, "-i", str(video)]


def _grey_frames(video: Path) -> Iterator[NDArray[np.uint8]]:
    command = [*_ffmpeg(video), "-vf", f"scale={_SIDE}:{_SIDE},format=gray", "-f", "rawvideo", "-"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as decoder:
        assert decoder.stdout is not None
        try:
            while len(frame := decoder.stdout.read(_SIDE * _SIDE)) == _SIDE * _SIDE:
                yield np.frombuffer(frame, np.uint8).reshape(_SIDE, _SIDE)
        finally:
            decoder.kill()


def _run(command: list[str], video: Path) -> None:
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no reason given"]
        raise InputError(f"{video}: cannot be decoded ({lines[-1][:200]}); convert it to MP4 with H.264")
