"""`clsplat info`, `clsplat prune` and `clsplat train --budget`: files, output, and errors."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runner import clsplat, error_of, run

from clsplat.splats.convert import convert
from clsplat.splats.splats import Splats
from clsplat.training.folder import ModelFolder

SEARCH = (
    "--shape",
    "skew-normal",
    "--eval",
    "--iterations",
    20,
    "--cap-max",
    150,
    "--sh-degree",
    0,
    "--densify-interval",
    5,
)


@pytest.fixture(scope="module")
def found(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of a model from a search, and the command's output, with its warnings."""
    folder = tmp_path_factory.mktemp("search") / "model"
    search = ("--budget", "auto", "--budget-tolerance", "1dB", "--save-iterations", "5", "--validate", *SEARCH)
    result = run("train", scene, "-m", folder, *search)
    assert result.exit_code == 0, result.output
    return folder, result.output


def test_info_counts(model: Path, tmp_path: Path) -> None:
    ply = ModelFolder(model).latest_ply()[0]
    n = len(Splats.load(ply))
    text = clsplat("info", model)
    assert f"{ply}: {n} splats, shape skew-normal, SH degree 1, " in text
    assert "splats with skew" in text
    arrays = Splats.load(ply).to_numpy()
    arrays["skew"][5:] = 0
    Splats("skew-normal", arrays).save(tmp_path / "few.ply", compact=True)
    (first, second) = map(json.loads, clsplat("info", model, tmp_path / "few.ply", "--json").splitlines())
    assert (first["splats"], first["skewed"], second["skewed"]) == (n, n, 5)
    assert second["bytes"] == (tmp_path / "few.ply").stat().st_size < first["bytes"] == ply.stat().st_size
    assert second["sh_coefficients"] == [3 * n, 9 * n]


def test_eval_writes_the_complexity(copied_model: Path) -> None:
    clsplat("eval", copied_model, "-q")
    (entry,) = json.loads((copied_model / "results.json").read_text()).values()
    assert entry["skewed_fraction"] == 1.0
    assert entry["parameters_in_use"] == entry["parameters"]
    assert entry["sh_coefficients"] == [3 * entry["splats"], 9 * entry["splats"]]


