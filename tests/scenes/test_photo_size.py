"""Memory of photos is estimated from their headers, and refused before a photo is decoded."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_runner import error_of
from small_scene import HEIGHT, N_VIEWS, WIDTH, write_garden

from clsplat.errors import InputError
from clsplat.scenes import photo_size, read_view
from clsplat.scenes.photo_size import check_memory, check_resolution


@pytest.mark.parametrize(("command", "kept"), [("train", N_VIEWS), ("compare", N_VIEWS - 2)])
def test_too_large_photos_are_refused_before_they_are_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, kept: int
) -> None:
    garden = write_garden(tmp_path)
    monkeypatch.setattr(read_view, "read_image", lambda *_, **options: pytest.fail("a photo was decoded"))
    message = error_of(command, garden, "-o", tmp_path / "out", "-r", 100_000)
    assert f"garden: {kept} photos of 100000x75000 px need at least " in message
    assert message.endswith("MB are free: use smaller images (-r 2, 4, 8)")


def test_the_estimate_counts_kept_and_decoded_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = 3 * 10 * (WIDTH // 2) * (HEIGHT // 2) + 2 * 3 * WIDTH * HEIGHT
    sizes = [(WIDTH, HEIGHT)] * 10
    monkeypatch.setattr(photo_size, "available_bytes", lambda: needed)
    check_memory("scene", sizes, 2)
    check_memory("scene", [], 2)
    monkeypatch.setattr(photo_size, "available_bytes", lambda: needed - 1)
    with pytest.raises(InputError, match=rf"scene: 10 photos of {WIDTH // 2}x{HEIGHT // 2} px need at least 0 MB"):
        check_memory("scene", sizes, 2)


@pytest.mark.parametrize("resolution", ["a", 2.0, None, True])
def test_a_resolution_is_a_whole_number(resolution: object) -> None:
    with pytest.raises(InputError, match=f"resolution {resolution!r}: expected a whole number: 1, 2, 4, 8"):
        check_resolution(resolution)  # type: ignore[arg-type]
