"""`clsplat benchmark`: tables, files, continuation, and a message of one line for each mistake."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_runner import clsplat, error_of, run
from scenes_data import scene_folder
from set_folders import as_blender, as_colmap

from clsplat.benchmark.run import run_benchmark

TINY = ["--iterations", "12", "--sh-degree", "1", "--densify-interval", "5", "--cap-max", "40"]
OPTIONS = {"iterations": 12, "sh_degree": 1, "densify_interval": 5}


def test_benchmark_prints_tables_and_continues(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    as_colmap(scene, tmp_path / "tanks" / "truck")
    monkeypatch.chdir(tmp_path)
    arguments = ("benchmark", "tanks", "tanks", "--preset", "gaussian", *TINY)
    first = run(*arguments)
    assert first.exit_code == 0, first.output
    assert "[1/1] truck gaussian cap 40 seed 0: PSNR" in first.stderr
    assert "left out" not in first.stderr, "a scene that is not there is no mistake"
    lines = first.stdout.splitlines()
    assert lines[0] == "truck (48x36 px, 2 test views)"
    head = ["system", "PSNR", "SSIM", "LPIPS", "splats", "iterations", "seconds", "source", "or", "protocol"]
    assert lines[1].split() == head
    assert lines[2].startswith("clsplat gaussian")
    assert lines[2].endswith("not the published length (30000 iterations); at most 40 splats, not 2600000")
    assert lines[3].split() == ["3DGS", "25.19", "30000", "Kerbl", "et", "al.", "2023"]
    out = tmp_path / "benchmark-tanks"
    assert {path.name for path in out.iterdir()} == {"runs.jsonl", "tanks.md", "tanks.csv", "tanks.json", "models"}
    again = run(*arguments)
    assert (again.stdout, again.stderr) == (first.stdout, "")
    assert clsplat(*arguments, "--seeds", "1", "-q") == ""
    assert len((out / "runs.jsonl").read_text().splitlines()) == 2


def test_the_function_has_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    folder = as_blender(scene, tmp_path / "lego")
    run("benchmark", "nerf-synthetic", folder, "-o", tmp_path / "a", *TINY)
    run_benchmark("nerf-synthetic", folder, output=tmp_path / "b", caps=[40], common=OPTIONS)
    (a,), (b,) = (
        [json.loads(line) for line in (tmp_path / name / "runs.jsonl").read_text().splitlines()] for name in "ab"
    )
    changing = ("seconds", "cpu_seconds", "render_ms", "peak_bytes", "device_bytes")  # those of the machine
    assert {k: v for k, v in a.items() if k not in changing} == {k: v for k, v in b.items() if k not in changing}
    models = [next((tmp_path / name).glob("models/*/point_cloud/*/point_cloud.ply")) for name in "ab"]
    assert models[0].read_bytes() == models[1].read_bytes()
    assert a["config"]["background"] == [1.0, 1.0, 1.0]


def test_benchmark_names_each_mistake(scene: Path, tmp_path: Path) -> None:
    out = ("-o", tmp_path / "out")
    assert "'blender' is not one of 'nerf-synthetic'" in error_of("benchmark", "blender", scene, *out, code=2)
    assert "no such folder: name the folder with the scenes" in error_of("benchmark", "llff", tmp_path / "no", *out)
    message = error_of("benchmark", "mipnerf360", tmp_path, *out)
    assert "no scene of Mip-NeRF 360 in it: expected folders called bicycle, flowers, garden" in message
    as_colmap(scene, tmp_path / "garden")
    message = error_of("benchmark", "mipnerf360", tmp_path, *out)
    assert "images_4: no such folder of photos: copy the folder of the set there or reduce" in message
    assert message.endswith("(-i images)")
    as_colmap(scene, tmp_path / "truck")
    assert "unknown system 'cube'" in error_of("benchmark", "tanks", tmp_path, *out, "--preset", "cube")
    assert "contradicts strategy mcmc" in error_of(
        "benchmark", "tanks", tmp_path, *out, "--preset", "3dgs", "--strategy", "mcmc"
    )
    assert "iterations" in error_of("benchmark", "tanks", tmp_path, *out, "--iterations", "0", code=2)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.data
def test_the_official_lego_is_the_published_scene(tmp_path: Path) -> None:
    (tmp_path / "lego").symlink_to(scene_folder("lego_full"))
    short = ("--iterations", "30", "--cap-max", "2000")
    text = clsplat("benchmark", "nerf-synthetic", tmp_path, "-o", tmp_path / "out", *short)
    assert text.startswith("lego (800x800 px, 200 test views)")
    assert "not the published length (30000 iterations); at most 2000 splats, not 325000\n" in text
