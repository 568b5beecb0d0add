"""`clsplat frontier`: a sweep from the command line, its files, and a message of one line for each mistake."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from cli_runner import clsplat, error_of, run

from clsplat.evaluation import chart_style

TINY = ["--iterations", "8", "--sh-degree", "0", "--densify-interval", "5", "--curve", "3"]


def test_frontier_sweeps_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capture_folder: Path) -> None:
    monkeypatch.setitem(chart_style._STYLE, "savefig.dpi", 40)
    scene, out = capture_folder, tmp_path / "out"
    arguments = ("frontier", scene, "-o", out, "--cap-max", "30", "60", *TINY)
    first = run(*arguments)
    assert first.exit_code == 0, first.output
    assert "[4/4] yard skew-normal cap 60 seed 0: PSNR" in first.stderr
    assert "splats needed for the PSNR of the first system:" in first.stdout
    assert first.stdout.splitlines()[-1] == f"{out / 'report.html'}: charts and tables"
    names = {path.name for path in (out / "charts").iterdir()}
    assert names >= {f"{name}.{kind}" for name in ("size", "time") for kind in ("png", "svg", "csv", "json")}
    data = {path.name: path.read_text() for path in (out / "charts").glob("*.[cj]*")}
    assert (out / "report.html").read_text().count("<svg") >= 2
    curves = json.loads((out / "charts" / "time.json").read_text())
    assert [row["iteration"] for row in curves] == [1, 3, 8] * 2
    # The command draws the same charts again from these runs and those of another folder.
    monkeypatch.setattr(chart_style, "available", lambda: False)
    shutil.copytree(out, tmp_path / "other")
    shutil.rmtree(out / "charts")
    again = run("frontier", "-o", out, "--charts-only", "--add", tmp_path / "other")
    assert (again.stdout, again.stderr) == (first.stdout, "")
    assert {path.name: path.read_text() for path in (out / "charts").iterdir()} == data


def test_frontier_of_several_lengths(tmp_path: Path, capture_folder: Path) -> None:
    arguments = ("frontier", capture_folder, "-o", tmp_path, "--cap-max", "30", "--curve", "0", "--sh-degree", "0")
    done = run(*arguments, "--iterations", "6,12", "--densify-interval", "5")
    assert done.exit_code == 0, done.output
    assert "lead over the first system in equal time [dB]:" in done.stdout
    assert "gaussian, 6 iterations" in done.stdout
    rows = json.loads((tmp_path / "charts" / "length.json").read_text())
    assert [(row["system"], row["iterations"]) for row in rows] == [
        (system, n) for n in (6, 12) for system in ("gaussian", "skew-normal")
    ]
    assert all(row["seconds"] > 0 for row in rows)


def test_frontier_without_matplotlib_warns_and_writes_the_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capture_folder: Path
) -> None:
    monkeypatch.setattr(chart_style, "available", lambda: False)
    done = run(
        "frontier",
        capture_folder,
        "-o",
        tmp_path,
        "--systems",
        "gaussian",
        "--cap-max",
        "30",
        "-q",
        *TINY,
    )
    assert done.exit_code == 0, done.output
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("warning: charts need")]
    assert "pip install 'clsplat[charts]'" in line
    assert {path.name for path in (tmp_path / "charts").iterdir()} == {"time.csv", "time.json"}


def test_frontier_names_each_mistake(tmp_path: Path, capture_folder: Path) -> None:
    scene = capture_folder
    assert "give scenes, or --charts-only" in error_of("frontier", "-o", tmp_path / "out", code=2)
    assert "give scenes, or --charts-only" in error_of("frontier", scene, "-o", tmp_path, "--charts-only", code=2)
    assert f"{tmp_path / 'out'}: cannot be read" in error_of("frontier", "-o", tmp_path / "out", "--charts-only")
    assert "runs.jsonl: cannot be read" in error_of("frontier", scene, "-o", tmp_path / "out", "--add", tmp_path)
    assert "unknown system 'cube'" in error_of("frontier", scene, "-o", tmp_path / "out", "--systems", "cube")
    assert "'0' is not a list of iterations" in error_of("frontier", scene, "-o", tmp_path, "--iterations", "0", code=2)
    assert "two scenes are called yard" in error_of("frontier", scene, scene, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_frontier_is_listed() -> None:
    assert "frontier" in clsplat("--help")
    assert "--charts-only" in clsplat("frontier", "--help")
