"""The search for the smallest model: its rules, its stages, its targets, and resuming after an interruption."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import clsplat
from clsplat.compression import search
from clsplat.compression.prune_and_refine import fine_tuning
from clsplat.compression.rules import (
    BudgetOptions,
    candidates,
    chosen_of,
    growth_caps,
    growth_is_over,
    knee_of,
    meets,
    rounds_allowed,
    rounds_are_over,
    standard_error,
)
from clsplat.compression.search import _Search, train_budget
from clsplat.compression.state import BudgetState
from clsplat.errors import InputError, OutputError
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.folder import ModelFolder
from clsplat.training.log import Progress

AUTO = BudgetOptions()
CONFIG = TrainConfig(iterations=30, cap_max=200, sh_degree=1, densify_interval=5)


def rows(*psnr: float, **more: Any) -> list[dict[str, Any]]:
    return [
        {"cap": 1000 * 2**i, "splats": 1000 * 2**i, "psnr": value, "views": [value], **more}
        for i, value in enumerate(psnr)
    ]


def test_caps_double_up_to_the_largest() -> None:
    assert growth_caps(9000) == [1000, 2000, 4000, 8000, 9000]
    assert growth_caps(8000) == [1000, 2000, 4000, 8000]
    assert growth_caps(300) == [300]


def test_growth_goes_on_while_two_doublings_gain() -> None:
    assert not growth_is_over([], AUTO)
    assert not growth_is_over(rows(20.0, 20.0), AUTO)
    assert growth_is_over(rows(20.0, 20.0, 20.05), AUTO)
    assert not growth_is_over(rows(20.0, 19.9, 20.2), AUTO)
    assert growth_is_over(rows(20.0, 21.0, 20.8, 21.05), AUTO)
    assert growth_is_over(rows(20.0, 25.0), BudgetOptions(target_psnr=24))


def test_the_knee_is_the_smallest_cap_that_is_good_enough() -> None:
    growth = rows(20.0, 21.0, 21.5, 21.53)
    assert candidates(growth, AUTO) == [4000]
    assert candidates(growth, BudgetOptions(1.2)) == [2000]
    assert candidates(growth, BudgetOptions(target_psnr=20.5)) == [2000]
    assert candidates(growth, BudgetOptions(target_psnr=30)) == [4000]
    assert knee_of(rows(21.0, 21.04), AUTO) == 1000
    assert knee_of(rows(21.0, 21.06), AUTO) == 2000
    assert knee_of(rows(21.06, 21.0), AUTO) == 1000


def test_whole_runs_decide_where_views_disagree() -> None:
    noisy, clear = rows(20.0, 20.3), rows(20.0, 20.3)
    for row, views in zip(noisy, ([18.0, 20.0, 22.0], [19.0, 19.9, 22.0]), strict=True):
        row["views"] = views
    for row, views in zip(clear, ([18.0, 20.0, 22.0], [18.3, 20.3, 22.3]), strict=True):
        row["views"] = views
    assert standard_error(noisy[0]["views"], noisy[1]["views"]) == pytest.approx(np.std([1, -0.1, 0], ddof=1) / 3**0.5)
    assert candidates(noisy, AUTO) == [1000, 2000]
    assert candidates(clear, AUTO) == [2000]


def test_rounds_go_on_until_two_have_lost_too_much() -> None:
    assert not rounds_are_over(rows(30.0), AUTO)
    assert not rounds_are_over(rows(30.0, 29.0), AUTO)
    assert not rounds_are_over(rows(30.0, 29.0, 30.0, 29.9), AUTO)
    assert rounds_are_over(rows(30.0, 30.0, 29.9, 29.9), AUTO)
    assert rounds_are_over([{"splats": 50, "psnr": 30.0}], AUTO)
    assert not rounds_are_over(rows(30.0, 20.0, 10.0, fitted_psnr=None), BudgetOptions(max_bytes=1))


def test_the_fewest_splats_that_are_good_enough() -> None:
    shrinking = rows(30.0, 30.2, 30.1, 29.96, 29.8)
    assert [meets(row, shrinking, AUTO) for row in shrinking] == [False, True, False, False, False]
    assert chosen_of(shrinking, AUTO) == 1, "the best seen counts, not the first"
    assert chosen_of(shrinking, BudgetOptions(1.0)) == 3
    knee = [shrinking[0] | {"lost": 0.0}, *shrinking[1:]]
    assert rounds_allowed(shrinking, AUTO) == pytest.approx(0.025)
    assert rounds_allowed(knee, AUTO) == pytest.approx(0.075), "the knee has left its half"
    assert chosen_of(knee, BudgetOptions(0.3)) > chosen_of(shrinking, BudgetOptions(0.3))
    assert chosen_of(shrinking, BudgetOptions(target_psnr=30.15)) == 1
    assert chosen_of(shrinking, BudgetOptions(target_psnr=40)) == 1, "out of reach: the best"
    limited = rows(30.0, 30.2, 30.1, 29.96, 29.8)
    for row, fitted in zip(limited, (None, None, 25.0, 28.0, 27.5), strict=True):
        row["fitted_psnr"] = fitted
    assert chosen_of(limited, BudgetOptions(max_bytes=1000)) == 3
    assert chosen_of(limited, BudgetOptions(max_bytes=1000, target_psnr=27.2)) == 4
    assert meets(limited[0], limited, BudgetOptions(max_bytes=1000)) is None
    assert chosen_of(rows(30.0, 29.0, fitted_psnr=None), BudgetOptions(max_bytes=1)) == 1


@pytest.mark.parametrize(
    "values", [{"tolerance": -0.1}, {"target_psnr": 0.0}, {"max_bytes": 0}, {"tolerance": float("nan")}]
)
def test_options_that_make_no_sense(values: dict[str, float]) -> None:
    with pytest.raises(InputError, match="must be"):
        BudgetOptions(**values)  # type: ignore[arg-type]


def test_fine_tuning_goes_on_at_the_runs_last_rates() -> None:
    config = TrainConfig(iterations=2000, lr_factor=2.0)
    splats = Splats.from_points(np.eye(3), np.full((3, 3), 0.5), sh_degree=1)
    short = fine_tuning(config, splats, 200, Path("start.ply"), rate=0.5)
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
    assert searched.finished
    assert report["knee"] == 200 == report["growth"][-1]["cap"]
    assert report["rounds"][0]["splats"] == report["refit"]["splats"] == 200
    rounds = report["chosen"]
    assert rounds >= 1
    assert report["rounds"][1]["splats"] == 150, "a round removes a quarter"
    assert len(searched.splats) == report["rounds"][rounds]["splats"] == report["final"]["splats"]
    assert report["held_out"]["psnr_pruned"] >= report["held_out"]["psnr"] - 0.1
    assert report["final"]["bytes"] == searched.path.stat().st_size
    assert report["final"]["missed"] is None
    loaded = Splats.load(searched.path)
    np.testing.assert_array_equal(loaded.mean, searched.splats.mean)
    folder = searched.path.parents[2]
    assert json.loads((folder / "budget.json").read_text()) == report
    assert json.loads((folder / "config.json").read_text())["config"]["cap_max"] == 200
    assert not (folder / "budget").exists(), "models of stages are removed"


class Stop:
    """A progress callback that stops the search at the start of its `number`th stage."""

    def __init__(self, number: int) -> None:
        self.left = number

    def __call__(self, progress: Progress) -> None:
        self.left -= bool(re.match(r"step \d of 5, (growth|held out|round|last part|refit)", progress.message))
        if not self.left:
            raise KeyboardInterrupt


def test_an_interrupted_search_goes_on(scene: Scene, searched: clsplat.Budgeted, tmp_path: Path) -> None:
    """A search that stops at the start of every stage in turn ends with the same bits."""
    resume, stops = False, 0
    while True:
        try:
            again = train_budget(scene, CONFIG, BudgetOptions(0.4), Stop(5), output=tmp_path, resume=resume)
            break
        except KeyboardInterrupt:
            resume, stops = True, stops + 1
            assert stops < 20
    assert stops >= 2
    assert again.path.read_bytes() == searched.path.read_bytes()


def search_of(scene: Scene, folder: Path, **values: Any) -> _Search:
    """Return a search with finished stages."""
    state = BudgetState(folder)
    state.begin(CONFIG, AUTO, {})
    state.values |= values
    return _Search(scene, CONFIG, AUTO, None, state, ModelFolder(folder))


def test_held_out_views_are_not_trained_on(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[Scene] = []
    splats = Splats.from_points(np.eye(3), np.full((3, 3), 0.5), sh_degree=0)

    class Runs:
        def __init__(self, scene: Scene, *args: Any, **options: Any) -> None:
            trained.append(scene)

        def run(self) -> Any:
            return SimpleNamespace(splats=splats, seconds=1.0)

    monkeypatch.setattr(search, "Trainer", Runs)
    stages = search_of(scene, tmp_path)
    stages.grow()
    judges = {view.name for view in stages.validation.views}
    assert trained
    for one in trained:
        names = {view.name for view in one.train}
        assert names
        assert not names & (judges | scene.test_names)


def test_the_refit_has_all_views_and_the_cap_of_the_knee(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[tuple[Scene, TrainConfig]] = []

    def stops(scene: Scene, config: TrainConfig, *args: Any, **options: Any) -> None:
        runs.append((scene, config))
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "train", stops)
    with pytest.raises(KeyboardInterrupt):
        search_of(scene, tmp_path, candidates=[70], knee=70, chosen=0, thresholds={}).run()
    assert runs == [(scene, CONFIG.replace(cap_max=70))]


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
    (tmp_path / "budget.json").write_text("{}")
    with pytest.raises(InputError, match=r"budget\.json: damaged \(no 'config'\)"):
        train_budget(scene, CONFIG, output=tmp_path, resume=True)
