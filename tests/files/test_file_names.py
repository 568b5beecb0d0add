"""Names of files on systems that ignore case or reserve characters."""

from __future__ import annotations

from pathlib import Path

import pytest

from clsplat.errors import InputError, OutputError
from clsplat.files import file_names
from clsplat.files.atomic import atomic_path, atomic_writer
from clsplat.files.existing import refuse_existing
from clsplat.rendering import outputs
from clsplat.scenes.reconstruct.photo_files import _scene_names


@pytest.fixture(params=[False, True], ids=["case matters", "case is ignored"])
def ignores_case(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    monkeypatch.setattr(file_names, "IGNORES_CASE", request.param)
    return bool(request.param)


def test_two_views_never_share_an_image(ignores_case: bool) -> None:
    names = ["IMG_1.jpg", "img_1.png"]
    if not ignores_case:
        assert outputs.output_stems(names) == ["IMG_1", "img_1"]
        return
    with pytest.raises(InputError, match=r"views 'IMG_1.jpg' and 'img_1.png' would both be written to img_1"):
        outputs.output_stems(names)


def test_two_outputs_never_share_a_file(ignores_case: bool, tmp_path: Path) -> None:
    paths = [tmp_path / "A.json", tmp_path / "a.json"]
    if not ignores_case:
        refuse_existing(paths)
        return
    with pytest.raises(OutputError, match="is named for two files"):
        refuse_existing(paths)
    with pytest.raises(OutputError, match="is a photo of the scene"):
        refuse_existing(paths[:1], overwrite=True, inputs=paths[1:])


def test_a_link_to_a_missing_file_is_not_replaced_unasked(tmp_path: Path) -> None:
    link = tmp_path / "model.ply"
    try:
        link.symlink_to("missing.ply")
    except OSError:
        pytest.skip("no symbolic links here")
    with pytest.raises(OutputError, match="exists already"):
        refuse_existing([link])
    refuse_existing([link], overwrite=True)


def test_two_photos_never_share_a_name_in_a_scene(ignores_case: bool) -> None:
    names = _scene_names(["A.tif", "a.png", "b.tif", "B.bmp"])
    assert names == (
        ["A.tif.png", "a.png", "b.png", "B.bmp.png"] if ignores_case else ["A.png", "a.png", "b.png", "B.png"]
    )


def test_reserved_characters_are_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """A colon would write into a hidden part of the file `frame`."""
    assert outputs.output_stems(["day/frame:1.png"]) == ["day/frame:1"]
    monkeypatch.setattr(outputs, "RESERVED", frozenset('<>:"|?*'))
    with pytest.raises(InputError, match=r"^view 'day/frame:1.png': this system has no files with : in their name"):
        outputs.output_stems(["day/frame:1.png"])


def test_long_names_are_cut_and_stay_different() -> None:
    assert file_names.short_name("a" * 20, 20) == "a" * 20
    long = ["Ü" * 30 + tail for tail in ("a", "b")]
    first, second = (file_names.short_name(name, 31) for name in long)
    assert first != second
    for name in (first, second):
        assert name[:11] == "Ü" * 11
        assert len(name.encode()) <= 31


@pytest.mark.parametrize("name", ["n" * 255, "n" * 251 + ".ply", "n." + "s" * 253, "Ü" * 127])
def test_a_file_may_have_the_longest_name_of_the_file_system(tmp_path: Path, name: str) -> None:
    with atomic_writer(tmp_path / name) as stream:
        stream.write(b"whole")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with atomic_path(tmp_path / "a.ply") as temporary:
        assert temporary.suffix == ".ply"
        temporary.touch()
