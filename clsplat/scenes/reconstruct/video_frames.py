"""The sharpest frames of a video, for structure from motion. ffmpeg, from the package imageio-ffmpeg, decodes."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files.atomic import move
from ...files.video import require_encoder
from .options import MIN_PHOTOS, N_FRAMES
from .photo_files import PhotoFile

_SIDE = 384  # sharpness is compared at this width and height [px]
# Frames get a constant artificial rate, so that ffmpeg neither drops nor repeats a frame in either pass.
_RATE = ("-r", "25")
_STEADY = "setpts=N/25/TB"


def extract_frames(
    video: Path, folder: Path, frames: int = N_FRAMES, progress: Callable[[int], None] | None = None
) -> list[PhotoFile]:
    """Write the sharpest frame of each of `frames` equal parts of a video as JPEG.

    Sharpness is the variance of the Laplacian of the grey image.

    Parameters
    ----------
    video : the video file.
    folder : folder for the frames, created if it does not exist.
    frames : number of parts; fewer if the video has fewer frames.
    progress : called with the number of frames compared so far.

    Returns
    -------
    The frames in order. Frame 17 of the video, counted from 0, is `frame_00017.jpg`.

    Raises
    ------
    InputError : the extra `video` is not installed, or the file cannot be decoded or has too few frames.
    """
    require_encoder()
    sharpness = []
    for grey in _grey_frames(video):
        sharpness.append(_sharpness(grey))
        if progress is not None:
            progress(len(sharpness))
    if len(sharpness) < MIN_PHOTOS:
        raise InputError(f"{video}: has {len(sharpness)} frames that can be decoded; give another video, or photos")
    chosen = sharpest(sharpness, frames)
    folder.mkdir(parents=True, exist_ok=True)
    selection = "+".join(f"eq(n\\,{index})" for index in chosen)
    _run(
        [
            *_ffmpeg(video),
            "-vf",
            f"select={selection},{_STEADY}",
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
        move(written, file)
        files.append(PhotoFile(file.name, file))
    return files


def sharpest(sharpness: list[float], frames: int) -> list[int]:
    """Return the index of the maximum in each of `frames` equal parts, or all indices if there are fewer."""
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
