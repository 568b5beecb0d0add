"""Pruning stays within the validation tolerance and removes the least important parts first. Other bits stay."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import MakeRenderer

from clsplat.compression.prune import (
    Thresholds,
    Validation,
    apply_thresholds,
    band_slopes,
    highest_threshold,
    prune,
    strongest,
    within_bytes,
    without_bands,
    without_field,
    without_splats,
)
from clsplat.device.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.metrics import psnr
from clsplat.models.prune import prune_model
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, load_scene
from clsplat.scenes.split import hold_out
from clsplat.splats.splats import Splats
from clsplat.training.folder import ModelFolder


@pytest.fixture(scope="module")
def scene(capture_folder: Path) -> Scene:
    return hold_out(load_scene(capture_folder))


@pytest.fixture(scope="module")
def splats(model_folder: Path) -> Splats:
    """A trained model and 40 more splats, which are behind the cameras or transparent."""
    arrays = Splats.load(ModelFolder(model_folder).latest_ply()[0]).to_numpy()
    more = {name: np.concatenate([values, values[:40]]) for name, values in arrays.items()}
    more["mean"][-20:] += 1e4
    more["opacity_logit"][-40:-20] = -12
    more["mean"][-40:-20] += 1e-3
    return Splats("skew-normal", more)


@pytest.fixture(scope="module")
def validation(scene: Scene, devices: list[Device], make_renderer: MakeRenderer) -> Validation:
    return Validation(make_renderer(devices[0]), scene.test)


@pytest.fixture(scope="module")
def renderer(validation: Validation) -> Renderer:
    return validation.renderer


def test_prune_keeps_within_the_tolerance(splats: Splats, scene: Scene, validation: Validation) -> None:
    pruned = prune(splats, scene.train, validation, 0.1)
    assert pruned.before == validation.psnr(splats)
    assert pruned.after == validation.psnr(pruned.splats) >= pruned.before - 0.1
    assert set(pruned.costs) == {"splats", "skew", "bands"}
    assert sum(pruned.costs.values()) == pytest.approx(pruned.before - pruned.after)
    assert len(pruned.splats) <= len(splats) - 40, "what shows nowhere goes first"
    assert 0 < np.count_nonzero(pruned.splats.skew.any(axis=1)) < len(pruned.splats)
    kept = np.isin(splats.mean, pruned.splats.mean).all(axis=1)
    np.testing.assert_array_equal(splats.mean[kept], pruned.splats.mean)
    np.testing.assert_array_equal(splats.log_scale[kept], pruned.splats.log_scale)


class Disagreeing(Validation):
    """Two views: one gains what the other loses with each removed splat, so the mean PSNR stays."""

    def __init__(self, renderer: Renderer, n: int) -> None:
        super().__init__(renderer, ())
        self.n = n

    def per_view(self, splats: Splats) -> list[float]:
        change = 0.005 * (self.n - len(splats))
        return [30.0 + change, 30.0 - change]


def test_views_that_disagree_keep_the_parts(splats: Splats, scene: Scene, renderer: Renderer) -> None:
    views = Disagreeing(renderer, len(splats))
    pruned = prune(splats, scene.train, views, 0.5, ("splats",))
    assert len(splats) - len(pruned.splats) == 50, "half of the tolerance is one standard error"
    assert (pruned.before, pruned.after, pruned.costs) == (30.0, 30.0, {"splats": 0.0})


def test_more_tolerance_leaves_less(splats: Splats, scene: Scene, validation: Validation, tmp_path: Path) -> None:
    sizes = []
    for tolerance in (0.0, 0.2, 2.0):
        prune(splats, scene.train, validation, tolerance).splats.save(tmp_path / "model.ply", compact=True)
        sizes.append((tmp_path / "model.ply").stat().st_size)
    assert sizes[0] > sizes[1] > sizes[2]


def test_no_tolerance_leaves_an_empty_model(splats: Splats, scene: Scene, validation: Validation) -> None:
    assert len(prune(splats, scene.train, validation, 1000.0).splats) > 0


def test_kinds_are_left_alone_unless_asked_for(splats: Splats, scene: Scene, validation: Validation) -> None:
    pruned = prune(splats, scene.train, validation, 0.3, ("bands",))
    np.testing.assert_array_equal(pruned.splats.skew, splats.skew)
    assert set(pruned.costs) == {"bands"}
    assert pruned.thresholds.splats == 0
    assert not pruned.thresholds.fields


def test_thresholds_do_the_same_again(splats: Splats, scene: Scene, validation: Validation) -> None:
    pruned = prune(splats, scene.train, validation, 0.3, ("fields", "bands"))
    again = apply_thresholds(splats, scene.train, validation.renderer, pruned.thresholds)
    for name, values in pruned.splats.arrays.items():
        np.testing.assert_array_equal(again.arrays[name], values, err_msg=name)
    same = apply_thresholds(splats, scene.train, validation.renderer, Thresholds())
    for name, values in splats.arrays.items():
        np.testing.assert_array_equal(same.arrays[name], values, err_msg=name)


def test_bytes_are_kept_within(splats: Splats, scene: Scene, renderer: Renderer, tmp_path: Path) -> None:
    splats.save(tmp_path / "whole.ply", compact=True)
    whole = (tmp_path / "whole.ply").stat().st_size
    limit = 70 * len(splats) + 4096
    assert limit < whole
    small = within_bytes(splats, scene.train, renderer, limit)
    assert small is not None
    small.save(tmp_path / "small.ply", compact=True)
    assert 0.9 * limit - 4096 < (tmp_path / "small.ply").stat().st_size <= limit
    assert len(small) == len(splats)
    assert within_bytes(splats, scene.train, renderer, 50 * len(splats)) is None
    assert within_bytes(splats, scene.train, renderer, whole + 4096) is splats


def test_rules_on_small_arrays() -> None:
    points = Splats.from_points(np.eye(3), np.full((3, 3), 0.5), sh_degree=1)
    arrays = points.to_numpy()
    arrays["skew"][:], arrays["sh"][:, 1:] = 0.5, 1.0
    splats = Splats(points.shape, arrays)
    np.testing.assert_array_equal(strongest(splats, np.array([1.0, 3.0, 2.0]), 2).mean, splats.mean[1:])
    few = without_splats(splats, 2.0, np.array([1.0, 3.0, 2.0]))
    np.testing.assert_array_equal(few.mean, splats.mean[1:2], err_msg="a score equal to the threshold goes")
    fewer = without_field(splats, 2.0, "skew", np.array([1.0, 3.0, 2.0]))
    assert fewer.skew.any(axis=1).tolist() == [False, True, False]
    lost = np.array([[36.0, 0.0], [72.0, 0.0], [0.0, 0.0]])
    np.testing.assert_array_equal(band_slopes(lost), [1.0, 2.0, 0.0])
    flat = without_bands(splats, 1.5, [np.full((3, 1, 3), 7.0, np.float32)], lost)
    np.testing.assert_array_equal(flat.sh[1], splats.sh[1])
    assert not flat.sh[[0, 2], 1:].any()
    assert (flat.sh[[0, 2], 0] == 7).all()


def test_splats_without_the_removed_band_keep_their_bits() -> None:
    points = Splats.from_points(np.eye(3), np.full((3, 3), 0.5), sh_degree=1)
    arrays = points.to_numpy()
    arrays["sh"][0, 1:] = 1.0
    splats = Splats(points.shape, arrays)
    lost = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    flat = without_bands(splats, 100.0, [np.full((3, 1, 3), 7.0, np.float32)], lost)
    assert (flat.sh[0, 0] == 7).all()
    np.testing.assert_array_equal(flat.sh[1:], splats.sh[1:])


@pytest.mark.parametrize(("floor", "left"), [(4.0, 4), (3.5, 4), (0.0, 0), (10.0, 10), (9.5, 10)])
def test_bisection_removes_exactly_what_the_floor_allows(floor: float, left: int) -> None:
    """Here the PSNR of a model is the number of its splats."""
    points = Splats.from_points(np.arange(30.0).reshape(10, 3), np.full((10, 3), 0.5), sh_degree=0)
    scores = np.random.default_rng(1).permutation(10) + 1.0
    threshold, kept, value = highest_threshold(
        scores, points, 10.0, floor, lambda splats, at: without_splats(splats, at, scores), len
    )
    assert value == len(kept) == left
    assert threshold == (10 - left if left < 10 else 0)
    assert scores[np.isin(points.mean, kept.mean).all(axis=1)].min(initial=11) == 11 - left


def test_the_judge_has_the_background_of_the_model(splats: Splats, scene: Scene, renderer: Renderer) -> None:
    few = splats.select(np.arange(100))
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.25)):
        want = [psnr(renderer.render(few, view.camera, background).color, view.image) for view in scene.test]
        assert Validation(renderer, scene.test, background).per_view(few) == want


def test_the_judge_looks_at_the_pixels_that_count(splats: Splats, scene: Scene, renderer: Renderer) -> None:
    """A photo that is wrong behind its mask has the same PSNR."""
    view = scene.test[0]
    mask = np.zeros(view.image.shape[:2], bool)
    mask[:, ::2] = True
    wrong = np.where(mask[:, :, None], view.image, 255 - view.image)
    few = splats.select(np.arange(100))
    (value,) = Validation(renderer, [replace(view, image=wrong, mask=mask)]).per_view(few)
    assert value == psnr(renderer.render(few, view.camera).color, view.image, mask=mask)
    assert value != pytest.approx(Validation(renderer, [replace(view, image=wrong)]).per_view(few)[0], abs=1e-3)


def test_a_model_is_pruned_over_its_background(
    model_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model of the fixture is that of a black run. Its record is changed to a run over another colour."""
    folder, judges = tmp_path / "model", []
    shutil.copytree(model_folder, folder)
    record = json.loads((folder / "config.json").read_text())
    record["config"]["background"] = [1.0, 0.5, 0.25]
    (folder / "config.json").write_text(json.dumps(record))
    init = Validation.__init__

    def spy(self: Validation, *args: Any) -> None:
        init(self, *args)
        judges.append(self)

    monkeypatch.setattr(Validation, "__init__", spy)
    pruned = prune_model(folder, tmp_path / "small.ply").pruned
    assert [judge.background for judge in judges] == [(1.0, 0.5, 0.25)]
    assert [view.name for view in judges[0].views] == [
        view.name for view in hold_out(load_scene(record["scene"]["path"])).test
    ]
    assert pruned.before == judges[0].psnr(Splats.load(ModelFolder(folder).latest_ply()[0]))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("tolerance", "a", "tolerance is the text 'a'; expected a number of dB"),
        ("tolerance", None, "tolerance is null; expected a number of dB"),
        ("tolerance", float("nan"), "tolerance nan: must be at least 0 dB"),
        ("iterations", 1.5, "iterations is 1.5; expected a whole number"),
        ("iterations", -1, "iterations -1: must be at least 0"),
    ],
)
def test_a_wrong_number_is_named_before_the_model_is_read(tmp_path: Path, name: str, value: Any, said: str) -> None:
    with pytest.raises(InputError) as caught:
        prune_model(tmp_path / "none", tmp_path / "small.ply", **{name: value})
    assert str(caught.value) == said


def test_bad_input(splats: Splats, scene: Scene, validation: Validation) -> None:
    with pytest.raises(InputError, match="tolerance -1"):
        prune(splats, scene.train, validation, -1)
    with pytest.raises(InputError, match="no splats"):
        prune(splats.select([]), scene.train, validation, 0.1)
    assert validation.psnr(splats.select([])) == 0
