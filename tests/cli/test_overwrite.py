"""One rule for all commands: a file that the user names is replaced only with --overwrite."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from cli_runner import TEST_NAMES, clsplat, error_of
from clsplat_cli.main import COMMANDS, main

from clsplat.comparison.runs import RUNS
from clsplat.errors import OutputError
from clsplat.files.existing import refuse_existing

ROOT = Path(__file__).parents[2]
OLD = b"a file of the user"
TINY = ["--path", "orbit", "--frames", "2", "--size", "16x16"]
# Commands without --overwrite: why no file that the user names can be lost.
WITHOUT = {
    "devices": "writes nothing",
    "info": "writes nothing",
    "view": "numbers the recorded paths",
    "compare": "goes on with its own folder",
    "frontier": "goes on with its own folder",
    "benchmark": "goes on with its own folder",
    "worker": "writes into the folders of other commands",
}


def test_every_command_that_writes_has_the_option() -> None:
    context = click.Context(main)
    flags = {name: {param.name: param for param in main.get_command(context, name).params} for name in COMMANDS}
    assert {name for name, params in flags.items() if "overwrite" not in params} == set(WITHOUT)
    for name, params in flags.items():
        if name not in WITHOUT:
            option = params["overwrite"]
            assert isinstance(option, click.Option)
            assert (option.help or "").startswith("Replace "), name
            assert ("model" in (option.help or "")) == (name in ("train", "demo", "partition")), name


Case = Callable[[Path, Path, Path], tuple[list[object], Path]]
CASES: dict[str, Case] = {
    "render images": lambda model, scene, place: (["render", model, *TINY, "-o", place], place / "orbit_001.png"),
    "render cameras": lambda model, scene, place: (["render", model, *TINY, "-o", place], place / "cameras.json"),
    "render alpha": lambda model, scene, place: (
        ["render", model, *TINY, "--alpha", "-o", place],
        place / "orbit_000_alpha.png",
    ),
    "render arrays": lambda model, scene, place: (
        ["render", model, *TINY, "--format", "npy", "-o", place],
        place / "orbit_000.npy",
    ),
    "render path": lambda model, scene, place: (
        ["render", model, *TINY, "-o", place / "r", "--save-path", place / "p.json"],
        place / "p.json",
    ),
    "eval images": lambda model, scene, place: (["eval", model, "--save-renders", place], place / "view_008.png"),
    "eval report": lambda model, scene, place: (["eval", model, "--report", place / "r.html"], place / "r.html"),
    "blender-addon": lambda model, scene, place: (["blender-addon", "-o", place / "a.zip"], place / "a.zip"),
    "convert": lambda model, scene, place: (["convert", model, place / "c.ply"], place / "c.ply"),
    "cameras": lambda model, scene, place: (["cameras", model, place / "t.json"], place / "t.json"),
    "cameras colmap": lambda model, scene, place: (["cameras", scene, place / "c"], place / "c" / "points3D.bin"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_named_file_is_kept_unless_overwritten(case: str, copied_model: Path, scene: Path, tmp_path: Path) -> None:
    args, file = CASES[case](copied_model, scene, tmp_path / "place")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(OLD)
    assert error_of(*args) == f"error: {file}: exists already: use --overwrite or another name"
    assert file.read_bytes() == OLD
    assert [path for path in (tmp_path / "place").rglob("*") if path.is_file()] == [file], "the check comes first"
    clsplat(*args, "--overwrite")
    assert file.read_bytes() != OLD


@pytest.mark.parametrize("extra", ["", "_depth"])
def test_a_video_is_kept(model: Path, tmp_path: Path, extra: str) -> None:
    pytest.importorskip("imageio_ffmpeg")
    file = tmp_path / f"v{extra}.mp4"
    file.write_bytes(OLD)
    args = ["render", model, *TINY, "--depth", "--video", tmp_path / "v.mp4"]
    assert f"{file}: exists already" in error_of(*args)
    assert file.read_bytes() == OLD
    clsplat(*args, "--overwrite")
    assert file.stat().st_size > len(OLD)


def test_the_demo_keeps_renders(tmp_path: Path) -> None:
    (tmp_path / "renders").mkdir()
    assert f"{tmp_path / 'renders'}: exists already" in error_of("demo", tmp_path)
    assert not (tmp_path / "scene").exists()


def test_clsplats_own_files_in_a_model_are_written_again(copied_model: Path) -> None:
    clsplat("eval", copied_model)
    (copied_model / "results.json").write_text("{}")
    clsplat("eval", copied_model)
    assert json.loads((copied_model / "results.json").read_text())


@pytest.mark.parametrize(("command", "name"), [("compare", "results.json"), ("frontier", "report.html")])
def test_comparisons_refuse_files_of_others(scene: Path, tmp_path: Path, command: str, name: str) -> None:
    (tmp_path / name).write_bytes(OLD)
    args = [command, scene, "-o", tmp_path, "--systems", "gaussian", "--iterations", "1", "--cap-max", "9", "-q"]
    assert f"{tmp_path / name}: exists already, but no {RUNS}" in error_of(*args)
    assert {path.name for path in tmp_path.iterdir()} == {name}


def test_devices_and_folders_are_never_replaced(tmp_path: Path) -> None:
    for path in (Path("/dev/null"), tmp_path):
        with pytest.raises(OutputError, match="is not a file"):
            refuse_existing([path], overwrite=True)


def test_the_pages_of_the_functions_are_kept(tmp_path: Path) -> None:
    pytest.importorskip("pdoc")
    (tmp_path / "index.html").write_bytes(OLD)
    command = [sys.executable, str(ROOT / "docs" / "api.py"), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "exists already" in result.stderr
    assert (tmp_path / "index.html").read_bytes() == OLD


def test_eval_never_replaces_the_photos_that_it_measures(copied_model: Path, scene: Path, tmp_path: Path) -> None:
    own = shutil.copytree(scene, tmp_path / "scene")
    photo = own / "images" / TEST_NAMES[0]
    before = photo.read_bytes()
    (tmp_path / "link").symlink_to(own / "images")
    for place in (own / "images", tmp_path / "link"):
        message = error_of("eval", copied_model, "-s", own, "--save-renders", place, "--overwrite")
        assert f"{place / TEST_NAMES[0]}: is a photo of the scene" in message
    assert photo.read_bytes() == before


def test_two_results_in_one_file(model: Path, tmp_path: Path) -> None:
    one = tmp_path / "one"
    assert "is named for two files" in error_of("eval", model, "--json", one, "--report", one)
    assert not one.exists()
