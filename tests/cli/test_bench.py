"""`clsplat bench`: the table names every stage, the file contains the numbers, and errors are one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from cli_runner import HEIGHT, N_VIEWS, WIDTH, clsplat, error_of
from clsplat_cli.bench import sentence

from clsplat.device.device import Device, open_device
from clsplat.profiling.bench import Report, StageTime
from clsplat.profiling.roofline import Roofline
from clsplat.profiling.stages import HOST, STAGES


@pytest.fixture(autouse=True)
def limits_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.profiling.roofline.measure_roofline", lambda device: Roofline(1e10, 1e11))


def test_made_up_scene(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "bench.json"
    file.parent.mkdir()
    file.write_text("of the user")
    assert "exists already" in error_of("bench", "--json", file)
    said = clsplat(
        "bench",
        "--overwrite",
        "--splats",
        200,
        "--width",
        48,
        "--height",
        32,
        "--shape",
        "gaussian",
        "--iterations",
        1,
        "--json",
        file,
    )
    assert "copy 10.0 GB/s, FMA 100 Gflop/s" in said
    training, render = said.split("render: ")
    for stage in (*STAGES, HOST):
        assert any(line.startswith(f"{stage}  ") for line in training.splitlines()), stage
    assert "200 gaussian splats" in training
    assert "rasterize_vjp" not in render
    assert "predicted" not in said, "the device is no GPU"
    assert " takes " in render, "a sentence on what takes the time"
    stored = json.loads(file.read_text())
    assert {"device", "driver", "schedule", "scene", "copy_bytes_per_s", "fma_flops_per_s"} <= set(stored)
    reports = [Report.from_json(values) for values in stored["reports"]]
    assert [(report.task, report.width, report.height) for report in reports] == [
        ("training step", 48, 32),
        ("render", 48, 32),
    ]


def test_a_gpu_is_compared_with_its_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """A processor pretends to be a GPU. The measured limits are lower, so the second prediction is longer."""

    def pretended(name: str | None) -> Device:
        device = open_device(name)
        device.info = replace(device.info, type="GPU", name="NVIDIA GeForce RTX 4090")
        return device

    monkeypatch.setattr("clsplat.device.device.open_device", pretended)
    monkeypatch.setenv("CLSPLAT_SCHEDULE", "gpu64")
    said = clsplat("bench", "--splats", 200, "--width", 48, "--height", 32, "--iterations", 1, "--shape", "gaussian")
    training, render = said.split("render: ")
    for text in (training, render):
        assert "model of RTX 4090: 128 units, 2.52 GHz, 1008 GB/s" in text
    model = training.split("model of ")[1]
    lines = {words[0]: words for line in model.splitlines() if (words := line.split())}
    for stage in ("rasterize_vjp", "step", "sum"):
        _, measured, stated, fitted, *_ = lines[stage]
        assert float(measured) > 0
        assert 0 < float(stated) <= float(fitted)
    assert "rasterize_vjp" not in render


def test_scene_from_its_points_and_from_a_model(capture_folder: Path, model_folder: Path) -> None:
    scene, model = capture_folder, model_folder
    said = clsplat("bench", "-s", scene, "--splats", 90, "--shape", "gaussian", "--iterations", 1)
    assert f"yard, up to {WIDTH}x{HEIGHT} px: 90 gaussian splats" in said
    assert N_VIEWS > 1
    assert " skew-normal splats" in clsplat("bench", "-s", scene, "-m", model, "--sh-degree", 1, "--iterations", 1)


def test_errors(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    assert "with -s" in error_of("bench", "-r", 2, code=2)
    assert "use -r" in error_of("bench", "-s", scene, "--width", 64, code=2)
    assert "not both" in error_of("bench", "-s", scene, "-m", tmp_path, "--splats", 5, code=2)
    assert "--iterations" in error_of("bench", "--iterations", 0, code=2)
    assert "--width" in error_of("bench", "--width", 4, code=2)
    assert str(tmp_path / "none") in error_of("bench", "-s", tmp_path / "none")
    assert str(tmp_path / "none.ply") in error_of("bench", "-s", scene, "-m", tmp_path / "none.ply")
    assert "nowhere" in error_of("bench", "--device", "nowhere")


@pytest.mark.parametrize(
    ("stage", "said"),
    [
        (
            StageTime("rasterize", 2, 0.4, 1, 1, 0.1, 0.61),
            "61 % of the FMA limit and 10 % of the copy limit: arithmetic",
        ),
        (StageTime("loss", 2, 0.4, 1, 1, 0.7, 0.1), ": memory limits it."),
        (StageTime("step", 2, 0.4, 1, 0, 1.3), "130 % of the copy limit: the caches help it"),
        (StageTime("gather", 2, 0.4, 1, 0, 0.2), "neither limits it"),
        (StageTime("host", 2, 0.4), "waits for Python"),
        (StageTime("transfers", 2, 0.4), "not compared"),
    ],
)
def test_sentences(stage: StageTime, said: str) -> None:
    assert said in sentence(stage)
    assert sentence(stage).startswith(f"{stage.stage} takes 40 % of the time")
