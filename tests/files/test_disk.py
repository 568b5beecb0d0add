"""Full disks, read-only folders and files in the way: the error is one line, and no existing file is lost."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from cli_runner import SHORT, clsplat, error_of, run
from files.test_lock import HOLD
from set_folders import as_colmap

from clsplat.splats.splats import Splats
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.folder import ModelFolder


@contextmanager
def mounted(folder: Path, *options: str) -> Iterator[Path]:
    """Mount a file system on the folder during the block; skip the test if that is not permitted."""
    folder.mkdir(exist_ok=True)
    command = ["mount", *options, str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("may not mount here: needs root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@contextmanager
def read_only(folder: Path) -> Iterator[Path]:
    with mounted(folder, "--bind", str(folder)):
        subprocess.run(["mount", "-o", "remount,ro,bind", str(folder)], check=True, capture_output=True)
        yield folder


def test_a_disk_that_fills_up_keeps_the_last_checkpoint(capture_folder: Path, tmp_path: Path) -> None:
    """The disk has room for one checkpoint. With more room the run resumes, with the bits of an undisturbed run."""
    common = ["train", capture_folder, "--checkpoint-interval", "20", "--quiet", *SHORT, "-m"]
    clsplat(*common, tmp_path / "peace")
    size = (tmp_path / "peace" / "checkpoint.npz").stat().st_size
    with mounted(tmp_path / "disk", "-t", "tmpfs", "-o", f"size={size * 3 // 2 // 4096 * 4}k", "tmpfs") as disk:
        folder = ModelFolder(disk / "model")
        message = error_of(*common, folder.path)
        assert "No space left on device" in message
        assert "free some space" in message
        assert 0 < Checkpoint.load(folder.checkpoint_path).iteration < 60
        assert not list(disk.rglob(".*.tmp*"))
        subprocess.run(["mount", "-o", "remount,size=50m", str(disk)], check=True)
        clsplat("train", "--resume", "-m", folder.path, "--quiet")
        assert folder.ply_path(60).read_bytes() == ModelFolder(tmp_path / "peace").ply_path(60).read_bytes()


def test_a_disk_that_is_too_small_for_a_run_keeps_the_old_model(capture_folder: Path, tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "-t", "tmpfs", "-o", "size=2m", "tmpfs") as disk:
        folder = ModelFolder(disk / "model")
        clsplat("train", capture_folder, "-m", folder.path, "--quiet", *SHORT)
        before = {file: file.read_bytes() for file in folder.path.rglob("*") if file.is_file()}
        larger = ["--overwrite", *SHORT, "--init", "random", "--cap-max", 20_000]
        message = error_of("train", capture_folder, "-m", folder.path, *larger)
        need = re.search(r"its disk has (\S+) MB for a model and a checkpoint, which need at least (\S+) MB", message)
        assert need is not None
        assert 1.5 < float(need[1]) < 2.1, "with what the old model takes"
        assert float(need[2]) > 2.1
        assert "free some space, or choose another folder" in message
        assert {file: file.read_bytes() for file in folder.path.rglob("*") if file.is_file()} == before
        clsplat("train", capture_folder, "-m", folder.path, "--quiet", "--overwrite", *SHORT)


def test_a_full_disk_keeps_old_files(model_folder: Path, tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "-t", "tmpfs", "-o", "size=64k", "tmpfs") as disk:
        for name in ("a.ply", "a.spz", "a.splat", "t.json"):
            (disk / name).write_bytes(b"old")
        with (disk / "rest").open("wb", buffering=0) as rest, suppress(OSError):
            while rest.write(bytes(4096)):
                pass
        for name in ("a.ply", "a.spz", "a.splat"):
            assert "No space left" in error_of("convert", model_folder, disk / name, "--approximate", "--overwrite")
        assert "No space left" in error_of("cameras", model_folder, disk / "t.json", "--overwrite")
        assert "No space left" in error_of("render", model_folder, "-o", disk / "renders", "--quiet")
        assert "its disk has 0 MB" in error_of("train", small_scene(model_folder), "-m", disk / "model", *SHORT)
        for name in ("a.ply", "a.spz", "a.splat", "t.json"):
            assert (disk / name).read_bytes() == b"old"


def small_scene(model: Path) -> Path:
    return Path(str(ModelFolder(model).read_config()["scene"]["path"]))


@pytest.mark.parametrize("kind", ["read-only", "a file"])
def test_places_that_take_no_files(capture_folder: Path, model_folder: Path, tmp_path: Path, kind: str) -> None:
    place, tanks = tmp_path / "place", tmp_path / "tanks"
    as_colmap(capture_folder, tanks / "truck")
    commands = [
        ["train", capture_folder, "-m", place / "m", *SHORT],
        ["train", capture_folder, "-m", place / "m", "--budget", "auto", *SHORT],
        ["convert", model_folder, place / "o.ply"],
        ["cameras", model_folder, place / "t.json"],
        ["cameras", model_folder, place / "sparse" / "0"],
        ["render", model_folder, "-o", place / "r"],
        ["prune", model_folder, "-o", place / "p.ply"],
        ["clean", model_folder, "-o", place / "c.ply"],
        ["clean", model_folder, "-o", place / "cleaned"],
        ["compare", capture_folder, "-o", place / "c"],
        ["frontier", capture_folder, "-o", place / "f"],
        ["benchmark", "tanks", tanks, "-o", place / "b"],
        ["blender-addon", "-o", place / "a.zip"],
    ]
    if kind == "a file":
        place.write_bytes(b"mine")
        for command in commands:
            assert str(place) in refused(*command)
        assert place.read_bytes() == b"mine"
        return
    place.mkdir()
    with read_only(place):
        for command in commands:
            message = refused(*command)
            assert str(place) in message
            assert "Read-only file system" in message
        assert not list(place.iterdir())


def refused(*command: object) -> str:
    """The last line of the output, which is the error; warnings may come before."""
    result = run(*command)
    assert result.exit_code == 1, result.output
    assert "Traceback" not in result.output
    return result.stderr.splitlines()[-1]


def test_a_model_in_a_read_only_folder_is_used(model_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(model_folder, tmp_path / "model")
    with read_only(tmp_path / "model") as folder:
        assert "splats" in clsplat("info", folder)
        clsplat("convert", folder, tmp_path / "o.ply", "--quiet")
        clsplat("render", folder, "-o", tmp_path / "r", "--quiet")
        assert "Read-only" in error_of("train", "--resume", "-m", folder)
    assert len(Splats.load(tmp_path / "o.ply")) > 0


def test_two_comparisons_in_one_folder(capture_folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    (tmp_path / "c").mkdir()
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path / "c")], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        for command in ("compare", "frontier"):
            assert "another run writes into it" in refused(command, capture_folder, "-o", tmp_path / "c")
        holder.kill()


def filled(disk: Path, spare: int) -> None:
    """Fill a disk but for some bytes."""
    with (disk / "rest").open("wb", buffering=0) as rest, suppress(OSError):
        while rest.write(bytes(4096)):
            pass
    with (disk / "rest").open("r+b") as rest:
        rest.truncate(max((disk / "rest").stat().st_size - spare, 0))


@pytest.mark.parametrize("spare", [0, 16384], ids=["full", "room for the options"])
def test_clean_keeps_the_old_model_on_a_full_disk(model_folder: Path, tmp_path: Path, spare: int) -> None:
    with mounted(tmp_path / "disk", "-t", "tmpfs", "-o", "size=4m", "tmpfs") as disk:
        shutil.copytree(model_folder, disk / "old")
        filled(disk, spare)
        before = {path: path.read_bytes() for path in (disk / "old").rglob("*") if path.is_file()}
        command = ("clean", model_folder, "--no-photos", "-q", "-o")
        assert f"{disk / 'old'}: cannot be written (No space left" in error_of(*command, disk / "old", "--overwrite")
        assert f"{disk / 'new'}: cannot be written (No space left" in error_of(*command, disk / "new")
        assert {path: path.read_bytes() for path in (disk / "old").rglob("*") if path.is_file()} == before
        assert sorted(path.name for path in disk.iterdir()) == ["old", "rest"]
        (disk / "rest").unlink()
        clsplat(*command, disk / "old", "--overwrite")
        clsplat(*command, disk / "new")
        assert not list(disk.glob("*/.*"))
        assert "splats" in clsplat("info", disk / "old", disk / "new")


def test_metrics_in_other_places_are_enough(model_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(model_folder, tmp_path / "model")
    with read_only(tmp_path / "model") as folder:
        for flag, file in (("--json", tmp_path / "n.json"), ("--report", tmp_path / "r.html")):
            result = run("eval", folder, flag, file)
            assert result.exit_code == 0, result.output
            assert "PSNR" in result.stdout
            assert f"warning: {folder / 'results.json'}: cannot be written" in result.stderr
            assert file.is_file()
        result = run("eval", folder, "--json", folder / "n.json")
        assert "n.json: cannot be written (Read-only file system)" in result.stderr
        assert result.stdout == "", "it is refused before the work"


def test_a_report_for_which_there_is_no_room(model_folder: Path, tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "-t", "tmpfs", "-o", "size=4m", "tmpfs") as disk:
        shutil.copytree(model_folder, disk / "model")
        filled(disk, 12288)
        result = run("eval", disk / "model")
    assert result.exit_code == 1
    assert "PSNR" in result.stdout
    assert "report.html: cannot be written (No space left" in result.stderr.splitlines()[-1]


def test_metrics_are_said_where_they_cannot_be_written(model_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(model_folder, tmp_path / "model")
    with read_only(tmp_path / "model") as folder:
        result = run("eval", folder)
    assert result.exit_code == 1
    assert "PSNR" in result.stdout
    assert result.stderr.splitlines()[-1].startswith(f"error: {tmp_path / 'model' / 'results.json'}: cannot be written")
