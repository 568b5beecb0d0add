"""The search for the smallest model: its rules, its stages, its targets, and resuming after an interruption."""

from __future__ import annotations

import json
import signal
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clsplat
from clsplat.cameras.cameras_json import read_cameras
from clsplat.compression import search
from clsplat.compression.prune_and_refine import Part, fine_tuning
from clsplat.compression.rules import BudgetOptions, chosen_of, loss_of, lost_too_much, rounds_are_over, standard_error
from clsplat.compression.search import train_budget
from clsplat.errors import InputError, OutputError
from clsplat.scenes.scene import Scene
from clsplat.scenes.split import hold_out
from clsplat.splats.splats import Splats
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.config import TrainConfig
from clsplat.training.exposure_file import exposures_of_start, read_exposures
from clsplat.training.folder import ModelFolder
from clsplat.training.log import Progress
from clsplat.training.run import train
from clsplat.training.trainer import Trainer, Visit

AUTO = BudgetOptions()
CONFIG = TrainConfig(
    shape="skew-normal", iterations=30, cap_max=200, sh_degree=1, densify_interval=5, occluder_check=False
)


def rows(*psnr: float, **more: Any) -> list[dict[str, Any]]:
    """Return the model with all splats and those after its rounds; all views have the same PSNR."""
    return [
        {"splats": round(10_000 * 0.75**i), "psnr": value, "views": [value, value], **more}
        for i, value in enumerate(psnr)
    ]


def test_rounds_go_on_until_two_in_a_row_have_lost_too_much() -> None:
    assert not rounds_are_over(rows(30.0), AUTO)
    assert not rounds_are_over(rows(30.0, 29.0), AUTO), "one bad round may be chance"
    assert not rounds_are_over(rows(30.0, 29.0, 30.0, 29.9), AUTO)
    assert rounds_are_over(rows(30.0, 30.0, 29.9, 29.9), AUTO)
    assert rounds_are_over(rows(30.0, 30.2, 30.1, 30.1), AUTO), "the best counts, not the first"
    assert rounds_are_over([{"splats": 50, "psnr": 30.0}], AUTO), "hardly a splat is left"
    assert not rounds_are_over(rows(30.0, 20.0, 10.0, fitted_psnr=None), BudgetOptions(max_bytes=1))
    assert rounds_are_over(rows(30.0, 29.9, 29.9, fitted_psnr=20.0), BudgetOptions(max_bytes=1))


def test_a_target_ends_the_rounds() -> None:
    target = BudgetOptions(target_psnr=25)
    assert not rounds_are_over(rows(30.0, 28.0, 26.0), target)
    assert not rounds_are_over(rows(30.0, 24.0, 26.0, 24.9), target)
    assert rounds_are_over(rows(30.0, 26.0, 24.9, 24.0), target)
    assert chosen_of(rows(30.0, 26.0, 24.9, 24.0), target) == 1
    unreachable = rows(20.0, 21.0, 19.0)
    assert rounds_are_over(unreachable, target)
    assert chosen_of(unreachable, target) == 1, "the best"


def test_the_fewest_splats_that_are_good_enough() -> None:
    shrinking = rows(30.0, 30.1, 30.2, 30.14, 30.12, 30.0)
    assert [lost_too_much(row, shrinking, AUTO) for row in shrinking] == [True, True, False, False, True, True]
    assert chosen_of(shrinking, AUTO) == 3, "rounds have three quarters of the tolerance"
    assert chosen_of(shrinking, BudgetOptions(0.3)) == 5
    assert chosen_of(shrinking, BudgetOptions(target_psnr=30.11)) == 4


def test_a_limit_of_bytes_takes_the_best_that_fits() -> None:
    limited = rows(30.0, 30.2, 30.1, 29.96, 29.8)
    for row, fitted in zip(limited, (None, None, 25.0, 28.0, 27.95), strict=True):
        row["fitted_psnr"] = fitted
    assert chosen_of(limited, BudgetOptions(max_bytes=1000)) == 4, "as good as the best, and smaller"
    assert chosen_of(limited, BudgetOptions(0.05, max_bytes=1000)) == 3
    assert chosen_of(limited, BudgetOptions(max_bytes=1000, target_psnr=24.0)) == 4
    assert chosen_of(rows(30.0, 29.0, fitted_psnr=None), BudgetOptions(max_bytes=1)) == 1


