"""The folder of a model: what a run finds there."""

from __future__ import annotations

from pathlib import Path

from clsplat.training.folder import ModelFolder

ITERATIONS = [100, 3, 20, 7000, 9, 1, 300, 50, 2, 40]


def test_iterations_rise_whatever_the_order_of_the_folders(tmp_path: Path) -> None:
    for iteration in ITERATIONS:
        folder = tmp_path / "point_cloud" / f"iteration_{iteration}"
        folder.mkdir(parents=True)
        (folder / "point_cloud.ply").touch()
    (tmp_path / "point_cloud" / "iteration_8").mkdir()  # without a file
    (tmp_path / "point_cloud" / "iteration_x").mkdir()
    assert ModelFolder(tmp_path).iterations() == sorted(ITERATIONS)


def test_a_new_run_removes_the_results_of_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    ours = ["results.json", "per_view_train.json", "report_all.html", "results_validation.json", "checkpoint.npz"]
    theirs = ["results_final.txt", "report_draft.html", "notes.json"]
    for name in ours + theirs:
        (tmp_path / name).touch()
    ModelFolder(tmp_path).clear()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(theirs)
