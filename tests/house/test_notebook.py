"""A notebook can do everything that a shell can: Python writes the same files as the commands."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runner import SHORT, clsplat

import clsplat as package
from clsplat.evaluation.metrics import protocol_named
from clsplat.scenes.demo.scene import write_capture
from clsplat.training.log import Progress

ITERATIONS, CAP = 30, 60
VARIABLE = ("render_ms",)  # keys of results.json whose times differ between runs


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("notebook") / "yard", 48, 36, 9)


@pytest.fixture(scope="module")
def model(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that Python trained."""
    folder = tmp_path_factory.mktemp("notebook") / "model"
    package.train(package.load_scene(scene), small_config(), output=folder)
    return folder


def small_config(**options: Any) -> package.TrainConfig:
    return package.TrainConfig(**({"iterations": ITERATIONS, "cap_max": CAP, "sh_degree": 1} | options))


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder by name."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def entries(path: Path) -> dict[str, Any]:
    """Return the entries of a results.json without times."""
    stored = json.loads(path.read_text())
    return {name: {k: v for k, v in entry.items() if k not in VARIABLE} for name, entry in stored.items()}


def test_demo(tmp_path: Path) -> None:
    shell, notebook = tmp_path / "shell", tmp_path / "notebook"
    clsplat("demo", shell, "--steps", ITERATIONS, "--cap-max", CAP, "--width", 48, "--views", 8, "-q")
    scene = package.load_scene(package.make_demo_scene(notebook / "scene", 48, 8))
    config = package.TrainConfig(shape="skew-normal", iterations=ITERATIONS, cap_max=CAP)
    trained = package.train(scene, config, output=notebook / "model")
    measured = package.evaluate(notebook / "model", renders=notebook / "renders")
    assert trained.finished
    for part in ("scene", "renders", "model/point_cloud"):
        assert contents(notebook / part) == contents(shell / part), part
    for name in ("cameras.json", "per_view.json"):
        assert (notebook / "model" / name).read_bytes() == (shell / "model" / name).read_bytes()
    assert entries(notebook / "model" / "results.json") == entries(shell / "model" / "results.json")
    stored = (notebook / "model" / "config.json").read_text()
    assert stored.replace(str(notebook), str(shell)) == (shell / "model" / "config.json").read_text()
    assert measured.report == notebook / "model" / "report.html"
    assert measured.psnr == measured.result["PSNR"]


def test_train_and_evaluate_with_other_photos(scene: Path, tmp_path: Path) -> None:
    """The folder records how the scene was read, so evaluation reads the same photos."""
    shell, notebook = tmp_path / "shell", tmp_path / "notebook"
    clsplat("train", scene, "-m", shell, "-r", 2, "--test-every", 3, *SHORT, "-q")
    options = {"iterations": 60, "cap_max": 400, "sh_degree": 1, "densify_interval": 10}
    package.train(
        package.load_scene(scene, resolution=2, test_every=3), package.TrainConfig(**options), output=notebook
    )
    assert (notebook / "config.json").read_bytes() == (shell / "config.json").read_bytes()
    assert contents(notebook / "point_cloud") == contents(shell / "point_cloud")
    clsplat("eval", shell, "--set", "all", "--compat", "3dgs", "-q")
    protocol = protocol_named("3dgs")
    package.evaluate(notebook, package.EvaluationOptions(view_set="all", protocol=protocol))
    assert entries(notebook / "results_all.json") == entries(shell / "results_all.json")
    assert (notebook / "per_view_all.json").read_bytes() == (shell / "per_view_all.json").read_bytes()


def test_resume(scene: Path, tmp_path: Path) -> None:
    notebook, shell = tmp_path / "notebook", tmp_path / "shell"
    begun = []

    def interrupt(progress: Progress) -> None:
        if progress.iteration and not begun:
            begun.append(progress)
            os.kill(os.getpid(), signal.SIGINT)

    config = small_config(iterations=120)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a program in the background ignores it
    try:
        stopped = package.train(package.load_scene(scene), config, interrupt, output=notebook)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not stopped.finished
    shutil.copytree(notebook, shell)
    resumed = package.resume(notebook)
    assert resumed.finished
    clsplat("train", "--resume", "-m", shell, "-q")
    assert contents(notebook / "point_cloud") == contents(shell / "point_cloud")
    assert (notebook / "config.json").read_bytes() == (shell / "config.json").read_bytes()


def test_resume_a_search(scene: Path, tmp_path: Path) -> None:
    package.train_budget(package.load_scene(scene), small_config(), output=tmp_path / "search")
    with pytest.raises(package.InputError, match="the search is finished: nothing to resume"):
        package.resume(tmp_path / "search")
    with pytest.raises(package.InputError, match="no such folder: there is nothing to resume"):
        package.resume(tmp_path / "none")


def test_render(model: Path, tmp_path: Path) -> None:
    shell, notebook = tmp_path / "shell", tmp_path / "notebook"
    clsplat("render", model, "-o", shell / "test", "--alpha", "--depth", "--set", "test")
    output = package.RenderOutput(notebook / "test", extras=("alpha", "depth"))
    rendered = package.render_views(model, output, package.ViewChoice(view_set="test"))
    assert sorted(rendered.depth_scales) == sorted(path.name for path in (notebook / "test").glob("*_depth.png"))
    path = package.PathRequest("orbit", frames=3, size=(40, 30))
    clsplat(
        "render", model, "-o", shell / "orbit", "--path", "orbit", "--frames", 3, "--size", "40x30", "--format", "npy"
    )
    package.render_views(model, package.RenderOutput(notebook / "orbit", format="npy"), package.ViewChoice(path=path))
    assert contents(notebook) == contents(shell)
    assert np.load(notebook / "orbit" / "orbit_002.npy").shape == (30, 40, 3)


def test_convert_prune_and_cameras(model: Path, tmp_path: Path) -> None:
    shell, notebook = tmp_path / "shell", tmp_path / "notebook"
    shell.mkdir()
    notebook.mkdir()
    said = clsplat("convert", model, shell / "gaussians.spz", "--approximate")
    converted = package.convert_model(model, notebook / "gaussians.spz", approximate=True)
    cost = package.conversion_cost(converted)
    assert cost is not None
    assert f"{cost.mean:.2f} dB, worst {cost.worst:.2f} dB" in said
    clsplat("clean", model, "-o", shell / "clean.ply", "-q")
    cleaned = package.clean_model(model, notebook / "clean.ply").cleaned
    assert len(cleaned.splats) == len(package.Splats.load(notebook / "clean.ply"))
    clsplat("prune", model, "-o", shell / "small.ply", "--tolerance", "0.5", "-q")
    pruned = package.prune_model(model, notebook / "small.ply", tolerance=0.5).pruned
    assert len(pruned.splats) == len(package.Splats.load(notebook / "small.ply"))
    for name in ("transforms.json", "cameras.json", "sparse"):
        clsplat("cameras", model, shell / name, "--overwrite", "-q")
        package.export_cameras(model, notebook / name, overwrite=True)
    assert contents(notebook) == contents(shell)


def test_inspect(scene: Path, model: Path) -> None:
    for path in (scene, model):
        printed = json.loads(clsplat("info", "--json", path))
        assert next(iter(printed.values())) == str(path)
        assert dict(list(printed.items())[1:]) == json.loads(json.dumps(package.inspect(path).to_json()))