def test_views_that_disagree_keep_more_splats() -> None:
    """The mean loss of both is 0.05 dB; one is within chance."""
    sure, unsure = rows(30.0, 29.95), rows(30.0, 29.95)
    all_views = ([29, 30, 31], [28.95, 29.94, 30.96], [29, 30, 31], [29.3, 29.55, 31])
    for row, views in zip((*sure, *unsure), all_views, strict=True):
        row["views"] = views
    differences = [-0.3, 0.45, 0.0]
    assert loss_of(unsure[1], unsure) == pytest.approx((0.05, np.std(differences, ddof=1) / 3**0.5))
    assert standard_error([1.0], [2.0]) == 0
    assert (chosen_of(sure, AUTO), chosen_of(unsure, AUTO)) == (1, 0)
    assert not lost_too_much(unsure[1], unsure, AUTO), "the rounds go on: more of them may be better"


@pytest.mark.parametrize(
    "values", [{"tolerance": -0.1}, {"target_psnr": 0.0}, {"max_bytes": 0}, {"tolerance": float("nan")}]
)
def test_options_that_make_no_sense(values: dict[str, float]) -> None:
    with pytest.raises(InputError, match="must be"):
        BudgetOptions(**values)  # type: ignore[arg-type]


def test_fine_tuning_goes_on_at_the_runs_last_rates() -> None:
    config = TrainConfig(iterations=2000, lr_factor=2.0)
    splats = Splats.from_points(np.eye(3), np.full((3, 3), 0.5), sh_degree=1)
    short = fine_tuning(config, splats, Part(0.1, 0.5), Path("start.ply"))
    assert (short.iterations, short.cap_max, short.sh_degree, short.start.init) == (200, 3, 1, "start.ply")
    assert short.optim.position_lr_final * short.rate_factor("mean") == pytest.approx(
        config.optim.position_lr_final * config.rate_factor("mean")
    )
    assert short.optim.scaling_lr * short.rate_factor("log_scale") == pytest.approx(
        config.optim.scaling_lr * config.rate_factor("log_scale")
    )
    assert short.optim.skew_lr is not None
    assert short.optim.skew_lr * short.rate_factor("skew") == pytest.approx(
        splats.schema["skew"].lr * config.rate_factor("skew")
    )
    assert short.optim.opacity_lr == config.optim.opacity_lr
    assert short.optim.feature_lr == 0.5 * config.optim.feature_lr
    assert short.optim.feature_rest_lr == pytest.approx(config.optim.feature_lr / 20 * 10**-0.25)
    assert short.optim.lr_factor == 1, "the rates have the factor of the run"
    assert short.density.densify_until == short.density.noise_lr == 0


# --- whole searches ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(scene: Scene) -> Scene:
    """The small capture without the photos of its test views: a search that reads one of them fails."""
    assert scene.test
    return replace(scene, views=[replace(view, image=None) if view in scene.test else view for view in scene.views])


