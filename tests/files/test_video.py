"""Videos decoded again: frames, size, rate and colours. An unfinished video leaves no file."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError, OutputError
from clsplat.files.video import VideoWriter
from clsplat.rendering.outputs import EXTRAS, VideoFiles
from clsplat.rendering.renderer import Rendered

pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
imageio = pytest.importorskip("imageio.v2")


def frame(index: int, height: int, width: int) -> np.ndarray:
    """A bright square that moves to the right over a colour gradient."""
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = np.linspace(40, 200, width)[None, :, None] * [1.0, 0.5, 0.25]
    picture[10:20, 4 * index : 4 * index + 10] = (230, 220, 60)
    return picture


def test_decoded_frames_are_those_written(tmp_path: Path) -> None:
    frames = [frame(index, 48, 80) for index in range(7)]
    with VideoWriter(tmp_path / "deep" / "v.mp4", 12.5) as video:
        for picture in frames:
            video.write(picture)
        assert not (tmp_path / "deep" / "v.mp4").exists()
    with imageio.get_reader(tmp_path / "deep" / "v.mp4") as reader:
        about, read = reader.get_meta_data(), list(reader.iter_data())
    assert (about["codec"], about["size"], about["fps"]) == ("h264", (80, 48), 12.5)
    assert about["pix_fmt"] == "yuv420p(tv, bt709, progressive)"
    assert len(read) == 7
    for picture, decoded in zip(frames, read, strict=True):
        error = np.abs(picture.astype(int) - decoded)
        assert error.mean() < 3
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["v.mp4"]


def test_colours_come_back(tmp_path: Path) -> None:
    """The file states BT.709. A decoder that assumed BT.601 would be 10 steps off."""
    picture = np.empty((48, 80, 3), np.uint8)
    picture[:, :40], picture[:, 40:] = (20, 150, 60), (210, 60, 40)
    with VideoWriter(tmp_path / "v.mp4", 30) as video:
        video.write(picture)
    with imageio.get_reader(tmp_path / "v.mp4") as reader:
        decoded = reader.get_data(0).astype(int)
    assert np.abs(decoded - picture)[:, [10, 60]].max() <= 3


def test_odd_sizes_repeat_their_last_column_and_row(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "v.mp4", 30) as video:
        video.write(np.full((47, 79, 3), 180, np.uint8))
    with imageio.get_reader(tmp_path / "v.mp4") as reader:
        decoded = reader.get_data(0).astype(int)
    assert decoded.shape == (48, 80, 3)
    assert np.abs(decoded - 180).max() <= 3


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_nothing_is_left_of_an_interrupted_video(tmp_path: Path, error: type[BaseException]) -> None:
    (tmp_path / "v.mp4").write_bytes(b"old")

    def interrupted() -> None:
        with VideoWriter(tmp_path / "v.mp4", 30) as video:
            for index in range(3):
                video.write(frame(index, 48, 80))
            raise error

    with pytest.raises(error):
        interrupted()
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("v.mp4", b"old")]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 100 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", folder], capture_output=True).returncode:
        pytest.skip("file systems cannot be mounted here")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_full_disk_is_one_error_and_the_encoder_says_nothing(
    small_disk: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)

    def write() -> None:
        with VideoWriter(small_disk / "v.mp4", 30) as video:
            for _ in range(60):
                video.write(rng.integers(0, 256, (96, 128, 3)).astype(np.uint8))

    with pytest.raises(OutputError, match=r"v\.mp4: .*check the disk's free space"):
        write()
    assert capfd.readouterr() == ("", "")
    assert list(small_disk.iterdir()) == []


def test_errors_name_the_fault(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"v\.avi: not a supported video format"):
        VideoWriter(tmp_path / "v.avi", 30)
    with pytest.raises(OutputError, match="no frames"), VideoWriter(tmp_path / "v.mp4", 30):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), VideoWriter(tmp_path / "file" / "v.mp4", 30):
        pass
    with VideoWriter(tmp_path / "v.mp4", 30) as video:
        video.write(frame(0, 48, 80))
        with pytest.raises(OutputError, match="frame 1 is 80x50 px"):
            video.write(frame(0, 50, 80))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "v.mp4"]


def test_an_encoder_that_dies_is_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.files.video._OUTPUT", ["-no_such_option", "1"])

    def written() -> None:
        with VideoWriter(tmp_path / "v.mp4", 30) as video:
            for index in range(200):
                video.write(frame(index % 8, 480, 640))

    with pytest.raises(OutputError, match=r"v\.mp4: ") as caught:
        written()
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def rendered_views(number: int) -> Iterator[Rendered]:
    color = np.linspace(0, 1, 24 * 32 * 3, dtype=np.float32).reshape(24, 32, 3)
    for _ in range(number):
        yield Rendered(color, color[..., 0], 2 * color[..., 0])


def test_videos_appear_together_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A signal while an encoder finishes left the depth without its colours, which a second run refused to replace."""
    finished: list[Path] = []
    real, interrupted_at = VideoWriter.finish, [0]

    def finish(writer: VideoWriter) -> None:
        if len(finished) == interrupted_at[0]:
            raise KeyboardInterrupt
        real(writer)
        finished.append(writer.path)
        assert not list(tmp_path.glob("v*.mp4")), "none has its name yet"

    def write() -> None:
        finished.clear()
        with VideoFiles(tmp_path / "v.mp4", 24, EXTRAS, (0.5, 3.0)) as videos:
            for image in rendered_views(2):
                videos.write("a", image)

    monkeypatch.setattr(VideoWriter, "finish", finish)
    for interrupted_at[0] in range(3):
        with pytest.raises(KeyboardInterrupt):
            write()
        assert not list(tmp_path.iterdir()), "nor is a temporary file left"
    interrupted_at[0] = 3
    write()
    assert {path.name for path in tmp_path.iterdir()} == {"v.mp4", "v_alpha.mp4", "v_depth.mp4"}


def test_a_missing_encoder_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"clsplat\[video\]"):
        VideoWriter(tmp_path / "v.mp4", 30)
