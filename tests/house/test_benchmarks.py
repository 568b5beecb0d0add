"""The benchmarks run on a capture of a few pixels, so that changes cannot break them unnoticed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import blocks
import budget
import common
import defaults
import exposures
import few_views
import folds
import formats
import gsplat_steps
import pytest
from set_folders import as_blender

from clsplat.scenes.scene import load_scene

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_train_scenes(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    out = tmp_path / "scenes.jsonl"
    options = [
        "--scenes",
        scene.name,
        "--shapes",
        "skew-normal",
        "--caps",
        "100",
        "--iterations",
        "8",
        "--out",
        str(out),
    ]
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    command = [sys.executable, str(BENCHMARKS / "train_scenes.py")]
    done = subprocess.run([*command, *options], env=environment, capture_output=True, text=True, check=True)
    (row,) = [json.loads(line) for line in out.read_text().splitlines()]
    assert row["splats"] <= 100
    assert row["along"][-1][0] == 8
    assert {"device", "driver", "schedule", "commit"} <= set(row)
    again = subprocess.run([*command, *options], env=environment, capture_output=True, text=True, check=True)
    assert len(out.read_text().splitlines()) == 1, "a run that is there is not run again"
    assert f"{row['psnr']:.2f}" in again.stdout
    assert f"{row['psnr']:.3f}" in done.stdout


@pytest.mark.slow
def test_stages(tmp_path: Path) -> None:
    out = tmp_path / "stages.jsonl"
    command = [sys.executable, str(BENCHMARKS / "stages.py"), "--out", str(out)]
    for _ in range(2):
        done = subprocess.run([*command, "--smoke"], capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["shape"] for row in rows] == ["gaussian", "skew-normal"], "each once, also when it is called again"
    for row in rows:
        assert {"device", "driver", "schedule", "commit", "load", "peak_mb"} <= set(row)
        assert min(row["copy_bytes_per_s"], row["fma_flops_per_s"]) > 0
        assert [report["task"] for report in row["reports"]] == ["training step", "render"]
        assert f"| {row['shape']} |" in done.stdout
    slower = tmp_path / "other.jsonl"
    for report in (report for row in rows for report in row["reports"]):
        report["wall_ms"] *= 2
    slower.write_text("".join(json.dumps(row) + "\n" for row in rows))
    printed = subprocess.run([*command, "--against", str(slower)], capture_output=True, text=True, check=True).stdout
    lines = printed.splitlines()[2:]
    assert len(lines) == 4
    assert all("| 0.50 | 1.00 |" in line for line in lines), printed


def test_gsplat_steps(tmp_path: Path) -> None:
    """Without PyTorch and CUDA only clsplat is measured."""
    out = tmp_path / "steps.jsonl"
    command = [sys.executable, str(BENCHMARKS / "gsplat_steps.py"), "--smoke", "--out", str(out)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    systems = {row["system"] for row in rows}
    assert {"clsplat gaussian", "clsplat skew-normal"} <= systems
    assert [row["task"] for row in rows] == ["image", "step"] * len(systems)
    assert all(0 < row["least_ms"] <= row["ms"] <= row["most_ms"] for row in rows)
    assert "| clsplat gaussian |" in said


def test_the_page_has_the_steps_beside_gsplat() -> None:
    page = gsplat_steps.PAGE.read_text(encoding="utf-8")
    assert gsplat_steps.table(common.read(common.RESULTS / "gsplat_steps.jsonl")) in page


def test_gpu_model(tmp_path: Path) -> None:
    out = tmp_path / "workloads.jsonl"
    command = [sys.executable, str(BENCHMARKS / "gpu_model.py"), "--smoke", "--out", str(out)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["shape"] for row in rows] == ["gaussian", "skew-normal"]
    for row in rows:
        assert 0 < row["visible"] <= row["sizes"]["splats"] == 500
        assert 0 < row["shares"]["rows2"] <= row["shares"]["rows4"] <= row["shares"]["tiles"] <= 1
    assert "| rasterize_vjp |" in said
    assert "skew-normal at most 1.2 times" in said


def test_densify(tmp_path: Path) -> None:
    out = tmp_path / "densify.jsonl"
    command = [sys.executable, str(BENCHMARKS / "densify.py"), "--smoke", "--out", str(out), "--shapes", "gaussian"]
    for _ in range(2):
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert len({row["action"] for row in rows}) == len(rows) == 9, "each once, also when it is called again"
    for row in rows:
        assert row["wall_ms"] == pytest.approx(row["host_ms"] + row["device_ms"], abs=0.1)
        assert row["read_mb"] < 2000 * 59 * 4 / 1e6, "not all parameters of all splats"
        assert f"| {row['action']} | gaussian | 2000 |" in said


@pytest.mark.slow
def test_systems(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    command = [sys.executable, str(BENCHMARKS / "systems.py"), "--out", str(tmp_path)]
    options = [scene.name, "--groups", "factors", "--caps", "60", "--seeds", "0", "--iterations", "4"]
    for _ in range(2):
        subprocess.run([*command, *options], env=environment, capture_output=True, text=True, check=True)
    file = tmp_path / scene.name / "runs.jsonl"
    runs = [json.loads(line) for line in file.read_text().splitlines()]
    assert len(runs) == len({run["system"] for run in runs}) == 10, "each once, also when it is called again"
    assert all(run["commit"] and run["finite"] and run["cap_held"] for run in runs)
    for run in runs:  # give them the sizes of the real runs
        run["config"] |= {"cap_max": 5000, "iterations": 1000}
    file.write_text("".join(json.dumps(run) + "\n" for run in runs))
    page = subprocess.run([*command, "--page"], env=environment, capture_output=True, text=True, check=True).stdout
    first, second = (next(run for run in runs if run["system"] == name) for name in ("gaussian", "skew-normal"))
    expected = f"| {second['psnr']:.2f} | {second['psnr'] - first['psnr']:+.2f} | {second['ssim']:.4f} |"
    assert any(expected in line for line in page.splitlines() if line.startswith("| skew-normal | ")), page


def test_budget(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    out = tmp_path / "budget.jsonl"
    command = [sys.executable, str(BENCHMARKS / "budget.py"), "--out", str(out), "--cases", f"{scene.name}:-1:0:0"]
    for _ in range(2):
        printed = subprocess.run(
            [*command, "--smoke", "--work", str(tmp_path / "work")],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    (row,) = [json.loads(line) for line in out.read_text().splitlines()]
    assert [run["cap"] for run in row["plain"]] == [60, 24, 6]
    assert row["splats"] == row["search"]["final"]["splats"] <= 60
    assert {"device", "driver", "schedule", "commit", "psnr", "seconds"} <= set(row)
    best = max(row["plain"], key=lambda run: run["psnr"])
    cells = [cell.strip() for cell in printed.splitlines()[-1].split("|")[1:-1]]
    assert cells[2:6] == ["validation", "1", f"{best['cap']}: {best['psnr']:.2f}", f"{row['psnr']:.2f}"]
    assert cells[6:8] == [f"{row['splats'] / best['splats']:.0%}", f"{row['bytes'] / best['bytes']:.0%}"]


@pytest.mark.slow
def test_startup(tmp_path: Path) -> None:
    out = tmp_path / "startup.jsonl"
    command = [sys.executable, str(BENCHMARKS / "startup.py"), "--smoke", "--out", str(out)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["task"], row["caches"]) for row in rows] == [("--help", ""), ("render", "warm")]
    for row in rows:
        assert {"device", "driver", "schedule", "commit", "load"} <= set(row)
        assert 0 < row["fastest"] <= row["seconds"] <= row["slowest"]
        assert f"| {row['task']} |" in printed


@pytest.mark.slow
def test_scalar(tmp_path: Path) -> None:
    out = tmp_path / "scalar.jsonl"
    command = [sys.executable, str(BENCHMARKS / "scalar.py"), "--smoke", "--out", str(out)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    (row,) = [json.loads(line) for line in out.read_text().splitlines()]
    assert set(row["ms"]) == {"1x16x16", "256x1x1"}
    assert row["step_ratio"] == pytest.approx(row["ms"]["256x1x1"]["step"] / row["ms"]["1x16x16"]["step"])
    assert f"| {row['raster_ratio']:.1f} |" in printed


@pytest.mark.slow
def test_time_to_quality(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    out = tmp_path / "times.jsonl"
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    command = [sys.executable, str(BENCHMARKS / "time_to_quality.py"), "--out", str(out)]
    options = ["--smoke", "--scenes", scene.name, "--validate", "--options", "", "coarse_to_fine=off"]
    for _ in range(2):
        subprocess.run([*command, *options], env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["options"] for row in rows] == ["", "coarse_to_fine=off"], "each once, also when it is called again"
    assert all([point[0] for point in row["along"]] == [2, 4] for row in rows)
    rows[0]["along"] = [[50, 10.0, 19.0, 100, 19.0], [100, 20.0, 38.0, 100, 23.0]]
    out.write_text(json.dumps(rows[0]) + "\n")
    printed = subprocess.run([*command, "--table"], capture_output=True, text=True, check=True).stdout
    assert "| 12.5 | 17.5 |  |  | 100 | 20.0 | 38.0 | 100 | 23.00 |" in printed.splitlines()[-1]


@pytest.mark.slow
def test_frontier(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    out = tmp_path / "frontier"
    command = [sys.executable, str(BENCHMARKS / "frontier.py"), "--out", str(out)]
    options = ["--smoke", "--scenes", scene.name]
    done = subprocess.run([*command, *options], env=environment, capture_output=True, text=True, check=True)
    runs = [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]
    assert len(runs) == 4 + 2 + 1 + 4, "what two groups want is trained once"
    assert [run["config"]["iterations"] for run in runs[:4]] == [2, 2, 4, 4]
    assert "repeated: 1 of 1 runs gave the same splats each time" in done.stdout
    assert {path.stem for path in (out / "charts").glob("*.png")} >= {"length", "size", "seeds"}
    assert (out / "report.html").is_file()
    printed = subprocess.run([*command, "--table"], capture_output=True, text=True, check=True).stdout
    assert "lead over 3dgs in equal time [dB]" in printed
    assert printed in done.stdout


@pytest.mark.slow
def test_photos(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    out = tmp_path / "photos.jsonl"
    command = [
        sys.executable,
        str(BENCHMARKS / "photos.py"),
        "--smoke",
        "--scenes",
        f"{scene.name}:1",
        "--out",
        str(out),
        "--options",
        "",
        "exposure=true,antialiased=true",
    ]
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["options"] for row in rows] == ["", "exposure=true,antialiased=true"], "each once"
    for row in rows:
        assert {"device", "driver", "schedule", "commit"} <= set(row)
        assert len(row["PSNR"]) > 1
        assert row["corrected"] >= row["PSNR"][0] - 0.1
        assert f"{row['corrected']:.2f}" in done.stdout


@pytest.mark.slow
def test_exposures(tmp_path: Path, capture_folder: Path) -> None:
    scene, out = as_blender(capture_folder, tmp_path / "transparent"), tmp_path / "exposures.jsonl"
    command = [sys.executable, str(BENCHMARKS / "exposures.py"), "--smoke", "--scenes", "transparent:1"]
    command += ["--out", str(out), "--backgrounds", "grey"]
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["random_background"] for row in rows] == [False, True], "each once"
    for row in rows:
        assert {"device", "driver", "schedule", "commit"} <= set(row)
        assert 0.6 < row["found"] < 1, "it has begun to learn that the photos are darker"
        assert f"| {row['found']:.3f} | {row['corrected']:.2f} |" in done.stdout


def test_a_darker_photo_keeps_its_background(tmp_path: Path, capture_folder: Path) -> None:
    grey = (0.5, 0.5, 0.5)
    scene = load_scene(as_blender(capture_folder, tmp_path / "transparent"), background=grey)
    some, darkened = exposures.some_darkened(scene, 4, 0.6)
    assert darkened.sum() == 2
    assert [view.name for view in some.test] == [view.name for view in scene.test]
    before = {view.name: view.loaded() for view in scene.train}
    for view, dark in zip(some.train, darkened, strict=True):
        old, alpha = before[view.name].image.astype(float), view.alpha
        assert alpha is not None
        assert (view.image[alpha == 0] == 128).all()
        assert view.image[alpha == 255] == pytest.approx(old[alpha == 255] * (0.6 if dark else 1.0), abs=0.51)


def test_visible_adam(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    out = tmp_path / "visible.jsonl"
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    command = [
        sys.executable,
        str(BENCHMARKS / "visible_adam.py"),
        "--smoke",
        "--scenes",
        f"{scene.name}:1:60",
        "--out",
        str(out),
    ]
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["task"], row["options"]) for row in rows] == [
        (task, f"visible_adam={on}") for task in ("wide", "train") for on in ("false", "true")
    ]
    for row in rows:
        assert {"device", "driver", "schedule", "commit", "load"} <= set(row)
        assert 0 < row["splats_seen"] <= row["vectors_seen"] <= 1
        assert 0 < row["step_ms"] < row["device_ms"]
        assert f"| {row['wall_ms']:.1f} |" in done.stdout
    assert rows[0]["splats_seen"] < 0.8


@pytest.mark.slow
def test_stability(tmp_path: Path) -> None:
    out = tmp_path / "stability.jsonl"
    command = [sys.executable, str(BENCHMARKS / "stability.py"), "--out", str(out)]
    kinds = ["--kinds", "static", "training", "arithmetic", "--smoke"]
    for _ in range(2):
        subprocess.run([*command, *kinds], capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(rows) == len({(row["kind"], row["hazard"], row["system"]) for row in rows}), "each once"
    assert {row["kind"] for row in rows} == {"static", "training", "arithmetic"}
    assert all(row["finite"] for row in rows)
    printed = subprocess.run([*command, "--table"], capture_output=True, text=True, check=True).stdout
    assert "| all rates x10 | stops |" in printed
    assert "0 of them with a number that is not finite" in printed


@pytest.mark.slow
def test_arithmetic(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    out = tmp_path / "arithmetic.jsonl"
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    command = [sys.executable, str(BENCHMARKS / "arithmetic.py"), "--smoke", "--scenes", scene.name, "--out", str(out)]
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["variant"] for row in rows] == ["default", "8 lanes"], "each once, also when it is called again"
    for row in rows:
        assert {"device", "driver", "schedule", "commit", "load"} <= set(row)
        assert 0 < row["image_error"] < 1e-4
        assert 0 < row["gradient_error"] < 1e-2
        assert row["raster_ms"] > 0
        assert f"| {row['variant']} | {row['image_error']:.1e} |" in done.stdout
    assert rows[0]["relative_ms"] == 1


def test_the_page_has_the_stored_runs_at_full_size() -> None:
    rows = defaults.Runs(BENCHMARKS / "results" / "defaults.jsonl", defaults.KEY).rows
    for scenes in defaults.TABLES.values():
        assert defaults.test_table(rows, scenes) in defaults.PAGE.read_text(encoding="utf-8"), "run defaults.py --page"


def test_the_page_has_the_stored_runs_with_few_photos() -> None:
    rows = few_views.Runs(BENCHMARKS / "results" / "few_views.jsonl", few_views.KEY).rows
    assert rows
    assert few_views.page(rows) in few_views.PAGE.read_text(encoding="utf-8"), "run few_views.py --page"


def test_the_page_has_the_stored_trainings_in_blocks() -> None:
    rows = blocks.Runs(BENCHMARKS / "results" / "blocks.jsonl", blocks.KEY).rows
    assert rows
    assert blocks.page(rows) in blocks.PAGE.read_text(encoding="utf-8"), "run blocks.py --page"


def test_a_wrong_value_is_one_line() -> None:
    for arguments in (["--systems", "nothing"], ["--cases", "nowhere:1:10:10"]):
        done = subprocess.run(
            [sys.executable, str(BENCHMARKS / "folds.py"), *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 1
        (line,) = done.stderr.splitlines()
        assert line.startswith("error: ")
        assert arguments[1].split(":")[0] in line


def test_the_page_has_the_stored_searches() -> None:
    rows = budget.Runs(BENCHMARKS / "results" / "budget.jsonl", budget.KEY).rows
    assert rows
    assert budget.page(rows) in budget.PAGE.read_text(encoding="utf-8"), "run budget.py --page"


def test_the_page_has_the_stored_folds() -> None:
    rows = folds.Runs(BENCHMARKS / "results" / "folds.jsonl", folds.KEY).rows
    assert rows
    assert folds.page(rows) in folds.PAGE.read_text(encoding="utf-8"), "run folds.py --page"


def test_folds_hold_out_each_training_photo_once(capture_folder: Path) -> None:
    scene = load_scene(capture_folder, eval=True)
    training = [view.name for view in scene.train]
    split = [folds.hold_out_fold(scene, fold, 4) for fold in range(4)]
    assert sorted(view.name for fold in split for view in fold.test) == training
    for fold in split:
        assert sorted(view.name for view in (*fold.train, *fold.test)) == training, "no test view of the scene"
    for wrong in (1, len(training) + 1):
        with pytest.raises(SystemExit, match=f"--folds {wrong}: .* training views; name 2 to {len(training)} folds"):
            folds.hold_out_fold(scene, 0, wrong)


def test_a_lead_is_over_the_photos_of_both_systems() -> None:
    ours = {(0, "a"): 20.0, (0, "b"): 22.0, (0, "c"): 30.0, (1, "a"): 9.0}
    others = {(0, "a"): 19.0, (0, "b"): 19.0, (0, "c"): 28.0, (2, "a"): 1.0}
    mean, error, n = folds.lead(ours, others)
    assert (mean, n) == (2.0, 3)
    assert error == pytest.approx(1 / 3**0.5), "differences of 1, 3 and 2 dB"
    assert folds.lead(ours, {(0, "a"): 19.0})[::2] == (1.0, 1)


@pytest.mark.slow
def test_folds(tmp_path: Path, capture_folder: Path) -> None:
    out = tmp_path / "folds.jsonl"
    environment = os.environ | {"CLSPLAT_DATA": str(capture_folder.parent)}
    command = [sys.executable, str(BENCHMARKS / "folds.py"), "--out", str(out), "--folds", "2"]
    command += ["--cases", f"{capture_folder.name}:-1:60:4", "--systems", "default,3dgs"]
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["fold"], row["system"]) for row in rows] == [
        (fold, system) for fold in range(2) for system in ("default", "3dgs")
    ], "each once"
    whole = load_scene(capture_folder, eval=True)
    for system in ("default", "3dgs"):
        names = [name for row in rows if row["system"] == system for name in row["psnr"]]
        assert sorted(names) == [view.name for view in whole.train]
        mean = sum(value for row in rows if row["system"] == system for value in row["psnr"].values()) / len(names)
        assert f"| {system} | {mean:.2f} |" in done.stdout


@pytest.mark.slow
def test_few_views(tmp_path: Path, capture_folder: Path) -> None:
    out = tmp_path / "few.jsonl"
    environment = os.environ | {"CLSPLAT_DATA": str(capture_folder.parent)}
    case = f"{capture_folder.name}:-1:200:4:3"
    command = [sys.executable, str(BENCHMARKS / "few_views.py"), "--out", str(out), "--cases", case]
    for views in ("validation", "test", "test"):
        done = subprocess.run([*command, "--views", views], env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["views"], row["system"]) for row in rows] == [
        (views, system) for views in ("validation", "test") for system in ("default", "default:dropout=0")
    ], "each once"
    assert "there are only 3 photos" in " ".join(rows[0]["decided"])
    for row in rows:
        assert {"device", "driver", "schedule", "commit", "train_psnr", "seconds"} <= set(row)
        assert f"{row['psnr']:.2f}, {row['ssim']:.3f}" in done.stdout


@pytest.mark.parametrize("photos", [2, 5])
def test_a_case_of_few_photos_has_the_points_of_two_of_them(
    capture_folder: Path, monkeypatch: pytest.MonkeyPatch, photos: int
) -> None:
    monkeypatch.setenv("CLSPLAT_DATA", str(capture_folder.parent))
    scene = few_views.FewPhotosCase(capture_folder.name, -1, 9, 1, photos).load("validation")
    whole = load_scene(capture_folder)
    assert len(scene.train) == photos
    assert [view.name for view in scene.test] == [view.name for view in whole.test]
    assert len(scene.train) + len(scene.validation) == len(whole.train)
    assert {scene.train[0].name, scene.train[-1].name} == {whole.train[0].name, whole.train[-1].name}
    assert len(scene.points) <= len(whole.points)
    assert set(map(tuple, scene.points.xyz)) <= set(map(tuple, whole.points.xyz))


@pytest.mark.slow
def test_defaults(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    out = tmp_path / "defaults.jsonl"
    environment = os.environ | {"CLSPLAT_DATA": str(scene.parent)}
    command = [sys.executable, str(BENCHMARKS / "defaults.py"), "--out", str(out), "--work", str(tmp_path / "work")]
    options = ["--cases", f"{scene.name}:-1:60:4", "--systems", "default:init=random,default:strategy=mcmc"]
    for _ in range(2):
        done = subprocess.run([*command, *options], env=environment, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["system"] for row in rows] == ["default:init=random", "default:strategy=mcmc"], "each once"
    decided = [" ".join(row["decided"]) for row in rows]
    assert "penalty" in decided[0]
    assert "dropout" in decided[1], "the capture has few photos"
    assert "strategy" not in decided[1], "a named strategy is not decided"
    for row in rows:
        assert {"device", "driver", "schedule", "commit", "train_psnr", "seconds"} <= set(row)
        assert row["splats"] <= 60
        assert f"| {row['system']} | {row['psnr']:.2f} |" in done.stdout
    assert rows[1]["options"]["strategy"] == "mcmc"


@pytest.mark.slow
def test_web_page(tmp_path: Path) -> None:
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install clsplat[test-view])")
    from viewer_browser import CHROMIUM

    if CHROMIUM is None:
        pytest.skip("no Chromium: apt install chromium")
    out = tmp_path / "web_page.jsonl"
    command = [sys.executable, str(BENCHMARKS / "web_page.py"), "--smoke", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    compact, full = (json.loads(line) for line in out.read_text().splitlines())
    assert compact["bytes"] < full["bytes"]
    assert min(compact["psnr"], compact["rounding_psnr"]) > 35
    assert min(full["psnr"], full["rounding_psnr"]) > 45
    assert min(compact["whole_ms"], compact["opened_s"]) > 0
    assert "| `smoke` |" in done.stdout


@pytest.mark.slow
def test_formats(tmp_path: Path) -> None:
    out = tmp_path / "formats.jsonl"
    command = [sys.executable, str(BENCHMARKS / "formats.py"), "--smoke", "--random", "50", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = {(row["model"], row["format"]): row for row in map(json.loads, out.read_text().splitlines())}
    for name in {".ply", ".glb", ".usdc", ".html, full"} & {name for _, name in rows}:
        assert rows["smoke", name]["psnr"] > 80, name
    for name in (".html", ".sog", ".spz, version 3"):
        assert 25 < rows["smoke", name]["rounding_psnr"] < 80, name
    assert rows["smoke", ".sog"]["bytes"] < rows["smoke", ".ply"]["bytes"]
    assert rows["smoke", ".sog, Gaussians"]["psnr"] < rows["smoke", ".sog"]["psnr"], "the skew is lost"
    assert rows["random", ".sog"]["psnr"] is None
    assert min(row["write_s"] for row in rows.values()) >= 0
    assert "| `smoke` | .sog, Gaussians | gaussian |" in done.stdout
    assert "| 50 | .sog |" in done.stdout


def test_the_table_of_formats_is_that_of_the_results() -> None:
    rows = [json.loads(line) for line in (BENCHMARKS / "results" / "formats.jsonl").read_text().splitlines()]
    page = (BENCHMARKS.parent / "docs" / "formats.md").read_text()
    assert formats.table(rows) in page
    assert formats.times_table(rows) in page
