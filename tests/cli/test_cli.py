"""The program, `clsplat train` and `clsplat demo`: their files and their output."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_runner import (
    CAP,
    HEIGHT,
    ITERATIONS,
    N_VIEWS,
    SHORT,
    TEST_NAMES,
    WIDTH,
    clsplat,
    error_of,
    last_iteration,
    run,
)

from clsplat.cameras.cameras_json import read_cameras
from clsplat.scenes.scene import load_scene
from clsplat.splats.formats.ply import read_ply

PROGRAM = [sys.executable, "-c", "from clsplat_cli.start import main; main()"]


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def ply(model: Path, iteration: int = ITERATIONS) -> Path:
    return model / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"


# --- the program -------------------------------------------------------------------------------


def test_help_lists_all_commands_and_loads_nothing_heavy() -> None:
    text = subprocess.run([*PROGRAM, "--help"], check=True, capture_output=True, text=True).stdout
    for name in ("devices", "demo", "train", "render", "eval", "compare", "convert"):
        assert f"\n  {name} " in text
    loaded = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; from clsplat_cli.main import main\n"
            "try: main(['--help'])\nexcept SystemExit: print([m for m in sys.modules if '.' not in m])",
        ],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.splitlines()[-1]
    assert "'click'" in loaded
    assert not [name for name in ("numpy", "pyopencl", "pycolmap", "scipy", "PIL") if f"'{name}'" in loaded]


@pytest.mark.parametrize("command", ["devices", "demo", "train", "render", "eval", "compare", "convert"])
def test_each_command_has_help(command: str) -> None:
    assert f"Usage: clsplat {command}" in clsplat(command, "--help")


def test_version() -> None:
    import clsplat as package

    assert clsplat("--version") == f"clsplat {package.__version__}\n"


def test_every_option_of_the_config_is_a_flag_with_help() -> None:
    import click
    from clsplat_cli.train import train

    options = {param.name: param for param in train.params if isinstance(param, click.Option)}
    from clsplat.training.config import OPTIONS

    for name in OPTIONS:
        assert options[name].help, name


# --- train -------------------------------------------------------------------------------------


def test_train_writes_the_model_folder(model: Path, scene: Path) -> None:
    expected = {"config.json", "cameras.json", "log.jsonl", "checkpoint.npz"}
    plys = {f"point_cloud/iteration_{n}/point_cloud.ply" for n in (20, 40, ITERATIONS)}
    assert files(model) == expected | plys
    stored = json.loads((model / "config.json").read_text())
    assert stored["config"]["cap_max"] == CAP
    assert stored["scene"]["path"] == str(scene.resolve())
    assert stored["scene"]["test_names"] == TEST_NAMES


def test_train_logs_json_lines(model: Path) -> None:
    lines = [json.loads(line) for line in (model / "log.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [50, 60]
    assert {"loss", "psnr", "splats", "seconds"} <= set(lines[0])


def test_cameras_json_has_3dgs_keys_and_all_views_test_first(model: Path, scene: Path) -> None:
    entries = json.loads((model / "cameras.json").read_text())
    keys = {"id", "img_name", "width", "height", "position", "rotation", "fx", "fy"}
    assert all(keys <= set(entry) for entry in entries)
    loaded = load_scene(scene)
    assert [entry["img_name"] for entry in entries] == [Path(view.name).stem for view in (*loaded.test, *loaded.train)]
    camera = loaded.test[0].camera
    np.testing.assert_allclose(entries[0]["position"], camera.position, atol=1e-12)
    np.testing.assert_allclose(entries[0]["rotation"], camera.rotation.T, atol=1e-12)


def test_ply_has_3dgs_columns_then_the_skew(model: Path) -> None:
    head = ply(model).read_bytes().split(b"end_header\n")[0].decode().splitlines()
    names = [line.split()[-1] for line in head if line.startswith("property")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:18] == [f"f_rest_{i}" for i in range(9)]
    assert names[18:] == [
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
        "skew_0",
        "skew_1",
        "skew_2",
    ]
    assert "comment clsplat shape=skew-normal normalisation=peak" in head
    assert len(read_ply(ply(model)).arrays["mean"]) <= CAP


def test_train_prints_where_the_model_is_and_how_good(scene: Path, tmp_path: Path) -> None:
    result = run("train", "-s", scene, "-o", tmp_path / "m", "--eval", *SHORT)
    assert str(ply(tmp_path / "m")) in result.stdout
    assert "test views (2): PSNR" in result.stdout
    assert "corrected" not in result.stdout
    assert "MB of device memory" in result.stderr
    assert f"{ITERATIONS}/{ITERATIONS} 100%" in result.stderr


@pytest.mark.parametrize("measured", [[], ["--test-iterations", str(ITERATIONS)]], ids=["after", "during"])
def test_train_with_exposures_prints_the_colour_corrected_psnr_too(
    scene: Path, tmp_path: Path, measured: list[str]
) -> None:
    """It is that of `eval --color-correct`."""
    printed = clsplat("train", "-s", scene, "-o", tmp_path / "m", "--eval", "--exposure", *measured, *SHORT)
    found = re.search(r"PSNR (\d+\.\d\d) dB \((\d+\.\d\d) dB colour-corrected\), SSIM", printed)
    assert found is not None
    for value, options in zip(found.groups(), ([], ["--color-correct"]), strict=True):
        clsplat("eval", tmp_path / "m", "--no-report", "--json", tmp_path / "n.json", "--overwrite", *options)
        (numbers,) = json.loads((tmp_path / "n.json").read_text()).values()
        assert numbers["results"]["PSNR"] == pytest.approx(float(value), abs=0.006)


def test_train_without_eval_learns_from_all_views(scene: Path, tmp_path: Path) -> None:
    out = clsplat("train", scene, "-m", tmp_path / "m", *SHORT, "-w", "--shape", "gaussian", "--steps", "3", "-r", "2")
    assert "PSNR" not in out
    stored = json.loads((tmp_path / "m" / "config.json").read_text())
    assert stored["scene"]["test_names"] == []
    assert stored["config"]["background"] == [1, 1, 1]
    camera = read_cameras(tmp_path / "m" / "cameras.json")[0].camera
    assert (camera.width, camera.height) == (WIDTH // 2, HEIGHT // 2)
    error = error_of("eval", tmp_path / "m")
    assert "clsplat train --eval" in error
    clsplat("eval", tmp_path / "m", "--set", "train")
    assert (tmp_path / "m" / "results_train.json").is_file()
    clsplat("render", tmp_path / "m", "-o", tmp_path / "r")
    assert len(files(tmp_path / "r")) == N_VIEWS


def test_flags_with_underscores_and_spaced_lists(scene: Path, tmp_path: Path) -> None:
    clsplat(
        "train",
        "--source_path",
        scene,
        "--model_path",
        tmp_path / "m",
        "--cap_max",
        "60",
        "--sh_degree",
        "0",
        "--iterations",
        "4",
        "--save_iterations",
        "1",
        "3",
        "--test_iterations",
        "2",
        "--skew_map",
        "cube_root",
        "--lambda_dssim",
        "0.5",
        "--white_background",
        "--test_list",
        _names(tmp_path, ["view_003.png"]),
    )
    stored = json.loads((tmp_path / "m" / "config.json").read_text())
    config = stored["config"]
    assert (config["cap_max"], config["sh_degree"], config["lambda_dssim"]) == (60, 0, 0.5)
    assert (config["save_iterations"], config["test_iterations"]) == ([1, 3], [2])
    assert config["skew_map"] == "cube-root"
    assert stored["scene"]["test_names"] == ["view_003.png"]
    assert ply(tmp_path / "m", 3).is_file()
    logged = [json.loads(line) for line in (tmp_path / "m" / "log.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in logged if "test_psnr" in line] == [2]
    assert all("psnr_gap" in line and "few_views_share" in line for line in logged if "test_psnr" in line)


def _names(folder: Path, names: list[str]) -> Path:
    path = folder / "test.txt"
    path.write_text("\n".join(names))
    return path


def test_default_folder_is_named_after_the_scene(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert clsplat("train", scene, "--iterations", "1", "--cap-max", "20", "--quiet") == ""
    assert ply(tmp_path / "output" / scene.name, 1).is_file()


def test_existing_models_are_kept_unless_overwritten(scene: Path, tmp_path: Path) -> None:
    model, tiny = tmp_path / "m", ["--cap-max", "20", "--sh-degree", "0"]
    clsplat("train", scene, "-m", model, "--iterations", "2", *tiny)
    before = ply(model, 2).read_bytes()
    assert "--overwrite" in error_of("train", scene, "-m", model, "--iterations", "3", *tiny)
    assert "already holds a model" in error_of("train", tmp_path / "missing", "-m", model), "before the scene is read"
    assert ply(model, 2).read_bytes() == before
    clsplat("train", scene, "-m", model, "--iterations", "3", *tiny, "--overwrite")
    assert {name for name in files(model) if name.endswith(".ply")} == {"point_cloud/iteration_3/point_cloud.ply"}


def test_interrupt_then_resume(scene: Path, tmp_path: Path) -> None:
    """Ctrl-C in a real process, then --resume without any option."""
    model = tmp_path / "m"
    args = [
        "train",
        scene,
        "-m",
        model,
        "--eval",
        "--cap-max",
        "50",
        "--sh-degree",
        "0",
        "--iterations",
        "100000",
        "--no-coarse-to-fine",
        "--checkpoint-interval",
        "0",
    ]
    process = subprocess.Popen([*PROGRAM, *map(str, args)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if last_iteration(line, 100_000) >= 50:
            break
    process.send_signal(2)
    rest = process.communicate(timeout=300)[1]
    assert process.returncode == 130
    assert f"clsplat train --resume -m {model}" in rest.splitlines()[-1]
    assert "Traceback" not in rest
    with np.load(model / "checkpoint.npz") as stored:
        meta = json.loads(stored["meta"].tobytes())
    assert 50 <= meta["iteration"] < 100_000
    assert "cap_max=50" in error_of("train", "--resume", "-m", model, "--cap-max", "51")


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["--test-every", "5"], "test_every=5, but the run was started with test_every=8"),
        (["-r", "2"], "resolution=2, but the run was started with resolution=-1"),
        (["--masks", "none"], "masks=none, but the run was started with masks=None"),
        (["--alpha", "mask"], "alpha=mask, but the run was started with alpha=background"),
    ],
)
def test_resume_reads_the_scene_as_before(copied_model: Path, flags: list[str], text: str) -> None:
    """Other photos would be trained on, or be measured after they were trained on."""
    before = (copied_model / "config.json").read_bytes()
    longer = ["--resume", "-m", copied_model, "--iterations", "500"]
    assert f"--resume with {text}: use the same options" in error_of("train", *longer, *flags)
    assert (copied_model / "config.json").read_bytes() == before


def test_resume_holds_out_no_photo_that_was_trained_on(scene: Path, tmp_path: Path) -> None:
    tiny = ["--cap-max", "60", "--iterations"]
    clsplat("train", scene, "-m", tmp_path, *tiny, "2")
    message = error_of("train", "--resume", "-m", tmp_path, *tiny, "4", "--eval")
    assert "--resume with eval=True, but the run was started with eval=False" in message
    clsplat("train", "--resume", "-m", tmp_path, *tiny, "4")


def test_resume_with_the_same_reading(copied_model: Path) -> None:
    clsplat("train", "--resume", "-m", copied_model, "--eval", "--test-every", "8", "-r", "-1")


@pytest.mark.parametrize("kind", ["budget.json", "blocks.json"])
def test_a_failed_overwrite_keeps_what_can_be_resumed(scene: Path, tmp_path: Path, kind: str) -> None:
    """An error that is found after the options are read must not cost a search or a training in blocks."""
    run = tmp_path / kind.removesuffix(".json") / "run"
    run.mkdir(parents=True)
    (tmp_path / kind).write_text("{}")
    error_of("train", scene, "-m", tmp_path, "--overwrite", "--device", "no such device", "--iterations", "2")
    assert (tmp_path / kind).read_text() == "{}"
    assert run.is_dir()
    clsplat("train", scene, "-m", tmp_path, "--overwrite", "--iterations", "2", "--cap-max", "60")
    assert not (tmp_path / kind).exists()
    assert not run.exists()


def test_resume_of_a_finished_run_changes_nothing(model: Path) -> None:
    before = ply(model).read_bytes()
    out = clsplat("train", "--resume", "-m", model)
    assert ply(model).read_bytes() == before
    assert "test views (2)" in out


# --- demo --------------------------------------------------------------------------------------


def test_demo_runs_all_steps_and_runs_again(tmp_path: Path) -> None:
    small = ["--iterations", "20", "--cap-max", "200", "--width", str(WIDTH), "--views", str(N_VIEWS)]
    out = clsplat("demo", tmp_path / "d", *small)
    assert "PSNR" in out
    for line in (line for line in out.splitlines() if line.startswith("  ")):
        assert Path(line.split()[0]).is_file()
    assert files(tmp_path / "d" / "renders") == set(TEST_NAMES)
    assert "--overwrite" in error_of("demo", tmp_path / "d", *small)
    made = (tmp_path / "d" / "scene" / "sparse" / "0" / "points3D.bin").stat().st_mtime_ns
    clsplat("demo", tmp_path / "d", *small, "--overwrite", "--quiet")
    assert (tmp_path / "d" / "scene" / "sparse" / "0" / "points3D.bin").stat().st_mtime_ns == made


def test_a_large_demo_is_trained_in_blocks(tmp_path: Path) -> None:
    out = tmp_path / "street"
    small = ["--large", "--iterations", "8", "--cap-max", "80", "--width", "32", "--views", "12", "--blocks", "2x1"]
    printed = clsplat("demo", out, *small)
    assert printed.count("test views (2): PSNR") == 2
    listed = [Path(line.split()[0]) for line in printed.splitlines() if line.startswith("  ")]
    assert all(path.is_file() for path in listed)
    assert out / "model" / "partition.svg" in listed
    assert "MB in all" in printed
    assert len(json.loads((out / "model" / "blocks.json").read_text())["blocks"]) == 2
    assert "--overwrite" in error_of("demo", out, *small)
    assert "with --large" in error_of("demo", out, "--overwrite")
    assert "are for --large" in error_of("demo", tmp_path / "x", "--blocks", "2x1", code=2)
    assert "are for --large" in error_of("demo", tmp_path / "x", "--cluster", "local:2", code=2)
    assert "such as 2x2" in error_of("demo", tmp_path / "x", "--large", "--blocks", "7")
    assert "at least" in error_of("demo", tmp_path / "x", "--large", "--views", "5")
    assert not (tmp_path / "x").exists()