@pytest.fixture(scope="module")
def searched(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> clsplat.Budgeted:
    return train_budget(scene, CONFIG, BudgetOptions(0.4), output=tmp_path_factory.mktemp("budget") / "model")


def test_a_search_finds_a_smaller_model(searched: clsplat.Budgeted) -> None:
    report = searched.report
    rounds = report["chosen"]
    assert report["rounds"][0]["splats"] == 200
    assert rounds >= 1
    assert report["rounds"][1]["splats"] == 150, "a round removes a quarter"
    assert [row["splats"] for row in report["all_views"]] == [row["splats"] for row in report["rounds"][: rounds + 1]]
    assert len(searched.splats) == report["all_views"][rounds]["splats"] == report["final"]["splats"]
    assert report["held_out"]["psnr_pruned"] >= report["held_out"]["psnr"] - 0.1
    assert report["final"]["bytes"] == searched.path.stat().st_size
    assert report["final"]["missed"] is None
    assert searched.seconds > 0
    np.testing.assert_array_equal(Splats.load(searched.path).mean, searched.splats.mean)


def test_a_search_leaves_the_files_of_a_run(searched: clsplat.Budgeted, scene: Scene) -> None:
    folder = ModelFolder(searched.path.parents[2])
    assert json.loads((folder.path / "budget.json").read_text()) == searched.report
    assert not (folder.path / "budget").exists(), "models and runs of stages are removed"
    config = TrainConfig.from_json(folder.read_config()["config"])
    assert (config.cap_max, config.iterations, config.start.init) == (200, 30, "sfm"), "the options of the caller"
    names = {camera.name for camera in read_cameras(folder.cameras_path)}
    assert names == {Path(view.name).stem for view in scene.views} or names == {view.name for view in scene.views}
    assert len(folder.log_path.read_text().splitlines()) >= 1
    assert searched.path == folder.ply_path(30 + 6 * searched.report["chosen"]), "all its iterations"


def test_rounds_begin_with_the_exposures_of_the_run_before(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned, begun = {}, {}

    def recorded(scene: Scene, config: TrainConfig, *arguments: Any, output: Path, **named: Any) -> Any:
        begun[output.name] = exposures_of_start(config.start.init)
        result = train(scene, config, *arguments, output=output, **named)
        learned[output.name] = read_exposures(output / "exposure.json")
        return result

    monkeypatch.setattr(search, "train", recorded)
    found = train_budget(scene, CONFIG.replace(exposure=True), BudgetOptions(0.4), output=tmp_path / "m")
    assert found.report["chosen"] >= 1
    runs = [name for name in learned if name.startswith("whole")]
    assert begun["whole"] == begun["trial"] == {}
    for before, after in pairwise(runs):
        assert set(begun[after]) == {view.name for view in scene.train}
        for name, exposure in begun[after].items():
            np.testing.assert_array_equal(exposure, learned[before][name])
    last = read_exposures(tmp_path / "m" / "exposure.json")
    assert all(np.array_equal(last[name], learned[runs[-1]][name]) for name in last)


class Stop:
    """A progress callback that stops the search at its `number`th report that a training run makes."""

    def __init__(self, number: int) -> None:
        self.left = number

    def __call__(self, progress: Progress) -> None:
        self.left -= not progress.message
        if not self.left:
            raise KeyboardInterrupt


def test_an_interrupted_search_goes_on(scene: Scene, searched: clsplat.Budgeted, tmp_path: Path) -> None:
    """A search that stops in one run after the other ends with the same bits."""
    resume, stops = False, 0
    while True:
        try:
            again = train_budget(scene, CONFIG, BudgetOptions(0.4), Stop(4), output=tmp_path, resume=resume)
            break
        except KeyboardInterrupt:
            resume, stops = True, stops + 1
            assert stops < 20
    assert stops >= 2
    assert again.path.read_bytes() == searched.path.read_bytes()


def test_ctrl_c_in_a_run_keeps_its_iterations(
    scene: Scene, searched: clsplat.Budgeted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run goes on from its checkpoint."""
    interrupt(scene, tmp_path, monkeypatch, press_ctrl_c_at_8)
    reached = Checkpoint.load(tmp_path / "budget" / "trial" / "checkpoint.npz").iteration
    assert 0 < reached < CONFIG.iterations / 2
    runs = trained_runs(monkeypatch)
    again = train_budget(scene, CONFIG, BudgetOptions(0.4), output=tmp_path, resume=True)
    assert [run["resume"] for run in runs] == [True] + [False] * (len(runs) - 1)
    assert again.path.read_bytes() == searched.path.read_bytes()


def test_workers_find_the_same_model(scene: Scene, searched: clsplat.Budgeted, tmp_path: Path) -> None:
    """They train the trial and the run of all views. The search itself trains neither of them."""
    pytest.importorskip("distributed")
    trained: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        original = search.train

        def noted(*arguments: Any, **named: Any) -> Any:
            model = original(*arguments, **named)
            trained.append(f"{Path(named['output']).name} {'resumed' if named['resume'] else 'trained'}")
            return model

        patch.setattr(search, "train", noted)
        found = train_budget(scene, CONFIG, BudgetOptions(0.4), output=tmp_path / "out", cluster="local:1")
    assert trained[0] == "trial resumed"
    assert "whole resumed" in trained
    assert found.path.read_bytes() == searched.path.read_bytes()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        path.name for path in searched.path.parents[2].iterdir()
    }


def test_a_moved_search_goes_on(
    scene: Scene, searched: clsplat.Budgeted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A round has the path of its first splats among its options, so its checkpoint is of no use elsewhere."""
    interrupt(scene, tmp_path / "here", monkeypatch, press_ctrl_c_in_a_round)
    assert (tmp_path / "here" / "budget" / "trial_1_0" / "checkpoint.npz").is_file()
    (tmp_path / "here").rename(tmp_path / "there")
    again = train_budget(scene, CONFIG, BudgetOptions(0.4), output=tmp_path / "there", resume=True)
    assert again.path.read_bytes() == searched.path.read_bytes()


def interrupt(scene: Scene, folder: Path, monkeypatch: pytest.MonkeyPatch, press: Visit) -> None:
    """Begin a search and end it where `press` sends Ctrl-C."""
    with monkeypatch.context() as patch:
        trained_runs(patch, visit=press)
        with pytest.raises(KeyboardInterrupt):
            train_budget(scene, CONFIG, BudgetOptions(0.4), output=folder)


def press_ctrl_c_in_a_round(trainer: Trainer, stop: threading.Event) -> None:
    if trainer.config.iterations < CONFIG.iterations / 2:
        signal.raise_signal(signal.SIGINT)


def press_ctrl_c_at_8(trainer: Trainer, stop: threading.Event) -> None:
    if trainer.iteration == 8:
        signal.raise_signal(signal.SIGINT)


def trained_runs(monkeypatch: pytest.MonkeyPatch, **more: Any) -> list[dict[str, Any]]:
    """Return a list that gets scene, config and options of each run of a search. more : further options of `train`."""
    runs: list[dict[str, Any]] = []

    def recorded(scene: Scene, config: TrainConfig, progress: Any, **options: Any) -> Any:
        runs.append({"scene": scene, "config": config, **options})
        return train(scene, config, progress, **options, **more)

    monkeypatch.setattr(search, "train", recorded)
    return runs


def test_held_out_views_are_seen_in_the_last_stage_only(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = trained_runs(monkeypatch)
    train_budget(scene, CONFIG, BudgetOptions(0.4), output=tmp_path)
    judges = hold_out(scene).test_names
    assert judges
    for run in runs:
        names = {view.name for view in run["scene"].train}
        last = Path(run["output"]).name.startswith("whole")
        assert names
        assert not names & scene.test_names
        assert (judges <= names) if last else not names & judges
    lengths = {Path(run["output"]).name: run["config"].iterations for run in runs}
    assert (lengths["trial"], lengths["whole"]) == (15, 30)
    assert (lengths["trial_1_0"], lengths["trial_1_1"], lengths["whole_1_0"], lengths["whole_1_1"]) == (2, 2, 3, 3)


def test_targets_out_of_reach_keep_the_best(scene: Scene, tmp_path: Path) -> None:
    found = train_budget(scene, CONFIG, BudgetOptions(target_psnr=60, max_bytes=3000), output=tmp_path)
    assert "target PSNR 60 dB was not reached" in found.report["final"]["missed"]
    assert "bytes are more than 3000" in found.report["final"]["missed"]
    assert len(Splats.load(found.path))


@pytest.mark.slow
def test_a_limit_of_bytes_is_kept(scene: Scene, tmp_path: Path) -> None:
    found = train_budget(scene, CONFIG, BudgetOptions(max_bytes=13_000), output=tmp_path / "bytes")
    assert found.path.stat().st_size <= 13_000
    assert found.report["final"]["missed"] is None


def test_what_cannot_be_resumed_or_replaced(scene: Scene, searched: clsplat.Budgeted, tmp_path: Path) -> None:
    folder = searched.path.parents[2]
    with pytest.raises(OutputError, match="already holds a model"):
        train_budget(scene, CONFIG, output=folder)
    with pytest.raises(InputError, match=r"tolerance=0\.1, but the search was started with tolerance=0\.4"):
        train_budget(scene, CONFIG, output=folder, resume=True)
    with pytest.raises(InputError, match="no search to resume from"):
        train_budget(scene, CONFIG, output=tmp_path, resume=True)
    old = searched.report | {"growth": []}
    (tmp_path / "budget.json").write_text(json.dumps(old))
    with pytest.raises(InputError, match=r"budget\.json: an earlier version began this search: start again"):
        train_budget(scene, CONFIG, output=tmp_path, resume=True)
    (tmp_path / "budget.json").write_text("{}")
    with pytest.raises(InputError, match=r"budget\.json: damaged \(no 'config'\)"):
        train_budget(scene, CONFIG, output=tmp_path, resume=True)