def test_prune_removes_unnecessary_splats(model: Path, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "small.ply"
    output = clsplat("prune", model, "-o", out, "--tolerance", "0.5dB")
    ply = ModelFolder(model).latest_ply()[0]
    small, whole = Splats.load(out), Splats.load(ply)
    assert len(small) <= len(whole)
    assert out.stat().st_size < 0.8 * ply.stat().st_size
    assert f"splats: {len(small)} of {len(whole)}, " in output
    shutil.copy(ply, tmp_path / "own.ply")
    own = clsplat("prune", tmp_path / "own.ply", "-s", scene, "-o", tmp_path / "own.ply", "--overwrite")
    assert f"% of {ply.stat().st_size / 1e6:.2f} MB" in own
    assert "validation views: PSNR " in output
    clsplat(
        "prune",
        out,
        "-s",
        json.loads((model / "config.json").read_text())["scene"]["path"],
        "-o",
        out,
        "--tolerance",
        ".2",
        "--overwrite",
        "--whole",
        "-q",
    )
    assert b"clsplat_" not in out.read_bytes().split(b"end_header")[0]


def test_prune_fine_tunes_with_iterations(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "small.ply"
    clsplat("prune", model, "-o", out, "--tolerance", "0.5", "--iterations", 5, "-q")
    assert len(Splats.load(out)) <= len(Splats.load(ModelFolder(model).latest_ply()[0]))


def test_prune_takes_a_plain_3dgs_file(model: Path, scene: Path, tmp_path: Path) -> None:
    arrays = Splats.load(ModelFolder(model).latest_ply()[0]).to_numpy()
    arrays["skew"][:] = 0
    plain = tmp_path / "plain.ply"
    convert(Splats("skew-normal", arrays), "gaussian").save(plain)
    plain.write_bytes(plain.read_bytes().replace(b"comment clsplat shape=gaussian normalisation=peak\n", b""))
    output = clsplat("prune", plain, "-s", scene, "-o", tmp_path / "out.ply", "--tolerance", 0.5)
    assert "skew" not in output
    assert Splats.load(tmp_path / "out.ply").shape == "gaussian"
    assert "give the scene's folder with -s" in error_of("prune", plain, "-o", tmp_path / "other.ply")


def test_prune_refuses(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    out.write_text("precious")
    assert "exists already" in error_of("prune", model, "-o", out)
    assert out.read_text() == "precious"
    assert "is a folder" in error_of("prune", model, "-o", tmp_path)
    config = (model / "config.json").read_bytes()
    assert "writes .ply files" in error_of("prune", model, "-o", model / "config.json", "--overwrite")
    assert (model / "config.json").read_bytes() == config
    assert "not a number of decibels" in error_of(
        "prune", model, "-o", tmp_path / "a.ply", "--tolerance", "much", code=2
    )
    assert "no such model folder" in error_of("prune", tmp_path / "none", "-o", tmp_path / "a.ply")
    assert "no such model folder" in error_of("info", tmp_path / "none")


def test_a_search_writes_a_smaller_model(found: tuple[Path, str]) -> None:
    folder, output = found
    assert "warning: --save-iterations has no effect with --budget" in output
    assert "warning: --validate has no effect with --budget" in output
    report = json.loads((folder / "budget.json").read_text())
    assert report["options"]["tolerance"] == 1
    last = ModelFolder(folder).latest_ply()[0]
    splats = Splats.load(last)
    assert len(splats) == report["final"]["splats"] < 150
    assert f"{last}: {len(splats)} splats, " in output
    assert re.search(rf"rounds: {len(splats)} of 1\d\d splats remain", output)
    assert f"chart of the rounds: {folder / 'rounds.png'}" in output
    assert "test views (2): PSNR " in output
    entry = json.loads(clsplat("info", folder, "--json"))
    assert entry["splats"] == len(splats)
    assert entry["bytes"] == report["final"]["bytes"]


def test_a_finished_search_is_not_resumed_or_replaced(found: tuple[Path, str], scene: Path) -> None:
    folder, _ = found
    assert "the search is finished: nothing to resume" in error_of("train", "--resume", "-m", folder)
    assert "already holds a model" in error_of("train", scene, "-m", folder, "--max-bytes", 1000)
    assert "not a number of decibels" in error_of("train", scene, "--target-psnr", "x", code=2)


def test_a_missed_target_is_a_warning_also_of_a_quiet_search(scene: Path, tmp_path: Path) -> None:
    result = run("train", scene, "-m", tmp_path / "model", "--target-psnr", 60, "-q", *SEARCH)
    assert result.exit_code == 0
    assert result.stdout == ""
    assert "warning: target PSNR 60 dB was not reached" in result.stderr


def test_an_interrupted_search_prints_how_to_continue(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import clsplat.compression.search as budget

    def stop(*args: object, **kinds: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(budget, "prune", stop)
        result = run("train", scene, "-m", tmp_path / "model", "--target-psnr", 10, *SEARCH)
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-1] == (
        f"interrupted, finished steps are kept; to continue: clsplat train --resume -m {tmp_path / 'model'}"
    )
    assert "already holds a model" in error_of("train", scene, "-m", tmp_path / "model", *SEARCH)
    output = clsplat("train", "--resume", "-m", tmp_path / "model")
    assert "validation views: PSNR" in output
    assert np.isfinite(Splats.load(ModelFolder(tmp_path / "model").latest_ply()[0]).mean).all()
    clsplat("train", scene, "-m", tmp_path / "model", "--overwrite", "-q", *SEARCH)
    assert not (tmp_path / "model" / "budget.json").exists(), "another run's folder now"
