"""Invalid input to every command: an exit code other than 0, and one line that names file and remedy."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cli_runner import ITERATIONS, N_VIEWS, SHORT, WIDTH, error_of, run
from clsplat_cli import main as main_module
from clsplat_cli import train as train_command
from clsplat_cli.main import _one_line

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.models.resume import resume

MODEL_FILES = ["cameras.bin", "images.bin", "points3D.bin"]


@pytest.fixture
def scene(tmp_path: Path, capture_folder: Path) -> Path:
    """A copy of the capture that a test may damage."""
    return Path(shutil.copytree(capture_folder, tmp_path / "yard"))


@pytest.fixture
def copied(tmp_path: Path, model: Path) -> Path:
    """A copy of the model that a test may damage."""
    return Path(shutil.copytree(model, tmp_path / "copied"))


def last_ply(model: Path) -> Path:
    return sorted(model.glob("point_cloud/*/point_cloud.ply"))[-1]


def test_devices_without_pyopencl(monkeypatch: pytest.MonkeyPatch) -> None:
    """A module that is None in sys.modules cannot be imported."""
    monkeypatch.setitem(sys.modules, "pyopencl", None)
    result = run("devices")
    assert isinstance(result.exception, SystemExit)
    assert result.exit_code == 1
    first, *hints = result.stderr.splitlines()
    assert first.startswith("error: pyopencl cannot be imported")
    assert first.endswith("`pip install pyopencl`")
    assert all(line.startswith("hint: ") for line in hints)


# --- scenes ------------------------------------------------------------------------------------


def test_no_scene(tmp_path: Path) -> None:
    assert str(tmp_path / "none") in error_of("train", tmp_path / "none", "-m", tmp_path / "m")
    (tmp_path / "empty").mkdir()
    assert "sparse" in error_of("train", tmp_path / "empty", "-m", tmp_path / "m")
    assert "scene" in error_of("train", code=2)


@pytest.mark.parametrize("name", MODEL_FILES[:2])
def test_colmap_file_missing(scene: Path, name: str) -> None:
    (scene / "sparse" / "0" / name).unlink()
    assert "sparse" in error_of("train", scene, "-m", scene / "m")
    assert not (scene / "m").exists()


@pytest.mark.parametrize("name", MODEL_FILES)
def test_colmap_file_truncated(scene: Path, name: str) -> None:
    path = scene / "sparse" / "0" / name
    path.write_bytes(path.read_bytes()[:-7])
    assert name in error_of("train", scene, "-m", scene / "m")


def test_no_registered_image(scene: Path) -> None:
    (scene / "sparse" / "0" / "images.bin").write_bytes(bytes(8))
    assert "image" in error_of("train", scene, "-m", scene / "m")


def test_photos_missing_damaged_or_of_another_shape(scene: Path) -> None:
    photo = scene / "images" / "view_003.png"
    photo.write_bytes(photo.read_bytes()[:100])
    left_out = run("train", scene, "-m", scene / "m", "--iterations", "1", "--cap-max", "20", "--quiet")
    assert left_out.exit_code == 0
    (line,) = left_out.stderr.splitlines()
    assert line.startswith("warning: ")
    assert "1 of 10 photos are left out" in line
    assert "view_003.png" in line
    write_png(photo, np.zeros((50, WIDTH, 3)))
    assert "view_003.png" in error_of("train", scene, "-m", scene / "n")
    assert "images_4" in error_of("train", scene, "-m", scene / "n", "-i", "images_4")


def test_few_registered_photos_warn_in_one_line(scene: Path) -> None:
    for index in range(N_VIEWS):
        shutil.copy(scene / "images" / "view_000.png", scene / "images" / f"more_{index}.png")
    result = run("train", scene, "-m", scene / "m", "--iterations", "1", "--cap-max", "20", "--quiet")
    assert result.exit_code == 0
    assert [line.partition(" ")[0] for line in result.stderr.splitlines()] == ["warning:"]


def test_bad_splits(scene: Path, tmp_path: Path) -> None:
    names = tmp_path / "names.txt"
    names.write_text("nobody.png\n")
    for args, word in (
        (["--test-list", names], "nobody.png"),
        (["--test-list", tmp_path / "none"], "none"),
        (["--test-every", "1"], "error: --test-every 1: must be at least 2"),
        (["-r", "0"], "resolution"),
        (["-r", "3"], "resolution 3: use 1, 2, 4, 8, a width of at least 24 pixels, or -1"),
        (["-r", "23"], "resolution 23"),
    ):
        assert word in error_of("train", scene, "-m", scene / "m", *args)


# --- options -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "word", "code"),
    [
        (["--shape", "cube"], "skew-normal", 2),
        (["--background", "1,2"], "R,G,B", 2),
        (["--background", "0,0,nan"], "R,G,B", 2),
        (["--background", "1,1,1", "-w"], "not both", 2),
        (["--save-iterations", "a"], "1000,2000", 2),
        (["--cap-max", "1.5"], "1.5", 2),
        (["--cap-max", "0"], "error: --cap-max 0: must be at least 1", 1),
        (["--sh-degree", "4"], "error: --sh-degree 4: must be 0 to 3", 1),
        (["--lambda-dssim", "2"], "error: --lambda-dssim 2.0: must be 0 to 1", 1),
        (["--seed", "99999999999999999999"], "seed", 1),
        (["--init-scale", "nan"], "error: --init-scale nan: must be finite", 1),
        (["--growth", "nan"], "growth nan: must be finite", 1),
        (["--strategy", "mcmc", "--growth", "inf"], "growth inf: must be finite", 1),
        (["-r", "1000000"], "use smaller images (-r 2, 4, 8)", 1),
        (["--save-iterations", "9" * 5000], "1000,2000", 2),
        (["--target-psnr", "9" * 400], "decibels", 2),
        (["--config", ""], "not a path", 2),
        (["--masks", "a\x1b[31m"], "\\x1b", 1),
        (["--init", "nothing"], "sfm, random", 1),
        (["--init", "none.ply"], "none.ply", 1),
        (["--device", "abacus"], "abacus", 1),
        (["--cap-max", "1000000000000"], "--cap-max", 1),
        (["--resume", "--overwrite"], "not both", 2),
        (["--resume"], "m: no such folder: there is nothing to resume", 1),
        (["--no-such-flag"], "--no-such-flag", 2),
    ],
)
def test_bad_training_options(scene: Path, args: list[str], word: str, code: int) -> None:
    assert word in error_of("train", scene, "-m", scene / "m", *args, code=code)
    assert not (scene / "m" / "config.json").exists()


def test_paths_that_no_file_can_have(scene: Path) -> None:
    for value in ("", "a\0b"):
        assert "is not a path: name a file or a folder" in error_of("train", scene, "-m", value, code=2)
        assert "is not a path" in error_of("info", value, code=2)


def test_names_that_are_no_text_are_printed(model: Path, tmp_path: Path) -> None:
    output = run("cameras", model, tmp_path / "\udcff.json")
    assert output.exit_code == 0, output.exception
    assert "\\udcff.json: 10 cameras" in output.stdout


def test_an_image_that_does_not_fit_is_refused_at_once(model: Path, tmp_path: Path) -> None:
    args = ["render", model, "--path", "orbit", "--frames", "1", "-o", tmp_path / "r"]
    assert "--size WxH" in error_of(*args, "--size", "99999x99999")


def test_unknown_command() -> None:
    assert "trian" in error_of("trian", code=2)


def test_a_loss_that_is_not_finite(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from clsplat.training.loss import LossValue, PendingValue

    monkeypatch.setattr("clsplat.training.replica.check_loss", lambda *_: None)  # it would find the fault first
    monkeypatch.setattr(PendingValue, "wait", lambda _: LossValue(float("nan"), 0, 0, 0))
    assert "learning rates" in error_of("train", scene, "-m", scene / "m", *SHORT)


# --- models and PLY files ----------------------------------------------------------------------


def with_value(vertices: slice, properties: list[str], value: float) -> Callable[[Path], None]:
    """Return a function that overwrites properties of some vertices in a file."""

    def damage(path: Path) -> None:
        header, body = path.read_bytes().split(b"end_header\n", 1)
        names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property")]
        values = np.frombuffer(body, "<f4").reshape(-1, len(names)).copy()
        for name in properties:
            values[vertices, names.index(name)] = value
        path.write_bytes(header + b"end_header\n" + values.tobytes())

    return damage


def in_header(old: bytes, new: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes().replace(old, new, 1)) and None


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (with_value(slice(0, 399), ["y"], np.nan), ("property y,", "vertex 0")),
        (with_value(slice(4, 399), ["scale_1"], np.inf), ("property scale_1,", "vertex 4")),
        (with_value(slice(5, 399), ["rot_0", "rot_1", "rot_2", "rot_3"], 0.0), ("rot_", "vertex 5")),
        (in_header(b"property float y", b"property float fuzziness"), ("'y' is missing",)),
        (in_header(b"property float opacity", b"property list uchar int opacity"), ("list",)),
        (in_header(b"binary_little_endian", b"binary_middle_endian"), ("binary_middle_endian",)),
        (in_header(b"element vertex ", b"element vertex 9"), ("point_cloud.ply",)),
        (in_header(b"ply", b"plx"), ("point_cloud.ply",)),
        (lambda path: path.write_bytes(path.read_bytes()[:-3]), ("point_cloud.ply",)),
        (lambda path: path.write_bytes(b""), ("point_cloud.ply",)),
    ],
    ids=["nan", "inf", "zero-quat", "property", "list", "layout", "count", "magic", "truncated", "empty"],
)
def test_bad_ply(copied: Path, tmp_path: Path, damage: Callable[[Path], None], words: tuple[str, ...]) -> None:
    path = last_ply(copied)
    damage(path)
    for args in (["render", path, "--path", "orbit"], ["render", copied]):
        error = error_of(*args, "-o", tmp_path / "r")
        assert str(path) in error
        assert [word for word in words if word not in error] == []
    assert not (tmp_path / "r").exists()


def test_bad_models(copied: Path, tmp_path: Path) -> None:
    out = ["-o", tmp_path / "r"]
    assert "no such" in error_of("render", tmp_path / "none", *out)
    assert "20, 40, 60" in error_of("render", copied, "--iteration", "7", *out)
    assert "give the scene's folder with -s" in error_of("eval", last_ply(copied))
    assert "--cameras" in error_of("render", last_ply(copied), *out)
    assert "one model" in error_of("render", *out, code=2)
    assert "at least one" in error_of("eval", code=2)
    (tmp_path / "empty").mkdir()
    assert "train a model first" in error_of("eval", tmp_path / "empty")
    assert "no checkpoint to resume from: start without --resume" in error_of(
        "train", "--resume", "-m", tmp_path / "empty"
    )
    (tmp_path / "empty" / "config.json").write_text("{}")
    assert "train a model first" in error_of("eval", tmp_path / "empty")
    assert "start again with --overwrite" in error_of("train", "--resume", "-m", tmp_path / "empty")


@pytest.mark.parametrize("command", ["eval", "info", "view"])
@pytest.mark.parametrize("state", ["checkpoint.npz", "budget.json", "blocks.json"])
def test_a_training_without_a_point_cloud_yet(tmp_path: Path, command: str, state: str) -> None:
    if command == "view":
        pytest.importorskip("viser")
    (tmp_path / state).touch()
    assert (
        f"{tmp_path}: its training has written no point cloud yet: continue it with clsplat train --resume"
        in error_of(command, tmp_path)
    )


def test_a_run_whose_scene_has_moved(copied: Path, scene: Path, tmp_path: Path) -> None:
    stored = json.loads((copied / "config.json").read_text())
    stored["scene"]["path"] = str(tmp_path / "gone")
    (copied / "config.json").write_text(json.dumps(stored))
    message = f"{copied}: its scene {tmp_path / 'gone'} does not exist: give the scene's folder with -s"
    assert message in error_of("train", "--resume", "-m", copied, "--iterations", ITERATIONS + 1)
    with pytest.raises(InputError, match="give the scene's folder with -s"):
        resume(copied)
    assert resume(copied, scene=scene, iterations=ITERATIONS + 1).finished


@pytest.mark.parametrize(
    ("args", "words"),
    [(["--device", "abacus"], "abacus"), (["--init", "a.ply"], "a.ply: cannot be read (no such file)")],
)
def test_device_and_start_are_checked_before_poses_are_searched(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], words: str
) -> None:
    shutil.copytree(scene / "images", tmp_path / "photos")
    monkeypatch.setattr(train_command, "scene_of_photos", lambda *_: pytest.fail("poses were searched"))
    assert words in error_of("train", tmp_path / "photos", "-m", tmp_path / "m", *args)


def test_damaged_model_files(copied: Path, tmp_path: Path) -> None:
    entries = json.loads((copied / "cameras.json").read_text())
    del entries[1]["rotation"]
    (copied / "cameras.json").write_text(json.dumps(entries))
    assert "rotation" in error_of("render", copied, "-o", tmp_path / "r")
    (copied / "checkpoint.npz").write_bytes((copied / "checkpoint.npz").read_bytes()[:1000])
    assert "checkpoint.npz" in error_of("train", "--resume", "-m", copied)
    for text in (
        "{",
        "[]",
        '{"config": 3}',
        '{"config": {"background": "red"}}',
        '{"scene": {"path": 3}}',
        '{"scene": {"test_names": 3}}',
    ):
        (copied / "config.json").write_text(text)
        assert "config.json" in error_of("eval", copied)
        assert "config.json" in error_of("train", "--resume", "-m", copied)


@pytest.mark.parametrize("name", ["../out.png", "/tmp/out.png", "a/../../out.png", "..", "c:\\out.png", "\\\\host\\x"])
def test_camera_names_cannot_leave_the_folder(copied: Path, tmp_path: Path, name: str) -> None:
    entries = json.loads((copied / "cameras.json").read_text())[:1]
    entries[0]["img_name"] = name
    (tmp_path / "c.json").write_text(json.dumps(entries))
    assert "outside" in error_of("render", copied, "--cameras", tmp_path / "c.json", "-o", tmp_path / "r")


@pytest.mark.parametrize("names", [("a.png", "a.jpg"), ("a", "a"), ("a", "a_alpha.png")])
def test_views_of_one_file(copied: Path, tmp_path: Path, names: tuple[str, str]) -> None:
    entries = json.loads((copied / "cameras.json").read_text())[:2]
    for entry, name in zip(entries, names, strict=True):
        entry["img_name"] = name
    (tmp_path / "c.json").write_text(json.dumps(entries))
    assert "both" in error_of("render", copied, "--cameras", tmp_path / "c.json", "-o", tmp_path / "r", "--alpha")


# --- unwritable places, failures of the machine ------------------------------------------------


def test_output_below_a_file(scene: Path, model: Path, tmp_path: Path) -> None:
    below = tmp_path / "file" / "folder"
    below.parent.write_text("")
    assert str(below) in error_of("train", scene, "-m", below, *SHORT)
    assert str(below) in error_of("render", model, "-o", below)
    assert str(below) in error_of("render", model, "-o", below, "--format", "npy")
    assert str(below) in error_of("eval", model, "--save-renders", below)
    assert str(below) in error_of("demo", below, "--width", "32", "--views", "4", "-q")


@pytest.mark.parametrize(
    ("raised", "word", "code"),
    [
        (MemoryError(), "--cap-max", 1),
        (KeyboardInterrupt(), "interrupted", 130),
        (OSError(28, "No space left on device", "x.ply"), "x.ply: No space left", 1),
    ],
)
def test_failures_of_the_machine(monkeypatch: pytest.MonkeyPatch, raised: BaseException, word: str, code: int) -> None:
    import clsplat.scenes.scene

    def fail(*args: object, **extra: object) -> None:
        raise raised

    monkeypatch.setattr(clsplat.scenes.scene, "load_scene", fail)
    assert word in error_of("train", "anything", "-m", "nowhere", code=code)


def test_opencl_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    import pyopencl as cl

    import clsplat.scenes.scene

    for error, word in (
        (cl.MemoryError("clEnqueue", cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE), "--cap-max"),
        (cl.LogicError("clFinish", cl.status_code.INVALID_VALUE, "bad"), "clsplat devices"),
    ):

        def fail(*args: object, error: Exception = error, **extra: object) -> None:
            raise error

        monkeypatch.setattr(clsplat.scenes.scene, "load_scene", fail)
        assert word in error_of("train", "anything", "-m", "nowhere")


def test_bugs_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(error: Exception) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(main_module, "_known_failure", fail)
    import clsplat.scenes.scene

    monkeypatch.setattr(clsplat.scenes.scene, "load_scene", lambda *args, **extra: 1 / 0)
    assert isinstance(run("train", "anything", "-m", "nowhere").exception, ZeroDivisionError)


def test_messages_have_one_line_without_control_characters() -> None:
    assert _one_line("first\nsecond\x1b[2J\r") == r"first second\x1b[2J\r"
