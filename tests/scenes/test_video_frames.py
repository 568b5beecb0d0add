"""Frames of a video: the sharpest frame of each of equal parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from clsplat.errors import InputError
from clsplat.files.images import read_image
from clsplat.files.video import VideoWriter
from clsplat.scenes.reconstruct.video_frames import extract_frames, sharpest

pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")


def test_sharpest_frame_of_each_part() -> None:
    assert sharpest([1, 5, 2, 9, 3, 3], 3) == [1, 3, 4]
    assert sharpest([1, 2, 3, 4, 5], 2) == [1, 4]
    assert sharpest([4.0, 4.0], 10) == [0, 1]


@pytest.mark.parametrize("fps", [10, 30, 60])
def test_sharp_frames_are_extracted_in_order(tmp_path: Path, fps: int) -> None:
    """Three of twelve frames are sharp; a patch in each frame shows its number."""
    sharp = {2, 5, 10}
    noise = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    with VideoWriter(tmp_path / "walk.mp4", fps) as writer:
        for index in range(12):
            image = Image.fromarray(noise)
            picture = np.array(image if index in sharp else image.filter(ImageFilter.GaussianBlur(4)))
            picture[:40, :40] = 20 * index
            writer.write(picture)
    seen: list[int] = []
    frames = extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 3, seen.append)
    assert [frame.name for frame in frames] == ["frame_00002.jpg", "frame_00005.jpg", "frame_00010.jpg"]
    assert seen == list(range(1, 13))
    for frame in frames:
        pixels = read_image(frame.file)
        assert pixels.shape == (80, 120, 3)
        assert abs(pixels[10:30, 10:30].mean() - 20 * int(frame.name[6:11])) < 3
    everything = extract_frames(tmp_path / "walk.mp4", tmp_path / "all", 50)
    assert len(everything) == 12


def test_a_file_that_is_not_a_video(tmp_path: Path) -> None:
    (tmp_path / "walk.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match=r"walk\.mp4: has 0 frames that can be decoded"):
        extract_frames(tmp_path / "walk.mp4", tmp_path / "frames")
